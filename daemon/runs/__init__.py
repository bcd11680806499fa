"""The life of a run: queued, prepared, taken through its course, ended, reprocessed."""
