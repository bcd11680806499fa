"""One file a device: each knows its hardware, and nothing of scans, networks or runs."""
