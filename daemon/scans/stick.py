"""A thin occluder swept over the scene on video (§4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from daemon.scans.method import Bench, Expose, Method, Step, Taken, Unsuitable, Watch
from daemon.scans.pattern_scan import REFERENCES, response_of
from daemon.separation.coverage import Occluder
from daemon.separation.estimator import Estimator, Lighting, Observation
from protocol.scans import Reference, Stick

_LEAST_FRAMES = 2


class StickMethod(Method[Stick]):
    """Watch the scene while a stick's shadow is swept over it; no device but the camera is needed.

    Of the references only an ambient frame (the source off) means anything under a source that
    has no black; none is taken unless it is asked for.
    """

    name: ClassVar[str] = "stick"

    def __init__(self, spec: Stick, bench: Bench) -> None:
        super().__init__(spec, bench)
        self.response = response_of(spec.radiometry, bench)
        wanted = spec.references or ()
        if any(reference is not Reference.AMBIENT for reference in wanted):
            raise Unsuitable(
                "a lamp or the sun shows no black or white frame: only ambient (the source off)",
                "$.references",
            )
        if spec.radiometry.leakage:
            raise Unsuitable(
                "nothing leaks into a stick's umbra: leave the leakage away", "$.radiometry.leakage"
            )
        self._references = tuple(Expose(*REFERENCES[reference]) for reference in wanted)
        frames = spec.frames
        if bench.camera.recorded and bench.camera.frame_count is not None:
            there = bench.camera.frame_count - len(self._references)
            if there < max(frames or 0, _LEAST_FRAMES):
                raise Unsuitable(
                    f"the recording has {max(there, 0)} frames of the stick, and "
                    f"{max(frames or 0, _LEAST_FRAMES)} are needed",
                    "$.frames",
                )
            frames = frames or there
        elif frames is None and not bench.camera.recorded:
            raise Unsuitable(
                "a live camera has no end: say how many frames to watch (--frames)", "$.frames"
            )
        if frames is not None and frames < _LEAST_FRAMES:
            raise Unsuitable(f"a sweep takes {_LEAST_FRAMES} frames at least", "$.frames")
        self._frames = frames

    def planned(self) -> int | None:
        """Frames to watch and references; None for a recording of unknown length."""
        return None if self._frames is None else self._frames + len(self._references)

    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """See `Method`."""
        del summary
        if index < len(self._references):
            return self._references[index]
        return Watch(self._frames) if index == len(self._references) else None

    def observe(self, step: Step, taken: Taken) -> Observation:
        """See `Method`."""
        lighting = step.lighting if isinstance(step, Expose) else Lighting.PATTERN
        return Observation(
            lighting=lighting,
            pattern=taken.sub if lighting is Lighting.PATTERN else 0,
            used=not taken.incomplete,
            reason="incomplete frame" if taken.incomplete else "",
        )

    def estimator(self) -> Estimator:
        """See `Method`."""
        return Occluder(self.response, lit_fraction=self.spec.lit_fraction)
