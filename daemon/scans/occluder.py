"""What scans with a moving occluder share: references, one video, and when it ends."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any, TypeVar

from numpy.typing import NDArray

from daemon.scans.method import (
    INCOMPLETE,
    Bench,
    Circle,
    Expose,
    Method,
    Motion,
    Step,
    Taken,
    Unsuitable,
    Watch,
)
from daemon.scans.parameters import response_of
from daemon.scans.planned import references
from daemon.separation.estimator import Components, Lighting, Observation
from daemon.separation.registration import Place, Registration
from daemon.separation.strength import SourceStrength
from daemon.separation.warping import aligned
from protocol.scans.occluded import OccluderScan
from protocol.scans.spec import Reference

O = TypeVar("O", bound=OccluderScan)  # noqa: E741

MOST_CHANGE = 0.15
"""A source that changed by a larger part is behind a cloud, and its frames are not used; after a
smaller change they are scaled."""

LEAST_CHANGE = 0.005
"""After a smaller change frames are used as they are."""

LASTING = 50
"""After so many frames in a row that are brighter than the reference, these become the reference:
the scan began under a cloud."""

VAIN_TURNS = 5
"""After so many turns of the circle without more coverage the scan ends."""

VAIN_FRAMES = 100
"""Frames in use that those turns must have had: fewer say nothing of what the circle reaches,
however often it went round while others were lost."""

GROWTH = 0.0005
"""A smaller rise of the coverage may be noise."""

MANY_LOST = 0.1
"""Where a larger part of the frames was lost, that is the reason given for missing coverage."""

MOST_LOST = 0.5
"""A part of the frames: with as many lost a scan that ends uncovered has failed."""

MOST_WANDERED = 0.3
"""Pixels that the camera may move while its place is learned; if it moved further, a live scan
begins to collect anew."""

LOST = "lost frame"
CLOUD = "cloud"
SHAKEN = "moved too far, or too blurred, to be aligned"
PLACED = "before the camera's place was known"
BRIGHTER = "brighter than when the scan began"
BEGAN_DARK = "cloud at the start"
LEARNED = "before the source's strength was known"

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
        mesh = self.name == "mesh"
        self._camera = Registration(self.response, mesh=mesh) if spec.align else None
        self._place = "" if spec.align else "not looked for"
        self._aligned = 0  # frames of the present collection
        self._rejected: Counter[str] = Counter()
        self._came = 0  # frames, with those that were lost
        self._used = 0  # frames of the occluder in the present collection
        self._brighter = 0  # frames in a row
        self._strengths = (1.0, 1.0)  # of the source, the least and the most
        self._in_vain = _InVain()
        self._short = False  # the video ended uncovered, with most of its frames lost
        self._references = tuple(references(wanted))
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
        self._came += 1
        if taken.incomplete or taken.pixels is None:
            why = LOST if taken.pixels is None else INCOMPLETE
            self._rejected[why] += 1
            return Observation(lighting=lighting, used=False, reason=why)
        if lighting is not Lighting.PATTERN:
            return Observation(lighting=lighting)
        return self._decide(taken.pixels)

    def foresee(self, frames: Iterator[NDArray[Any]]) -> None:
        """See `Method`: the first frames of a recording tell the camera's place in all, these
        among them."""
        if self._live or self._camera is None:
            return
        for pixels in islice(frames, len(self._references), None):
            if self._camera is None or self._placed(pixels) is not None:
                return
            self._learn_place(pixels)
        if self._camera is not None:
            self._camera.settle()
            self._judge_place()

    def recall(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Method`: what was decided before is decided again, to be followed on."""
        self._came += 1
        if observation.reason == INCOMPLETE:
            self._rejected[INCOMPLETE] += 1
        elif observation.lighting is Lighting.PATTERN:
            self._decide(pixels)

    def decides_as(self, other: Method[Any]) -> bool:
        """See `Method`. The camera's place and the source's strength are measured in light."""
        return (
            isinstance(other, OccluderMethod)
            and self.response == other.response
            and (self.spec.sun, self.spec.align) == (other.spec.sun, other.spec.align)
        )

    def _decide(self, pixels: NDArray[Any]) -> Observation:
        """What a complete frame of the occluder is used for; counted. Depends on nothing but the
        frames before, so that it may be done again."""
        place = self._placed(pixels)
        warp = place.warp if place is not None and place.found else None
        bayer = bool(self.response.bayer)
        lies = pixels if warp is None else aligned(pixels, warp, bayer)
        fresh, strength = self._weather(lies)
        if abs(strength - 1.0) > MOST_CHANGE:
            why = CLOUD if strength < 1.0 else BRIGHTER
            self._rejected[why] += 1
            return Observation(used=False, reason=f"source at {strength:.0%}: {why}")
        if place is not None and not place.found:
            self._rejected[SHAKEN] += 1
            return Observation(used=False, reason=SHAKEN)
        if self._source is not None:
            known = self._source.learned
            self._source.accept()
            if self._source.learned and not known and self._live:
                fresh = LEARNED
        if place is None and self._learn_place(pixels):
            fresh, place = PLACED, self._placed(pixels)
            warp = place.warp if place is not None and place.found else None
        if fresh:
            self._rejected[fresh] += self._used
            self._used = self._aligned = 0
        self._used += 1
        self._aligned += warp is not None
        if abs(strength - 1.0) < LEAST_CHANGE:
            strength = 1.0
        return Observation(strength=strength, warp=warp, fresh=bool(fresh), reason=fresh)

    def _placed(self, pixels: NDArray[Any]) -> Place | None:
        """Where the camera was; None: that is not known (yet), or not looked for."""
        camera = self._camera
        if camera is None:
            return None
        if not camera.suits(pixels.shape):
            self._camera, self._place = None, "not looked for: the picture is too small"
            return None
        if not camera.learned:
            return None
        return camera.of(pixels, 1.0 if self._source is None else self._source.latest)

    def _learn_place(self, pixels: NDArray[Any]) -> bool:
        """Take a frame into the reference for the camera's place. True: it is known now, and the
        camera moved before."""
        camera = self._camera
        if camera is None:
            return False
        camera.learn(pixels)
        if not camera.learned:
            return False
        self._judge_place()
        return self._live and self._camera is not None and camera.wandered >= MOST_WANDERED

    def _judge_place(self) -> None:
        """See whether what was learned tells the camera's place, and say so."""
        camera = self._camera
        if camera is None:
            return
        if not camera.learned:
            self._camera, self._place = None, "not looked for: the recording is too short"
        elif not camera.tells:
            self._camera, self._place = None, "not looked for: the scene has too little texture"
        else:
            self._place = f"known to {camera.sd:.2g} px"

    def _weather(self, pixels: NDArray[Any]) -> tuple[str, float]:
        """Why the collection begins anew with this frame ("": it does not), and the source's
        strength in it."""
        source = self._source
        if source is None:
            return "", 1.0
        strength = round(source.of(pixels), 4)
        least, most = self._strengths
        self._strengths = min(least, strength), max(most, strength)
        self._brighter = self._brighter + 1 if strength > 1.0 + MOST_CHANGE else 0
        if self._brighter < LASTING:
            return "", strength
        self._brighter = 0
        self._strengths = (1.0, 1.0)
        source.restart()
        return BEGAN_DARK, 1.0

    def conclude(self, components: Components) -> Components:
        """See `Method`: with the frames that were aligned, and that were not used, by reason, among
        the facts."""
        facts: dict[str, Any] = {"aligned_frames": self._aligned}
        if self._place:
            facts["camera_place"] = self._place
        if self._source is not None:
            facts["source_strength"] = list(self._strengths)
        if self._rejected:
            facts["rejected"] = dict(self._rejected)
        return replace(components, facts={**components.facts, **facts})

    def enough(self, summary: Mapping[str, float], seconds: float) -> str:
        """See `Method`: covered, or out of time."""
        if not self._live or self._watch.motion is None:
            return ""
        covered = summary.get("coverage", 0.0)
        reached = f"{covered:.1%} of the lit pixels are covered, {self.spec.coverage:.1%} wanted"
        if covered >= self.spec.coverage:
            return reached
        if seconds >= self.spec.time_limit_s:
            why = f"the time limit of {self.spec.time_limit_s:g} s"
            return f"{why}: {reached}" + self._uncovered_by_loss()
        if self._in_vain.turns(summary, seconds, self._watch.motion) < VAIN_TURNS:
            return ""
        return f"{reached}: {VAIN_TURNS} turns covered no more" + (
            self._uncovered_by_loss() or f"; {self.uncovered()}"
        )

    def uncovered(self) -> str:
        """Why places may have stayed uncovered, of a scan that lost few frames."""
        return (
            "what is left this circle does not reach, or it lies in mirrors of the scene's own "
            "that are narrower than the mesh's pitch"
        )

    def _uncovered_by_loss(self) -> str:
        """Note whether a video that ends uncovered fell short for its lost frames; what to say of
        them, "" where they are not why."""
        lost = self._rejected[LOST]
        self._short = lost > MOST_LOST * self._came
        if lost <= MANY_LOST * self._came:
            return ""
        return (
            f", but {lost} of {self._came} frames were lost: the camera's link, this computer or "
            "its disk does not keep up; scan at a lower --frame-rate-hz or with a smaller picture, "
            "and for longer (--time-limit-s)"
        )

    def short(self) -> bool:
        """See `Method`."""
        return self._short


class _InVain:
    """Counts the turns of a circle since coverage last grew; time in which no frame was used does
    not count, nor do turns with hardly a frame."""

    def __init__(self) -> None:
        self._most = 0.0
        self._frames = 0.0  # in use when coverage last grew
        self._began: tuple[float, float] | None = None  # seconds and frames, at the first question

    def turns(self, summary: Mapping[str, float], seconds: float, motion: Motion) -> float:
        """Turns since coverage grew; 0 for a motion that has an end."""
        if not isinstance(motion, Circle):
            return 0.0
        frames = summary.get("frames", 0.0)
        every = frames + summary.get("unused", 0.0)
        if self._began is None:
            self._began = seconds, every
        covered = summary.get("coverage", 0.0)
        if covered > self._most + GROWTH or frames < self._frames:
            self._most, self._frames = covered, frames
        passed, taken = seconds - self._began[0], every - self._began[1]
        if passed <= 0.0 or taken <= 0.0 or frames - self._frames < VAIN_FRAMES:
            return 0.0
        turn_s = math.tau * motion.radius_mm / motion.feed_mm_s
        return (frames - self._frames) * passed / taken / turn_s
