"""A step becomes frames: shown or moved, exposed in step, proven, recorded.

The sequencer has the steps exposed, each way of exposing in a file of its own behind the face in
`exposer`, chosen by `modes`; the recorder takes the frames.
"""
