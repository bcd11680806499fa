"""Separation by the k brightest and k darkest samples of each pixel, k and bias from noise.

The brightest of n samples is too bright by its own noise (§4.1's max/min: 2.7 σ too much direct
light with 25 patterns). The mean of several is less so, and what is left, with what blur takes
away, is known from the pattern set (`order_model`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.handedness import WaveSums
from daemon.separation.order import Ranked
from daemon.separation.order_estimate import (
    KEEP,
    Ends,
    OrderStatistics,
    estimate,
    local_limits,
    places,
)
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.residue import NOT_SHIFTS, of_shifts
from daemon.separation.scan_noise import ScanNoise, Told
from daemon.separation.steadiness import HALF, compare


class TopK:
    """Means of the brightest and darkest samples, less what noise and blur do -> direct, global.

    `levels(blur)` and `even` are as for `OrderStatistics`. Planes: `direct_std`, `global_std`. An
    update is 18 in-place maxima and minima; with `weights` (of `handedness.WaveSums`), by which a
    mirror is found, 4 products and sums more.
    """

    def __init__(
        self,
        response: Response,
        *,
        lit_fraction: float,
        leakage: float,
        levels: Callable[[float], Plane],
        average: int = 1,
        weights: NDArray[np.complex128] | None = None,
        even: bool = True,
    ) -> None:
        self._response = response
        self._alpha = lit_fraction
        self._leakage = leakage
        self._references = References(response)
        self._noise = ScanNoise(response, average)
        self._mean = FrameMean(response) if average > 1 else None
        self._average = average
        self._open: int | None = None
        self._low = Ranked(KEEP, largest=False)
        self._high = Ranked(KEEP, largest=True)
        self._saturated: NDArray[np.bool_] | None = None
        self._waves = None if weights is None else WaveSums(weights)
        self._order = OrderStatistics(levels, even)
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that ranking cannot respect."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("ranking compares frames as they are: no warp, strength 1")
        if not observation.used:
            self._unused += 1
        elif observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
            self._noise.add_reference(pixels, observation.lighting)
            return
        elif self._mean is None:
            if self._low.frames == 0:
                self._noise.add(pixels, observation.pattern)
            self._rank(pixels, observation.pattern)
        else:
            if self._open is not None and self._open != observation.pattern:
                self._close(self._mean)
            self._open = observation.pattern
            self._mean.add(pixels)
            self._noise.add(pixels, observation.pattern)
            clipped = pixels >= self._response.saturated_from
            self._saturated = clipped if self._saturated is None else self._saturated | clipped
        if self._mean is not None and observation.last:
            self._close(self._mean)

    def _close(self, mean: FrameMean) -> None:
        if mean.frames and self._open is not None:
            self._rank(mean.value(), self._open)
        mean.clear()
        self._open = None

    def _rank(self, samples: NDArray[Any], pattern: int) -> None:
        self._low.add(samples)
        self._high.add(samples)
        if self._waves is not None:
            self._waves.add(samples, pattern)

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before two patterns are in; with fewer than two ranks of
        `KEEP` the brightest and the darkest are taken as they are."""
        patterns = self._low.frames
        if patterns < 2:
            raise NotYet(f"ranking needs 2 patterns, {patterns} came so far")
        low, high = self._light(self._low.planes), self._light(self._high.planes)
        ends, told, uneven, unlit_deviation, lit_deviation, found = self._ends(low, high)
        deviation = np.hypot(unlit_deviation, lit_deviation) * np.float32(0.5**0.5)
        lit, unlit = ends.lit, ends.unlit
        rounding = self._response.deviation(None, self._response.counts(high[0]))
        b = self._leakage
        g = light_model.global_weight(self._alpha, b)
        moved: NDArray[np.uint16] | None = None
        steady: dict[str, Any] = {}
        advice: list[str] = []
        if abs(self._alpha - 0.5) < HALF:
            middle = (lit + unlit) * np.float32(0.5)
            moved, steady, advice = compare(self._references, middle, deviation, b, ranked=True)
        ambient, source = self._references.ambient(lit, unlit, self._alpha, b)
        if ambient is not None:
            lit, unlit = lit - ambient, unlit - ambient
        direct, indirect = light_model.from_extremes(lit, unlit, self._alpha, b)
        direct_var, global_var = ends.variances(b, g, uneven)
        reference = self._references.ambient_variance(told)
        if reference is not None:
            global_var += reference * np.float32(g**-2)
        whole, clipped = self._references.whole(b), self._references.white_saturated
        if whole is not None and clipped is not None:
            # W - K holds half as much noise of the references as the darkest samples less K; but
            # where bright light has more noise than dark, these have less
            source = whole.source
            alone = direct_var + self._references.whole_variance(told, b)
            better = ~clipped & (alone < global_var)
            np.copyto(indirect, whole.light - direct, where=better)
            np.copyto(global_var, alone, where=better)
        planes: dict[str, NDArray[Any]] = {
            "direct_std": np.sqrt(direct_var),
            "global_std": np.sqrt(global_var),
        }
        saturated = self._saturated
        if saturated is None:
            saturated = self._high.planes[0] >= self._response.saturated_from
        # ranks hold counts, averages light: near enough for a limit
        mirrored, looked, as_declared = of_shifts(self._waves, deviation)
        flags = np.zeros(direct.shape[:2], dtype=np.uint16) if moved is None else moved
        if mirrored is not None:
            flags |= bits(mirrored, Quality.RESIDUE)
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=high[0],
            saturated=saturated,
            flags=flags,
            judgement=Judgement(
                direct=np.float32(SIGNIFICANT) * np.maximum(planes["direct_std"], rounding),
                total=np.float32(SIGNIFICANT) * np.maximum(planes["global_std"], rounding),
                deviation=deviation * np.float32(1.0 / uneven),
            ),
            planes=planes,
            facts={
                "estimator": "topk",
                "patterns": patterns,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": b,
                **found,
                **told.facts(),
                **looked,
                **steady,
                "advice": ([] if as_declared else [NOT_SHIFTS]) + advice + told.advice(),
                **self._references.facts(source),
            },
        )

    def _light(self, samples: NDArray[Any]) -> Plane:
        return self._response.linear(samples) if self._mean is None else samples

    def _ends(
        self, low: Plane, high: Plane
    ) -> tuple[Ends, Told, float, Plane, Plane, dict[str, Any]]:
        """Lit and unlit light; what is known of noise, how many times it samples differ by, and
        that for an unlit and for a lit sample; facts."""
        if self._low.frames < 2 * KEEP:
            told = self._noise.told()
            dark, lit = told.deviation(low[0]), told.deviation(high[0])
            none = np.zeros_like(lit)
            ends = Ends(high[0], low[0], np.square(lit), np.square(dark), none)
            return ends, told, 1.0, dark, lit, {"blur_px": None}
        at = places(low[0].size)
        darkest, brightest = (ranks.reshape(KEEP, -1)[:, at] for ranks in (low, high))
        explained = self._order.explain(
            darkest, brightest, self._noise, self._response, self._average
        )
        limits = local_limits(low, high)
        dark, lit = (
            np.minimum(deviation, limit, out=deviation)
            for deviation, limit in zip(explained.deviations(low, high), limits, strict=True)
        )
        ends = estimate(explained.model, low, high, dark, lit)
        g = light_model.global_weight(self._alpha, self._leakage)
        systematic = explained.systematic(ends, lit, self._leakage, g)
        facts = {
            "blur_px": explained.blur,
            "samples_averaged": systematic["samples_averaged"],
            "spread_of_place": systematic["spread_of_place"],
        }
        return ends, explained.told, explained.uneven, dark, lit, facts

    def summary(self) -> dict[str, float]:
        """Patterns ranked and frames not used."""
        return {"patterns": float(self._low.frames), "unused": float(self._unused)}
