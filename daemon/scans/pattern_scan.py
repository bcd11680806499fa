"""What all scans of a fixed pattern set share: references, then the patterns, then the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.method import Bench, Expose, Method, Step, Taken, Unsuitable
from daemon.separation.estimator import Estimator, Lighting, Observation
from daemon.separation.extremes import MaxMin
from daemon.separation.noise import Noise
from daemon.separation.order_estimate import KEEP, RANKS
from daemon.separation.radiometry import Response
from daemon.separation.topk import TopK
from protocol.patterns import BLACK, WHITE, AnyPattern
from protocol.scans import PatternScan, Radiometry, Reference

_PLACES, _MARGIN, _SAMPLES = 96, 8, 1500

P = TypeVar("P", bound=PatternScan)

REFERENCES: dict[Reference, tuple[AnyPattern | None, Lighting]] = {
    Reference.AMBIENT: (None, Lighting.AMBIENT),
    Reference.BLACK: (BLACK, Lighting.BLACK),
    Reference.WHITE: (WHITE, Lighting.WHITE),
    Reference.OPEN: (None, Lighting.OPEN),
}


def response_of(radiometry: Radiometry, bench: Bench) -> Response:
    """How this camera's counts follow from light: as asked for, else as calibrated, else as the
    camera says. Raises Unsuitable for numbers that don't fit the camera."""
    calibration = bench.calibration or {}
    black = radiometry.black
    if black is None:
        black = float(calibration.get("black", bench.camera.black_level))
    pixel_format = bench.camera.pixel_format
    try:
        return Response(
            full_scale=pixel_format.full_scale,
            black=black,
            tone=radiometry.tone,
            saturation=radiometry.saturation,
            bayer=pixel_format.bayer,
            noise=_noise_of(radiometry, bench, black),
        )
    except ValueError as error:
        raise Unsuitable(str(error), "$.radiometry") from error


def _noise_of(radiometry: Radiometry, bench: Bench, black: float) -> Noise | None:
    """As calibrated; None where it is not, or where counts are encoded, for it is of light."""
    found = (bench.calibration or {}).get("noise")
    if found is None or radiometry.tone != "linear":
        return None
    return Noise.of_read_and_shot(
        float(found["read_counts"]),
        float(found["counts_per_e"]),
        black,
        bench.camera.pixel_format.full_scale,
    )


def leakage_of(radiometry: Radiometry, bench: Bench) -> float:
    """b: as asked for, else as calibrated, else none."""
    if radiometry.leakage is not None:
        return radiometry.leakage
    return float((bench.calibration or {}).get("leakage", 0.0))


class PatternMethod(Method[P]):
    """References first, then each pattern once, `average` frames each.

    `estimators` are those that a method has; the first is what auto chooses.

    On a recording a reference is one image, and only those named in the spec are there.
    """

    estimators: ClassVar[tuple[str, ...]] = ("maxmin",)

    def __init__(self, spec: P, bench: Bench, pattern_set: Sequence[AnyPattern]) -> None:
        super().__init__(spec, bench)
        if spec.estimator not in {"auto", *self.estimators}:
            raise Unsuitable(
                f"{self.name} has no estimator {spec.estimator}: {', '.join(self.estimators)}",
                "$.estimator",
            )
        self.response = response_of(spec.radiometry, bench)
        self.leakage = leakage_of(spec.radiometry, bench)
        self._plan = (*self._references(), *self._exposures(pattern_set))
        self._patterns = tuple(pattern_set)
        self._check()

    def _references(self) -> list[Expose]:
        wanted = self.spec.references
        recorded = self.bench.camera.recorded
        if wanted is None:
            wanted = () if recorded else (Reference.BLACK, Reference.WHITE)
        frames = 1 if recorded else self.spec.average
        return [
            Expose(pattern, lighting, frames=frames)
            for pattern, lighting in (REFERENCES[name] for name in wanted)
        ]

    def _exposures(self, pattern_set: Sequence[AnyPattern]) -> list[Expose]:
        return [
            Expose(pattern, Lighting.PATTERN, index, self.spec.average)
            for index, pattern in enumerate(pattern_set)
        ]

    def _check(self) -> None:
        camera = self.bench.camera
        if not camera.recorded:
            if self.bench.projector is None:
                raise Unsuitable(
                    f"{self.name} needs a projector, and this rig has none: name one under "
                    "[projector] in rig.toml"
                )
            return
        planned = self.planned()
        if camera.frame_count is not None and camera.frame_count != planned:
            raise Unsuitable(
                f"the folder has {camera.frame_count} images; {self.counted()}", "$.references"
            )

    def counted(self) -> str:
        """How the number of frames comes about and how to change it, for people."""
        references = [step for step in self._plan if step.lighting is not Lighting.PATTERN]
        parts = [self.described()]
        if self.spec.average > 1:
            parts.append(f"{self.spec.average} averaged a pattern")
        if references:
            parts.append(f"with {', '.join(step.lighting for step in references)} first")
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
        rng = np.random.default_rng(0)
        rows, columns = rng.integers(_MARGIN, side - _MARGIN, (2, _SAMPLES))
        found = np.empty((len(self._patterns), _SAMPLES), dtype=np.float32)
        for index, pattern in enumerate(self._patterns):
            image = patterns.render(pattern, side, side).astype(np.float32) / patterns.LEVELS
            if blur:
                image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur), dtype=np.float32)
            found[index] = image[rows, columns]
        return found

    def planned(self) -> int:
        """Frames of the whole plan."""
        return sum(step.frames for step in self._plan)

    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """See `Method`."""
        del summary  # the plan is fixed
        return self._plan[index] if index < len(self._plan) else None

    def observe(self, step: Step, taken: Taken) -> Observation:
        """See `Method`. An incomplete frame is not used; its pattern is averaged over the rest."""
        if not isinstance(step, Expose):
            raise TypeError(f"{self.name} plans no step {step!r}")
        return Observation(
            lighting=step.lighting,
            pattern=step.index,
            last=taken.sub == step.frames - 1,
            used=not taken.incomplete,
            reason="incomplete frame" if taken.incomplete else "",
        )


class RankedMethod(PatternMethod[P]):
    """A set of two-valued patterns of one lit fraction, of which each pixel's brightest and darkest
    samples tell direct from global."""

    estimators = ("topk", "maxmin", "maxmin-unbiased")

    even: ClassVar[bool] = True
    """Whether each pattern lights as much of any neighbourhood."""

    def weights(self) -> NDArray[np.complex128] | None:
        """What tells the pattern's place at a pixel: see `handedness.WaveSums`. None: nothing."""
        return None

    def ranking(self) -> Estimator:
        """What is asked for; else topk, or max/min where there are too few patterns to rank, less
        the bias of noise where there are enough to know it."""
        name = self.spec.estimator
        few = len(self._patterns) < 2 * KEEP
        if name == "topk" and few:
            raise Unsuitable(
                f"topk ranks {2 * KEEP} patterns at least; take maxmin for {len(self._patterns)}",
                "$.estimator",
            )
        if name.startswith("maxmin") or few:
            known = len(self._patterns) >= 2 * RANKS
            return MaxMin(
                self.response,
                lit_fraction=self.lit_fraction,
                leakage=self.leakage,
                average=self.spec.average,
                levels=self.levels,
                even=self.even,
                unbiased=name == "maxmin-unbiased" or (name == "auto" and known),
            )
        return TopK(
            self.response,
            lit_fraction=self.lit_fraction,
            leakage=self.leakage,
            levels=self.levels,
            average=self.spec.average,
            weights=self.weights(),
            even=self.even,
        )
