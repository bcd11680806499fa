"""Work by hand: patterns, snaps, the live view, the stage, and the lock."""
