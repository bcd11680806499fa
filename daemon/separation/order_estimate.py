"""Lit and unlit light from the most extreme of a pixel's samples, without what noise and blur do.

Of some pixels all samples are kept (`followed`). They tell the noise; and once that is known, the
distances between their ranked samples tell the blur. What noise and blur do to the most extreme
samples is simulated for the pattern set at hand (`order_model`), and taken off at each pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.followed import Followed
from daemon.separation.noise import Noise
from daemon.separation.order_model import RATIOS, OrderErrors, OrderModels
from daemon.separation.radiometry import Plane, Response
from daemon.separation.sampling import thinned
from daemon.separation.scan_noise import ScanNoise, Told

KEEP = 5
"""Samples kept at each end; a checkerboard's 25 shifts light every pixel wholly in 9 or more."""

_RANKS = 3  # samples at each end at least: fewer do not tell blur

LEAST_FOR_BLUR = 2 * _RANKS
"""Patterns that tell blur."""

LEAST = 4
"""Patterns of which something is known of order: with fewer, there is one sample at an end."""

_PLACE = ("lit_place", "unlit_place", "shared_place")
_GROUPS = 8  # of pixels, by their light
_LEAST = 32  # pixels that make a group
_DIM = 0.2  # of the brightest pixels' step: with less, a pixel is not looked at
_TOLD = 10.0  # deviations of noise, of a step whose samples are looked at
_BETWEEN = 0.16  # of a place's samples: a wave has a third of them in the middle half of its step
_WITHIN = 1.5  # times the distance of the kept ranks from an end of the scale, to be clear of it
_FINE = 640  # ratios of noise and step that are told apart, evenly in their logarithm
_FIRST = 1.6  # deviations that the first of a dozen samples is off
_TINY = np.float32(1e-6)
_HALF = np.float32(0.5)


class OrderStatistics:
    """The ranks of a pattern set's samples: what is known of them beforehand, and what the pixels
    that are followed show.

    `levels(blur)` gives the set's levels for `order_model.OrderModels`; `shifts` is as for
    `Followed`: without them patterns do not light as much of every neighbourhood each.
    """

    def __init__(
        self,
        levels: Callable[[float], Plane],
        response: Response,
        average: int = 1,
        shifts: tuple[int, int] | None = None,
    ) -> None:
        patterns = levels(0.0).shape[0]
        self._uneven = shifts is None
        self._response = response
        self._average = average
        self._keep = max(min(KEEP, patterns // 2), 1)
        self._models = OrderModels(levels, self._keep)  # now, and not when the last frame is in
        self._followed = Followed(patterns, shifts, response)
        self._residual: Noise | None = None

    def add(self, samples: NDArray[Any], pattern: int) -> None:
        """Take in a pattern's samples: counts, or averaged light."""
        self._followed.add(samples, pattern)

    def look(self) -> None:
        """Find the noise in what came so far, for good: the rest would change it little."""
        self._residual = self._noise()

    def _noise(self) -> Noise | None:
        return self._followed.noise(self._followed.light(), self._average)

    def told(self, noise: ScanNoise, *, ordered: bool) -> Told:
        """What is known of the noise by now; `ordered`: patterns came in their order, if any."""
        return noise.told(self._residual or self._noise(), ordered=ordered)

    def of_two_levels(self, told: Told) -> bool:
        """Whether the samples followed can be lit and unlit ones: under patterns of many levels
        samples of nearly every place lie between its darkest and its brightest."""
        light = self._followed.light()
        low, high = light.min(axis=0), light.max(axis=0)
        step = high - low
        seen = step > np.maximum(_DIM * np.quantile(step, 0.9), _TOLD * told.deviation(high))
        if np.count_nonzero(seen) < _LEAST:
            return True
        quarter = np.float32(0.25) * step
        between = np.mean((light > low + quarter) & (light < high - quarter), axis=0)
        return float(np.quantile(between[seen], 0.1)) < _BETWEEN

    def estimate(self, low: Plane, high: Plane, told: Told) -> Estimated:
        """Lit and unlit light of each pixel, from the light (keep, ...) of its darkest and its
        brightest samples, the most extreme first; with `keep` 1 of these, else of the best k."""
        blur, model, uneven = self._explained(told)
        by = np.float32(uneven)
        if len(low) > 1:
            # The darkest sample is darker than unlit light by noise, and so are its shot noise and
            # the brightest's: the level that counts is that of the last of the ranks.
            dark, lit = (told.deviation(ranks[-1]) * by for ranks in (low, high))
            dark, lit = (
                np.minimum(deviation, limit, out=deviation)
                for deviation, limit in zip((dark, lit), _local_limits(low, high), strict=True)
            )
        else:  # or one by as much off
            off = np.float32(_FIRST * uneven)
            dark = told.deviation(low[0] + off * told.deviation(low[0])) * by
            lit = told.deviation(high[0] - off * told.deviation(high[0])) * by
        return _estimated(blur, model, uneven, (low, high), (dark, lit))

    def _explained(self, told: Told) -> tuple[float | None, OrderErrors, float]:
        """What explains the distances between the ranks of the samples that are followed: the blur
        (None: not known), the errors that it makes together with the noise, and by how many times
        their noise samples differ."""
        light = self._followed.light()
        groups = None
        if len(light) >= LEAST_FOR_BLUR:
            groups = _grouped(np.sort(light, axis=0), self._keep, self._response)
        if groups is None:
            return None, self._models.at(0.0)[1], 1.0
        deviation = told.deviation(groups.light.astype(np.float32)).astype(np.float64)
        ratios = np.maximum(deviation, 1e-3) / groups.steps[:, None]
        place, uneven = self._models.fit(groups.gaps, ratios, groups.used, uneven=self._uneven)
        return *self._models.at(place), uneven


@dataclass(frozen=True, slots=True)
class _Groups:
    """Pixels alike in light: the mean distances of their ranks (groups, 2, keep - 1) by the raw
    step (groups); light of lit and unlit samples (groups, 2), and which of the two (groups, 2) have
    all of their noise."""

    gaps: NDArray[np.float64]
    steps: NDArray[np.float64]
    light: NDArray[np.float64]
    used: NDArray[np.bool_]


def _grouped(ranks: Plane, keep: int, response: Response) -> _Groups | None:
    """Groups of the pixels whose samples (patterns, places) these are, in ascending order; None of
    too few."""
    low, high = ranks[:keep], ranks[: -keep - 1 : -1]
    step = (high[:2].sum(axis=0) - low[:2].sum(axis=0)) * _HALF
    lit = np.flatnonzero(step > _DIM * np.quantile(step, 0.9))
    # by the light of all patterns together, which hardly tells where in them a pixel lies
    by_light = lit[np.argsort(ranks[:, lit].mean(axis=0), kind="stable")]
    count = min(_GROUPS, by_light.size // _LEAST)
    if not count:
        return None
    low, high = low[:, by_light], high[:, by_light]
    apart = np.stack([high[:1] - high[1:], low[1:] - low[:1]])
    starts = np.arange(count) * by_light.size // count
    size = np.diff(starts, append=by_light.size).astype(np.float64)

    def means(of: Plane) -> NDArray[np.float64]:
        found = np.add.reduceat(of, starts, axis=-1, dtype=np.float64) / size
        return np.moveaxis(found, -1, 0)

    steps = np.maximum(means(step[by_light]), 1e-6)
    gaps = means(apart) / steps[:, None, None]
    light = means(np.stack([high[1], low[1]]))
    # light at an end of the scale has its noise cut off there, and says nothing of it
    ends = response.linear_between(np.array([response.saturated_from, 0.0], dtype=np.float32))
    used = np.abs(light - ends) > _WITHIN * gaps[:, :, -1] * steps[:, None]
    if not used.any():
        used[:] = True
    there = used.any(axis=1)
    return _Groups(gaps[there], steps[there], light[there], used[there])


@dataclass(frozen=True, slots=True)
class Estimated:
    """Lit and unlit light of each sample, the variances of their noise, and their covariance.

    `deviation`: what a sample differs by, lit and unlit taken together; `uneven`: how many times
    its noise that is; `blur` in projector pixels, None where it is not known; `k`: the number of
    samples averaged, None where it differs.
    """

    lit: Plane
    unlit: Plane
    lit_var: Plane
    unlit_var: Plane
    shared: Plane
    blur: float | None
    uneven: float
    deviation: Plane
    model: OrderErrors
    k: int | None

    def variances(self, b: float, g: float) -> tuple[Plane, Plane]:
        """Of L_d and L_g: L_d = (lit - unlit)/(1 - b), L_g = (unlit - b lit)/((1 - b) g); of noise
        alone, not of what more samples differ by."""
        direct = self.lit_var + self.unlit_var
        direct -= np.float32(2.0) * self.shared
        direct *= np.float32(((1.0 - b) * self.uneven) ** -2)
        indirect = self.unlit_var + np.float32(b * b) * self.lit_var
        indirect -= np.float32(2.0 * b) * self.shared
        indirect *= np.float32(((1.0 - b) * g * self.uneven) ** -2)
        return np.maximum(direct, 0, out=direct), np.maximum(indirect, 0, out=indirect)

    def off(self, b: float, biased: Plane | None) -> Plane:
        """How far components may be off, as a deviation, by where a pixel lies in the pattern (that
        of a pixel like most, as a part of its step: what direct light lacks global light has), and
        by what noise and blur left in direct light if it is `biased`."""
        step: Plane = np.maximum(self.lit - self.unlit, np.float32(0.0))
        ratio, k = self._typical(step)
        lit, unlit, shared = self._of(_PLACE, ratio, k)
        off: Plane = step * np.float32(max(lit + unlit - 2.0 * shared, 0.0) ** 0.5 / (1.0 - b))
        if biased is not None:
            np.hypot(off, biased - (self.lit - self.unlit) * np.float32(1.0 / (1.0 - b)), out=off)
        return off

    def _typical(self, step: Plane) -> tuple[float, int]:
        """Noise over the step of a pixel like most, and the number of its samples averaged."""
        ratios = thinned(self.deviation) / np.maximum(thinned(step), _TINY)
        ratio = float(np.clip(np.median(ratios), RATIOS[0], RATIOS[-1]))
        k = self.k or int(self.model.k[int(np.argmin(np.abs(np.log(RATIOS) - np.log(ratio))))])
        return ratio, k

    def systematic(self, b: float, g: float, *, biased: bool) -> dict[str, Any]:
        """Facts of a pixel like most: samples averaged, the spread that comes of where a pixel lies
        in the pattern, which nothing takes off, and if `biased` what noise and blur do."""
        step = self.lit - self.unlit
        ratio, k = self._typical(step)
        # L_d and L_g from lit and unlit light
        solved = (
            np.array([[1.0, -1.0], [-b / g, 1.0 / g]]) * float(np.median(thinned(step))) / (1.0 - b)
        )
        lit, unlit, shared = self._of(_PLACE, ratio, k)
        spread = np.diag(solved @ np.array([[lit, shared], [shared, unlit]]) @ solved.T)
        facts: dict[str, Any] = {
            "samples_averaged": k,
            "spread_of_place": _named(np.sqrt(np.maximum(spread, 0.0))),
        }
        if biased:
            blurred = solved @ self._of(("lit", "unlit"), RATIOS[0], k)
            whole = solved @ self._of(("lit", "unlit"), ratio, k)
            facts["bias_of_noise"] = _named(whole - blurred)
            facts["bias_of_blur"] = _named(blurred)
        return facts

    def _of(self, names: tuple[str, ...], ratio: float, k: int) -> NDArray[np.float64]:
        columns = (getattr(self.model, name)[:, k - 1] for name in names)
        return np.array([np.interp(ratio, RATIOS, column) for column in columns])


def _named(pair: NDArray[np.float64]) -> dict[str, float]:
    return {name: round(float(v), 3) for name, v in zip(("direct", "global"), pair, strict=True)}


def _estimated(
    blur: float | None,
    model: OrderErrors,
    uneven: float,
    ranks: tuple[Plane, Plane],
    deviations: tuple[Plane, Plane],
) -> Estimated:
    """The means of the k darkest and brightest samples, less their bias."""
    (low, high), (dark, lit) = ranks, deviations
    keep = len(low)
    two = min(2, keep)
    raw = high[0] - low[0] if keep == 1 else (high[0] + high[1] - low[0] - low[1]) * _HALF
    both = (dark + lit) * _HALF
    tables = _Tables(model, two, keep)
    at = tables.index(both, raw)
    # beyond the table noise is all there is: its effect grows with it, not with the step
    step = raw / np.take(tables.step, at)
    np.maximum(step, both * np.float32(1.0 / RATIOS[-1]), out=step)
    means = [high[0].copy(), low[0].copy()]
    first: Any = 0  # where the tables of the number of samples that are averaged begin
    if keep > 1:
        k = np.take(tables.k, at)
        for rank in range(1, int(k.max())):
            among = k > rank
            means[0] += high[rank] * among
            means[1] += low[rank] * among
        share = np.take(np.float32(1.0) / np.arange(1, keep + 1, dtype=np.float32), k - 1)
        means = [total * share for total in means]
        first = (k - np.uint8(1)).astype(np.int32) * np.int32(_FINE)
    found = [
        mean - np.take(bias, first + tables.index(own, raw)) * step
        for mean, bias, own in zip(means, tables.biases, (lit, dark), strict=True)
    ]
    # corrected past each other: there is no step to be told from noise
    crossed = found[0] < found[1]
    if crossed.any():
        between = (found[0] + found[1]) * _HALF
        for end in found:
            np.copyto(end, between, where=crossed)
    lit_var, unlit_var, shared = (
        np.take(table, first + at) * square
        for table, square in zip(tables.moments, (lit * lit, dark * dark, dark * lit), strict=True)
    )
    return Estimated(
        lit=found[0],
        unlit=found[1],
        lit_var=lit_var,
        unlit_var=unlit_var,
        shared=shared,
        blur=blur,
        uneven=uneven,
        deviation=np.sqrt((dark * dark + lit * lit) * _HALF),
        model=model,
        k=1 if keep == 1 else None,
    )


class _Tables:
    """A model's columns, for each number of samples averaged in turn, at evenly spaced logarithms
    of noise over the raw step (of `two` samples). `biases` of lit and of unlit light are parts of
    the step, `moments` (variances and covariance) multiples of those of a sample's noise."""

    def __init__(self, model: OrderErrors, two: int, keep: int) -> None:
        ratios = np.asarray(RATIOS)
        seen = ratios / model.steps(two)
        self._low, self._high = np.log(seen[0]), np.log(seen[-1])
        # errors go with the ratio, variances with its square, and not with its logarithm
        at = np.interp(np.exp(np.linspace(self._low, self._high, _FINE)), seen, ratios)

        def table(column: NDArray[np.float64]) -> Plane:
            found = [np.interp(at, ratios, column[:, k]) for k in range(keep)]
            return np.concatenate(found).astype(np.float32)

        self.step = np.interp(at, ratios, model.steps(two)).astype(np.float32)
        self.k = np.minimum(
            model.k[np.argmin(np.abs(np.log(at)[:, None] - np.log(ratios)), axis=1)], keep
        ).astype(np.uint8)
        self.biases = table(model.lit), table(model.unlit)
        square = np.square(ratios)[:, None]
        noise = (model.lit_noise, model.unlit_noise, model.shared_noise)
        self.moments = tuple(table(column / square) for column in noise)

    def index(self, deviation: Plane, raw: Plane) -> NDArray[np.int32]:
        """The nearest place in a table of each sample."""
        ratio = deviation / np.maximum(raw, _TINY)
        np.maximum(ratio, np.float32(np.exp(self._low)), out=ratio)
        np.log(ratio, out=ratio)
        ratio -= np.float32(self._low)
        ratio *= np.float32((_FINE - 1) / (self._high - self._low))
        ratio += _HALF
        np.minimum(ratio, np.float32(_FINE - 1), out=ratio)
        return ratio.astype(np.int32)


def _local_limits(low: Plane, high: Plane) -> tuple[Plane, Plane]:
    """The most noise of the unlit and of the lit samples that the ranks around a pixel allow.

    Noise parts the first of the kept ranks from the last; where it does not, as in black where
    every count is 0, there is none to correct. The least distance that so many ranks have is 1.2
    deviations (of 25 samples); half as much again is allowed.
    """
    return _around(low[-1] - low[0]), _around(high[0] - high[-1])


def _around(apart: Plane) -> Plane:
    around = cv2.blur(apart, (9, 9), borderType=cv2.BORDER_REFLECT)
    limit = np.asarray(around, dtype=np.float32).reshape(apart.shape)
    limit *= np.float32(1.5 / 1.2)
    return limit
