"""Separation by the brightest and the darkest sample of each pixel: the paper's own (§3.3, §4.1).

Samples are compared in the camera's own type, where nothing wraps and nothing is converted; light
is computed once, at the result. An update is one in-place maximum and one minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import Judgement, bits, finish
from daemon.separation.handedness import WaveSums
from daemon.separation.order_estimate import Explained, Followed, OrderStatistics, estimate
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.residue import NOT_SHIFTS, of_shifts
from daemon.separation.scan_noise import ScanNoise
from daemon.separation.steadiness import HALF, compare


class MaxMin:
    """L_max and L_min over patterns of one lit fraction -> direct, global (Eq. 8).

    With `average` > 1 the frames of each pattern are averaged in linear light before they are
    compared; a pattern counts once its last frame is in. `levels` and `even` are as for `TopK`:
    with them there are the planes `direct_std` and `global_std`, and the bias of noise and of blur
    is stated; it is taken off only if `unbiased`. With `weights` (of `handedness.WaveSums`) a
    mirror is found.
    """

    def __init__(
        self,
        response: Response,
        *,
        lit_fraction: float,
        leakage: float,
        average: int = 1,
        levels: Callable[[float], Plane] | None = None,
        weights: NDArray[np.complex128] | None = None,
        even: bool = True,
        unbiased: bool = False,
    ) -> None:
        if unbiased and levels is None:
            raise ValueError("the bias of noise follows from the levels of the pattern set")
        self._waves = None if weights is None else WaveSums(weights)
        self._order = None if levels is None else OrderStatistics(levels, even)
        self._followed = None if self._order is None else Followed(self._order.keep)
        self._unbiased = unbiased
        self._average_of = average
        self._response = response
        self._alpha = lit_fraction
        self._leakage = leakage
        self._references = References(response)
        self._mean = FrameMean(response) if average > 1 else None
        self._noise = ScanNoise(response, average)
        self._open: int | None = None  # the pattern being averaged
        self._max: NDArray[Any] | None = None
        self._min: NDArray[Any] | None = None
        self._saturated: NDArray[np.bool_] | None = None  # of averaged frames; else the max tells
        self._patterns = 0
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that comparing cannot respect."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("max/min compares frames as they are: no warp, strength 1")
        if observation.lighting is not Lighting.PATTERN:
            if observation.used:
                self._references.add(pixels, observation.lighting)
                self._noise.add_reference(pixels, observation.lighting)
            else:
                self._unused += 1
            return
        if self._mean is None:
            if observation.used:
                if self._max is None:
                    self._noise.add(pixels, observation.pattern)
                self._compare(pixels, observation.pattern)
            else:
                self._unused += 1
            return
        self._average(self._mean, pixels, observation)

    def _average(self, mean: FrameMean, pixels: NDArray[Any], observation: Observation) -> None:
        if self._open is not None and self._open != observation.pattern:
            self._close(mean)
        self._open = observation.pattern
        if observation.used:
            mean.add(pixels)
            self._noise.add(pixels, observation.pattern)
            if self._saturated is None:
                self._saturated = np.zeros(pixels.shape, dtype=np.bool_)
            self._saturated |= pixels >= self._response.saturated_from
        else:
            self._unused += 1
        if observation.last:
            self._close(mean)

    def _close(self, mean: FrameMean) -> None:
        if mean.frames and self._open is not None:
            self._compare(mean.value(), self._open)
        mean.clear()
        self._open = None

    def _compare(self, samples: NDArray[Any], pattern: int) -> None:
        if self._waves is not None:
            self._waves.add(samples, pattern)
        if self._max is None or self._min is None:
            self._max, self._min = samples.copy(), samples.copy()
        else:
            np.maximum(self._max, samples, out=self._max)
            np.minimum(self._min, samples, out=self._min)
        if self._followed is not None:
            self._followed.add(samples)
        self._patterns += 1

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before two patterns are in."""
        if self._max is None or self._min is None or self._patterns < 2:
            raise NotYet(f"max/min needs 2 patterns, {self._patterns} came so far")
        brightest, darkest = self._light(self._max), self._light(self._min)
        saturated = self._saturated
        if saturated is None:
            saturated = self._max >= self._response.saturated_from
        explained = self._explained()
        told = self._noise.told() if explained is None else explained.told
        deviation, b = told.deviation(brightest), self._leakage
        g = light_model.global_weight(self._alpha, b)
        lit, unlit = brightest, darkest
        planes: dict[str, NDArray[Any]] = {}
        found: dict[str, Any] = {}
        if explained is not None:
            low, high = darkest[None], brightest[None]
            dark, deviation = explained.deviations(low, high)
            ends = estimate(explained.model, low, high, dark, deviation, k=1)
            direct_var, global_var = ends.variances(b, g, explained.uneven)
            reference = self._references.ambient_variance(told)
            if reference is not None:
                global_var += reference * np.float32(g**-2)
            planes = {"direct_std": np.sqrt(direct_var), "global_std": np.sqrt(global_var)}
            found = {"blur_px": explained.blur, **explained.systematic(ends, deviation, b, g, k=1)}
            if self._unbiased:
                lit, unlit = ends.lit, ends.unlit
        ambient, source = self._references.ambient(lit, unlit, self._alpha, b)
        if ambient is not None:
            lit, unlit = lit - ambient, unlit - ambient
        direct, indirect = light_model.from_extremes(lit, unlit, self._alpha, b)
        moved: NDArray[np.uint16] | None = None
        steady: dict[str, Any] = {}
        advice: list[str] = []
        if abs(self._alpha - 0.5) < HALF:
            middle = (brightest + darkest) * np.float32(0.5)
            moved, steady, advice = compare(self._references, middle, deviation, b, ranked=True)
        mirrored, looked, as_declared = of_shifts(self._waves, deviation)
        flags = np.zeros(direct.shape[:2], dtype=np.uint16) if moved is None else moved
        if mirrored is not None:
            flags |= bits(mirrored, Quality.RESIDUE)
        return finish(
            direct,
            indirect,
            planes=planes,
            response=self._response,
            brightest=brightest,
            saturated=saturated,
            flags=flags,
            judgement=Judgement.of_extremes(deviation, self._patterns),
            facts={
                "estimator": "maxmin-unbiased" if self._unbiased else "maxmin",
                "patterns": self._patterns,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": b,
                **told.facts(),
                **found,
                **looked,
                **steady,
                **self._references.facts(source),
                "advice": ([] if as_declared else [NOT_SHIFTS]) + advice + told.advice(),
            },
        )

    def _explained(self) -> Explained | None:
        """Blur and noise; None where the levels of the pattern set are not known."""
        if self._order is None or self._followed is None:
            return None
        low, high = (self._light(ranks) for ranks in self._followed.ranks())
        return self._order.explain(low, high, self._noise, self._response, self._average_of)

    def _light(self, samples: NDArray[Any]) -> Plane:
        return self._response.linear(samples) if self._mean is None else samples

    def summary(self) -> dict[str, float]:
        """Patterns compared and frames not used."""
        return {"patterns": float(self._patterns), "unused": float(self._unused)}
