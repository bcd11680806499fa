"""Pure estimators: frames in, components out. No I/O, no threads, no hardware."""
