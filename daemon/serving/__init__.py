"""What a client reaches: sockets, keys, commands in and answers and events out."""
