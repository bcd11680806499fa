"""Whether frames are a hardware-timed sequence, each image once and in order.

The projector sends one pulse an image, and the camera exposes once a pulse: so frame k shows image
k if there are as many frames as images, none was lost on its way, and they are one period apart. A
pulse that the camera did not hear leaves N - 1 frames or a gap of two periods, a false pulse leaves
two frames too near to each other, an acquisition that began too late begins after the first image.
Times come from the camera's own clock, so that only its jitter and drift count.

It does not prove that image k *is* pattern k: that a projector was loaded with the wrong images, or
emits them one period late, is seen in the pictures only.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.base.camera import Frame
from drivers.base.projector import LoadedSequence

TOLERANCE = 0.25
"""Of a period: far above a trigger's jitter, far below the whole period of a slip."""


def mismatch(loaded: LoadedSequence, frames: Sequence[Frame], began_ns: int) -> str:
    """Why `frames`, all that came after `run()` gave `began_ns`, are not its images; "" if so."""
    for k, frame in enumerate(frames):
        if frame.incomplete:
            return f"frame {k} is incomplete"
        if frame.sequence != frames[0].sequence + k:
            return f"the camera lost frames before frame {k}"
    if len(frames) != loaded.images:
        return f"{len(frames)} frames for {loaded.images} images: a trigger was missed or false"
    return _out_of_time(loaded, frames, began_ns)


def _out_of_time(loaded: LoadedSequence, frames: Sequence[Frame], began_ns: int) -> str:
    period = loaded.period_us * 1e3
    slack = TOLERANCE * period
    for k, frame in enumerate(frames):
        if frame.end_ns - frame.start_ns > period:
            return f"frame {k} was exposed for longer than the period of {loaded.period_us:g} us"
        late = frame.start_ns - frames[0].start_ns - k * period
        if abs(late) > slack:
            return f"frame {k} began {late / 1e6:+.3f} ms off its place in the sequence"
    if frames and frames[0].start_ns < began_ns - slack:
        return "frame 0 began before the sequence did"
    return ""
