"""What travels between a client and `umbrad`, and who speaks it."""
