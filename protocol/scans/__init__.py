"""What a client may ask for: one frozen struct a method, pure validated data, a family a file.

A spec says nothing of devices or time; the daemon's method of the same name turns it into
steps. Symbols are the paper's: α lit fraction, b leakage of an unlit source element.
"""
