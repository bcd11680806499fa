"""Separation by each pixel's brightest and darkest samples: the paper's own (§3.3, §4.1), and less
what noise and blur do to them.

Samples are compared in the camera's own type, where nothing wraps and nothing is converted; light
is computed once, at the result. The brightest of n samples is too bright by its own noise (2.7 σ
too much direct light with 25 patterns), the mean of several less so, and what is left, with what
blur takes away, is known from the pattern set (`order_estimate`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.deviation import stated
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.handedness import WaveSums
from daemon.separation.order import Ranked
from daemon.separation.order_estimate import LEAST_FOR_BLUR, Estimated, OrderStatistics
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.residue import NOT_SHIFTS, Mirrors, in_order, misfit_of, of_shifts
from daemon.separation.scan_noise import ScanNoise, Told
from daemon.separation.steadiness import HALF, compare
from daemon.separation.uneven import unevenness
from daemon.separation.unsmooth import Unsmooth

NOT_LIT_OR_UNLIT = (
    "nearly every pixel has many samples between its darkest and its brightest: the frames are no "
    "patterns of lit and unlit patches (sinusoids are a method of their own, -m sinusoid), or the "
    "patches are so blurred that hardly a pixel is in one (--patch)"
)
_FEW = (
    "{} patterns do not tell how much the projector blurs: beside edges of the patterns direct is "
    "too small by more than the stated deviation; {} patterns tell (--patterns, --shifts)"
)


class Extremes:
    """Lit and unlit light over patterns of one lit fraction -> direct, global (Eq. 8).

    Of each pixel the `keep` brightest and darkest samples are kept: 1 for max/min, at one in-place
    maximum and one minimum a frame, else 2 `keep` - 1 of each. With `levels` and `shifts` (of
    `OrderStatistics`) there are the planes `direct_std` and `global_std`, and the bias of noise and
    blur is stated; it is taken off if `unbiased`. With `average` > 1 the frames of each pattern are
    averaged in linear light before they are compared; a pattern counts once its last frame is in.
    With `weights` (of `handedness.WaveSums`: 4 products and sums a frame) a mirror is found.

    What the last patterns change little, the noise and the mirrors, is looked at while they come,
    so that the result is ready soon after the last.
    """

    def __init__(
        self,
        response: Response,
        *,
        lit_fraction: float,
        leakage: float,
        keep: int = 1,
        unbiased: bool = False,
        average: int = 1,
        levels: Callable[[float], Plane] | None = None,
        shifts: tuple[int, int] | None = None,
        weights: NDArray[np.complex128] | None = None,
    ) -> None:
        if (unbiased or keep > 1) and levels is None:
            raise ValueError("the bias of noise follows from the levels of the pattern set")
        self._response = response
        self._alpha = lit_fraction
        self._leakage = leakage
        self._unbiased = unbiased
        self._low = Ranked(keep, largest=False)
        self._high = Ranked(keep, largest=True)
        self._waves = None if weights is None else WaveSums(weights)
        self._order = None if levels is None else OrderStatistics(levels, response, average, shifts)
        self._shifted = shifts is not None
        self._ordered = shifts is None  # as far as is known
        self._references = References(response)
        self._noise = ScanNoise(response, average)
        self._mean = FrameMean(response) if average > 1 else None
        self._open: int | None = None  # the pattern being averaged
        self._saturated: NDArray[np.bool_] | None = None  # of averaged frames; else the max tells
        self._mirrors: Mirrors | None = None
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that comparing cannot respect."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("frames are compared as they are: no warp, strength 1")
        if not observation.used:
            self._unused += 1
        elif observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
            self._noise.add_reference(pixels, observation.lighting)
            return
        elif self._mean is None:
            if self._low.frames == 0:
                self._noise.add(pixels, observation.pattern)
            self._compare(pixels, observation.pattern)
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
            self._compare(mean.value(), self._open)
        mean.clear()
        self._open = None

    def _compare(self, samples: NDArray[Any], pattern: int) -> None:
        self._low.add(samples)
        self._high.add(samples)
        if self._order is not None:
            self._order.add(samples, pattern)
        if self._waves is not None and self._mirrors is None:
            self._waves.add(samples, pattern)
            if self._waves.complete:
                if self._order is not None:
                    self._order.look()
                self._mirrors = self._mirrored()
                self._waves = None

    def _told(self) -> Told:
        if self._order is None:
            return self._noise.told()
        return self._order.told(self._noise, ordered=self._ordered)

    def _mirrored(self) -> Mirrors:
        """Where the pattern came by way of a mirror, by what is known of noise; and whether shifts
        came in their order, so that what they have not in common is noise."""
        misfit = None
        if self._shifted:
            misfit = misfit_of(self._waves, self._deviation(self._noise.told()))
            self._ordered = in_order(misfit)
        return of_shifts(self._waves, self._deviation(self._told()), misfit)

    def _deviation(self, told: Told) -> Plane:
        ends = (self._light(ranked.planes[-1]) for ranked in (self._low, self._high))
        squares = (np.square(told.deviation(end)) for end in ends)
        return np.asarray(np.sqrt(sum(squares) * np.float32(0.5)))

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before two patterns are in; with fewer than two for each
        sample that is kept, the brightest and the darkest are taken as they are."""
        patterns = self._low.frames
        if patterns < 2:
            raise NotYet(f"the brightest and the darkest take 2 patterns, {patterns} came so far")
        low, high = self._light(self._low.planes), self._light(self._high.planes)
        told = self._told()
        found = None
        if self._order is not None and patterns >= 2 * self._low.keep:
            found = self._order.estimate(low, high, told)
        deviation = told.deviation(high[0]) if found is None else found.deviation
        unbiased = self._unbiased and found is not None
        lit, unlit = (found.lit, found.unlit) if unbiased and found else (high[0], low[0])

        b, g = self._leakage, light_model.global_weight(self._alpha, self._leakage)
        flags: NDArray[np.uint16] | None = None
        steady: dict[str, Any] = {}
        advice: list[str] = []
        if abs(self._alpha - 0.5) < HALF:
            middle = (lit + unlit) * np.float32(0.5)
            flags, steady, advice = compare(self._references, middle, deviation, b, ranked=True)
        ambient, source = self._references.ambient(lit, unlit, self._alpha, b)
        if ambient is not None:
            lit, unlit = lit - ambient, unlit - ambient
        direct, indirect = light_model.from_extremes(lit, unlit, self._alpha, b)
        planes: dict[str, NDArray[Any]] = {}
        judgement = Judgement.of_extremes(deviation, patterns)
        facts: dict[str, Any] = {}
        if found is not None:
            direct_var, global_var = self._variances(found, told)
            if unbiased:
                source = self._better(told, direct, indirect, direct_var, global_var) or source
            noises = np.sqrt(direct_var), np.sqrt(global_var)
            facts = {"blur_px": found.blur, **found.systematic(b, g, biased=not unbiased)}
            if unbiased:
                rounding = self._response.deviation(None, self._response.counts(high[0]))
                direct_limit, total_limit = (
                    np.float32(SIGNIFICANT) * np.maximum(plane, rounding) for plane in noises
                )
                own = deviation * np.float32(1.0 / found.uneven)
                judgement = Judgement(direct_limit, total_limit, own)
            uneven = self._uneven(low, high, found, noises)
            planes = stated(*noises, found.off(b, None if unbiased else direct), uneven.off)
            advice += uneven.advice
            flags = uneven.flags if flags is None else flags | uneven.flags
        saturated = self._saturated
        if saturated is None:
            saturated = self._high.planes[0] >= self._response.saturated_from
        mirrors = self._mirrors or of_shifts(None, deviation, None)
        if mirrors.mask is not None:
            mirror = bits(mirrors.mask, Quality.RESIDUE)
            flags = mirror if flags is None else flags | mirror
        name = "topk" if self._low.keep > 1 else "maxmin-unbiased" if self._unbiased else "maxmin"
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=high[0],
            saturated=saturated,
            flags=flags,
            judgement=judgement,
            planes=planes,
            facts={
                "estimator": name,
                "patterns": patterns,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": b,
                **told.facts(),
                **facts,
                **mirrors.facts,
                **steady,
                "advice": [
                    *self._declared(mirrors, told),
                    *([_FEW.format(patterns, LEAST_FOR_BLUR)] if patterns < LEAST_FOR_BLUR else []),
                    *advice,
                    *told.advice(),
                ],
                **self._references.facts(source),
            },
        )

    def _declared(self, mirrors: Mirrors, told: Told) -> list[str]:
        """A line where the frames are not the patterns that were declared."""
        if not mirrors.as_declared:
            return [NOT_SHIFTS]
        if self._shifted or self._order is None or self._order.of_two_levels(told):
            return []
        return [NOT_LIT_OR_UNLIT]

    def _light(self, samples: NDArray[Any]) -> Plane:
        return self._response.linear(samples) if self._mean is None else samples

    def _uneven(
        self, low: Plane, high: Plane, found: Estimated, noises: tuple[Plane, Plane]
    ) -> Unsmooth:
        if len(low) == 1:
            return Unsmooth.unknown(low[0])
        # Noise is measured where light is bright. Where it is not, a count says nothing: files of
        # 8 bits are often of fewer.
        count = self._response.slope(self._response.counts(high[0]))
        noise = np.maximum(found.deviation * np.float32(1.0 / found.uneven), count)
        return unevenness(
            low, high, noise, np.maximum(*noises), self._low.frames, shifted=self._shifted
        )

    def _variances(self, found: Estimated, told: Told) -> tuple[Plane, Plane]:
        """Of direct and of global light: of noise, that of the references included, and of the
        rounding of counts that all samples share."""
        g = light_model.global_weight(self._alpha, self._leakage)
        direct, indirect = found.variances(self._leakage, g)
        dark = told.rounding(found.unlit)
        direct += (dark + told.rounding(found.lit)) * np.float32((1.0 - self._leakage) ** -2)
        indirect += dark * np.float32(g**-2)
        reference = self._references.ambient_variance(told)
        if reference is not None:
            indirect += reference * np.float32(g**-2)
        return direct, indirect

    def _better(
        self, told: Told, direct: Plane, indirect: Plane, direct_var: Plane, global_var: Plane
    ) -> str | None:
        """Where a white frame less a black one tells global light with less noise than the darkest
        samples less the black one, its light and its variance, in place; from what it is known."""
        whole = self._references.whole(self._leakage)
        clipped = self._references.white_saturated
        if whole is None or clipped is None:
            return None
        alone = direct_var + self._references.whole_variance(told, self._leakage)
        better = ~clipped & (alone < global_var)
        np.copyto(indirect, whole.light - direct, where=better)
        np.copyto(global_var, alone, where=better)
        return whole.source

    def summary(self) -> dict[str, float]:
        """Patterns compared and frames not used."""
        return {"patterns": float(self._low.frames), "unused": float(self._unused)}
