"""The ways of exposing: one file each, chosen by `modes`, behind the face in `exposer`."""
