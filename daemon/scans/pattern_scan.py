"""What all scans of a fixed pattern set share: references, then the patterns, then the end."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.method import INCOMPLETE, Bench, Expose, Step, Taken, Unsuitable
from daemon.scans.parameters import exposure_of, leakage_of, noise_of, response_of
from daemon.scans.planned import PlannedMethod, exposures, references
from daemon.separation.bracket import Bracketed
from daemon.separation.creep import Creep
from daemon.separation.estimator import Components, Estimator, Lighting, Observation, Quality
from daemon.separation.exposure_noise import ROUNDING, Sensor
from daemon.separation.extremes import Extremes
from daemon.separation.finish import ADVICE
from daemon.separation.frameset import FrameSet, Watched
from daemon.separation.order_estimate import KEEP, LEAST, LEAST_FOR_BLUR
from daemon.separation.radiometry import Response
from protocol.patterns import AnyPattern
from protocol.scans.projected import PatternScan
from protocol.scans.spec import Reference

FINE_PX = 64
"""Patterns of larger checkers, patches or periods may light one end of a scene alone."""

_BRACKET = "what saturates is measured too by several exposures of each pattern: --bracket 0.25,1"

# Where `levels` looks at a pattern set: places of a square of projector pixels, with a margin for
# blur; all places of a period where it is short, else so many at random.
_PLACES, _MARGIN, _SAMPLES = 96, 8, 1500
_REGION = 40

P = TypeVar("P", bound=PatternScan)


@lru_cache(maxsize=128)
def _drawn(pattern: AnyPattern, side: int) -> NDArray[np.uint8]:
    """A pattern as it is shown; cached, for it is needed at many blurs, and by the next scan."""
    return patterns.render(pattern, side, side)


class PatternMethod(PlannedMethod[P]):
    """References first, then each pattern once, `average` frames each.

    `estimators` are those that a method has; the first is what auto chooses.

    On a recording a reference is one image, and only those named in the spec are there.

    A bracket takes all exposures of a pattern (and of a reference) before the next pattern: then a
    pattern's light is merged as soon as it is there, in constant memory, and a source that drifts
    does so between patterns, as without a bracket. To change the exposure stops the camera, so a
    live scan goes through the bracket to and fro (1, 4, 16, then 16, 4, 1): each pattern begins
    with the exposure that the one before it ended with. On a recording the images of each pattern
    are in the bracket's order, as cameras that bracket by themselves make them.
    """

    estimators: ClassVar[tuple[str, ...]] = ("maxmin",)
    _plan: Sequence[Expose]

    def __init__(self, spec: P, bench: Bench, pattern_set: Sequence[AnyPattern]) -> None:
        super().__init__(spec, bench)
        if spec.estimator not in {"auto", *self.estimators}:
            raise Unsuitable(
                f"{self.name} has no estimator {spec.estimator}: {', '.join(self.estimators)}",
                "$.estimator",
            )
        self.response = response_of(spec.radiometry, bench)
        self.leakage = leakage_of(spec.radiometry, bench)
        self._own_us = 0.0  # the run's exposure; 0: not known
        shown = [*self._references(), *exposures(pattern_set, spec.average)]
        self._plan = self._bracketed(shown)
        self._patterns = tuple(pattern_set)
        self._check()

    def _references(self) -> list[Expose]:
        wanted = self.spec.references
        recorded = self.bench.camera.recorded
        if wanted is None:
            wanted = () if recorded else (Reference.BLACK, Reference.WHITE)
        return references(wanted, frames=1 if recorded else self.spec.average)

    def _bracketed(self, plain: list[Expose]) -> tuple[Expose, ...]:
        """Each step at each exposure of the bracket. Raises Unsuitable for what cannot be had."""
        factors = self.spec.bracket
        if factors is None:
            return tuple(plain)
        if len(set(factors)) < len(factors):
            raise Unsuitable(
                "each exposure of a bracket is to be named once (more frames of it: --average)",
                "$.bracket",
            )
        if self.bench.camera.recorded:
            return tuple(replace(step, exposure=f) for step in plain for f in factors)
        # with auto-exposure the spec's own is the longest that may be chosen
        asked_us = None if self.spec.auto_exposure else self.spec.exposure_us
        own_us = exposure_of(asked_us, self.bench)
        self._own_us = self.bench.exposure_us or own_us
        shortest, longest = self.bench.camera.exposure_range_us
        beyond = [f for f in factors if not shortest <= f * own_us <= longest]
        if beyond:
            raise Unsuitable(
                f"the camera exposes {shortest:g} to {longest:g} us, and {beyond[0]:g} times "
                f"{own_us:g} us is beyond that: choose from {shortest / own_us:.3g} to "
                f"{longest / own_us:.3g} (--bracket), or another exposure (--exposure)",
                "$.bracket",
            )
        return tuple(
            replace(step, exposure=f, exposure_us=None if f == 1.0 else f * own_us)
            for turn, step in enumerate(plain)
            for f in (factors if turn % 2 == 0 else factors[::-1])
        )

    def _check(self) -> None:
        camera = self.bench.camera
        if not camera.recorded:
            self.projector()  # it needs one
            return
        planned = self.planned()
        if camera.frame_count is not None and camera.frame_count != planned:
            raise Unsuitable(
                f"the folder has {camera.frame_count} images; {self.counted()}", "$.references"
            )

    def counted(self) -> str:
        """How the number of frames comes about and how to change it, for people."""
        references = dict.fromkeys(
            step.lighting for step in self._plan if step.lighting is not Lighting.PATTERN
        )
        parts = [self.described()]
        if self.spec.average > 1:
            parts.append(f"{self.spec.average} averaged a pattern")
        if references:
            parts.append(f"with {', '.join(references)} first")
        if self.spec.bracket:
            shown = ", ".join(f"{f:g}" for f in self.spec.bracket)
            parts.append(f"each at the {len(self.spec.bracket)} exposures {shown} (set --bracket)")
        return f"{', '.join(parts)} need {self.planned()}"

    def described(self) -> str:
        """The pattern set in a few words."""
        return f"{len(self._patterns)} patterns"

    @property
    def lit_fraction(self) -> float:
        """α: as asked for, else the pattern set's own on this projector."""
        return self.lit_fraction_of(self._patterns)

    def lit_fraction_of(self, shown: Sequence[AnyPattern]) -> float:
        """α of some patterns: as asked for, else their mean on this projector, else a half."""
        if self.spec.lit_fraction is not None:
            return self.spec.lit_fraction
        projector = self.bench.projector
        if projector is None:
            return 0.5
        lit = [patterns.lit_fraction(p, projector.width, projector.height) for p in shown]
        return sum(lit) / len(lit)

    def levels(self, blur: float) -> NDArray[np.float32]:
        """Levels of the pattern set, 0 to 1, at places all over it under a projector's blur (px):
        (patterns, places)."""
        side = _PLACES + 2 * _MARGIN
        whole = _REGION // self.period * self.period
        if whole:  # each place of the period equally often
            rows, columns = _MARGIN + np.indices((whole, whole)).reshape(2, -1)
        else:
            rng = np.random.default_rng(0)
            rows, columns = rng.integers(_MARGIN, side - _MARGIN, (2, _SAMPLES))
        found = np.empty((len(self._patterns), rows.size), dtype=np.float32)
        for index, pattern in enumerate(self._patterns):
            image = _drawn(pattern, side).astype(np.float32) / patterns.LEVELS
            if blur:
                image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur), dtype=np.float32)
            found[index] = image[rows, columns]
        return found

    @property
    def period(self) -> int:
        """Of the pattern set, in projector pixels along both axes; of one without a period, a
        length that is too large for `levels` to be one."""
        return _REGION + 1

    def observe(self, step: Step, taken: Taken) -> Observation:
        """See `Method`. An incomplete frame is not used; its pattern is averaged over the rest."""
        if not isinstance(step, Expose):
            raise TypeError(f"{self.name} plans no step {step!r}")
        last = taken.sub == step.frames - 1
        if self.spec.bracket is not None:
            after = self._plan[taken.step + 1 : taken.step + 2]
            last = last and not (after and _of_one(step, after[0]))
        return Observation(
            lighting=step.lighting,
            pattern=step.index,
            last=last,
            used=not taken.incomplete,
            reason=INCOMPLETE if taken.incomplete else "",
            exposure=step.exposure,
            exposure_us=taken.exposure_us if self._own_us else 0.0,
        )

    def conclude(self, components: Components) -> Components:
        """See `Method`: with what a bracket, which only patterns have, does for what saturates."""
        components = super().conclude(components)
        saturated = float(np.mean(components.quality & np.uint16(Quality.SATURATED) != 0))
        if self.spec.bracket is not None or saturated <= ADVICE[Quality.SATURATED][0]:
            return components
        advice = [*components.facts.get("advice", ()), _BRACKET]
        return replace(components, facts={**components.facts, "advice": advice})

    def estimator(self) -> Estimator:
        """See `Method`. Exposures of a bracket are merged before the method's own estimator."""
        if self.spec.bracket is None:
            return self._watched(self.response, self.spec.average)
        noise = noise_of(self.spec.radiometry, self.bench)
        return Bracketed(
            self.response,
            lambda response: self._watched(response, 1),
            factors=self.spec.bracket,
            average=self.spec.average,
            own_us=self._own_us,
            sensor=None if noise is None else Sensor(noise[0] ** 2 + ROUNDING, noise[1]),
        )

    def _watched(self, response: Response, average: int) -> Estimator:
        frames = FrameSet(response, even=self.even, distinct=self.distinct)
        creep = Creep(response, len(self._patterns), balanced=self.balanced)
        return Watched(self.separator(response, average), frames, creep)

    @property
    def even(self) -> bool:
        """Whether each pattern gives the scene as a whole the same light."""
        return True

    @property
    def balanced(self) -> bool:
        """Whether the patterns together light each place alike, and are no shifts of one."""
        return True

    @property
    def distinct(self) -> bool:
        """Whether no two patterns are alike."""
        return True

    @abstractmethod
    def separator(self, response: Response, average: int) -> Estimator:
        """A fresh estimator of the method, for `average` frames a pattern and a response to light
        that is the camera's, or that of its merged exposures."""


def _of_one(step: Expose, other: Expose) -> bool:
    """Whether two steps are exposures of one pattern."""
    return (step.lighting, step.index) == (other.lighting, other.index)


class RankedMethod(PatternMethod[P]):
    """A set of two-valued patterns of one lit fraction, of which each pixel's brightest and darkest
    samples tell direct from global."""

    estimators = ("topk", "maxmin", "maxmin-unbiased")

    @property
    def grid(self) -> tuple[int, int] | None:
        """The shape of the grid that the patterns are shifts over, row by row; None: no order."""
        return None

    def weights(self) -> NDArray[np.complex128] | None:
        """What tells the pattern's place at a pixel: see `handedness.WaveSums`. None: nothing."""
        return None

    def separator(self, response: Response, average: int) -> Estimator:
        """See `PatternMethod`. What is asked for; else topk, or max/min where there are too few
        patterns to rank, less the bias of noise where there are enough to know it."""
        name = self.spec.estimator
        few = len(self._patterns) < 2 * KEEP
        if name == "topk" and few:
            raise Unsuitable(
                f"topk ranks {2 * KEEP} patterns at least; take maxmin for {len(self._patterns)}",
                "$.estimator",
            )
        ranked = not (few or name.startswith("maxmin"))
        known = len(self._patterns) >= LEAST_FOR_BLUR
        ordered = len(self._patterns) >= LEAST
        if name == "maxmin-unbiased" and not ordered:
            raise Unsuitable(
                f"the bias of noise takes {LEAST} patterns to know; take maxmin for "
                f"{len(self._patterns)}",
                "$.estimator",
            )
        return Extremes(
            response,
            lit_fraction=self.lit_fraction,
            leakage=self.leakage,
            keep=KEEP if ranked else 1,
            unbiased=ranked or name == "maxmin-unbiased" or (name == "auto" and known),
            average=average,
            levels=self.levels if ordered else None,
            shifts=self.grid,
            weights=self.weights(),
        )
