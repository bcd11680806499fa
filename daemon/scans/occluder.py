"""What scans with a moving occluder share: references, one video, and when it ends."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

from numpy.typing import NDArray

from daemon.scans.method import Bench, Expose, Method, Motion, Step, Taken, Unsuitable, Watch
from daemon.scans.pattern_scan import REFERENCES, response_of
from daemon.separation.estimator import Components, Lighting, Observation
from daemon.separation.strength import SourceStrength
from protocol.scans import OccluderScan, Reference

O = TypeVar("O", bound=OccluderScan)  # noqa: E741

MOST_CHANGE = 0.15
"""Beyond this a change of the source is a cloud: below it, a scale."""

LEAST_CHANGE = 0.005
"""Within this the source has not changed."""

INCOMPLETE = "incomplete frame"

_LEAST_FRAMES = 2


class OccluderMethod(Method[O]):
    """References first, then a video until there is enough. On a recording: to its end.

    Of the references `allowed` ones mean anything under a source that has no pixels; none is taken
    unless it is asked for.
    """

    allowed: Mapping[Reference, str] = {Reference.AMBIENT: "the source off"}

    def __init__(self, spec: O, bench: Bench, motion: Motion | None) -> None:
        super().__init__(spec, bench)
        self.response = response_of(spec.radiometry, bench)
        self._live = not bench.camera.recorded
        wanted = spec.references or ()
        for reference in wanted:
            if reference not in self.allowed:
                known = " and ".join(f"{name} ({what})" for name, what in self.allowed.items())
                raise Unsuitable(
                    "a lamp or the sun shows no black or white frame: only " + known,
                    "$.references",
                )
        if spec.radiometry.leakage:
            raise Unsuitable(
                "nothing leaks into an umbra: leave the leakage away", "$.radiometry.leakage"
            )
        self._source = SourceStrength(self.response) if spec.sun else None
        self._rejected: Counter[str] = Counter()
        self._references = tuple(Expose(*REFERENCES[reference]) for reference in wanted)
        self._watch = Watch(
            self._frames(), motion if self._live else None, self._lights() if self._live else ()
        )

    def _frames(self) -> int | None:
        """Frames of the video; None: until there is enough."""
        frames, camera = self.spec.frames, self.bench.camera
        if camera.recorded and camera.frame_count is not None:
            there = camera.frame_count - len(self._references)
            if there < max(frames or 0, _LEAST_FRAMES):
                raise Unsuitable(
                    f"the recording has {max(there, 0)} frames of the {self.name}, and "
                    f"{max(frames or 0, _LEAST_FRAMES)} are needed",
                    "$.frames",
                )
            frames = frames or there
        if frames is not None and frames < _LEAST_FRAMES:
            raise Unsuitable(f"a {self.name} takes {_LEAST_FRAMES} frames at least", "$.frames")
        return frames

    def _lights(self) -> tuple[str, ...]:
        there = self.bench.lights
        if self.spec.lights is None:
            return there
        for name in self.spec.lights:
            if name not in there:
                known = ", ".join(there) or "none"
                raise Unsuitable(f"the rig has no light {name!r}, but {known}", "$.lights")
        return self.spec.lights

    def planned(self) -> int | None:
        """Frames to watch and references; None where coverage decides."""
        if self._live and self._watch.motion is not None:
            return None
        frames = self._watch.frames
        return None if frames is None else frames + len(self._references)

    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """See `Method`."""
        del summary
        if index < len(self._references):
            return self._references[index]
        return self._watch if index == len(self._references) else None

    def observe(self, step: Step, taken: Taken) -> Observation:
        """See `Method`. Under the sun a small change of its strength is scaled; a frame under a
        cloud is kept but not used, for sun and sky do not vary together."""
        lighting = step.lighting if isinstance(step, Expose) else Lighting.PATTERN
        if taken.incomplete or taken.pixels is None:
            self._rejected[INCOMPLETE] += 1
            return Observation(lighting=lighting, used=False, reason=INCOMPLETE)
        if self._source is None or lighting is not Lighting.PATTERN:
            return Observation(lighting=lighting)
        strength = round(self._source.of(taken.pixels), 4)
        if abs(strength - 1.0) > MOST_CHANGE:
            why = "cloud" if strength < 1.0 else "brighter than when the scan began"
            self._rejected[why] += 1
            return Observation(used=False, reason=f"source at {strength:.0%}: {why}")
        if abs(strength - 1.0) < LEAST_CHANGE or not self._source.learned:
            strength = 1.0
        self._source.accept(strength)
        return Observation(strength=strength)

    def recall(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Method`: the source's strength is followed on from where it was."""
        if self._source is None or observation.lighting is not Lighting.PATTERN:
            return
        if not observation.used:
            self._rejected[observation.reason.rpartition(": ")[2]] += 1
        if observation.reason == INCOMPLETE:
            return
        self._source.of(pixels)
        if observation.used:
            self._source.accept(observation.strength)

    def conclude(self, components: Components) -> Components:
        """See `Method`: with the frames that were not used, by reason, among the facts."""
        if not self._rejected:
            return components
        return replace(components, facts={**components.facts, "rejected": dict(self._rejected)})

    def enough(self, summary: Mapping[str, float], seconds: float) -> str:
        """See `Method`: covered, or out of time."""
        if not self._live or self._watch.motion is None:
            return ""
        covered = summary.get("coverage", 0.0)
        if covered >= self.spec.coverage:
            return f"{covered:.1%} of the lit pixels are covered, {self.spec.coverage:.1%} wanted"
        if seconds >= self.spec.time_limit_s:
            return (
                f"the time limit of {self.spec.time_limit_s:g} s, at {covered:.1%} of "
                f"{self.spec.coverage:.1%} coverage"
            )
        return ""
