"""Lit and unlit light from the ranks of a pixel's samples: what they tell of blur and noise, and
the means of the brightest and darkest less what these two do to them (`order_model`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.noise import Noise
from daemon.separation.order import Ranked
from daemon.separation.order_model import BLURS, RATIOS, OrderErrors, fit, simulate
from daemon.separation.radiometry import Plane, Response
from daemon.separation.scan_noise import CALIBRATION, ScanNoise, Told

KEEP = 5
"""Samples kept at each end; a checkerboard's 25 shifts light every pixel wholly in 9 or more."""

RANKS = 3
"""Samples to keep at each end at least: fewer do not tell blur from noise."""

_PLACES = 8192  # pixels that are looked at for blur and noise
_GROUPS = 8
_LEAST = 32  # pixels that make a group
_DIM = 0.2  # of the brightest pixels' step: with less, a pixel is not looked at
_WITHIN = 1.5  # times the distance of the kept ranks from an end of the scale, to be clear of it
_FINE = 640  # ratios of noise and step that are told apart, evenly in their logarithm
_TINY = np.float32(1e-6)


def places(size: int) -> NDArray[np.intp]:
    """Samples of a plane, the same every time. They lie at random: those of a regular grid would
    all lie alike in a regular pattern."""
    if size <= _PLACES:
        return np.arange(size)
    return np.random.default_rng(0).integers(0, size, _PLACES)


class Followed:
    """The ranks of some samples alone, for an estimator that keeps none: constant, small memory."""

    def __init__(self, keep: int) -> None:
        self._low = Ranked(keep, largest=False)
        self._high = Ranked(keep, largest=True)
        self._places: NDArray[np.intp] | None = None

    def add(self, samples: NDArray[Any]) -> None:
        """Take in a frame."""
        if self._places is None:
            self._places = places(samples.size)
        picked = np.take(samples, self._places)
        self._low.add(picked)
        self._high.add(picked)

    def ranks(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """(keep, places) darkest and brightest."""
        return self._low.planes, self._high.planes


class OrderStatistics:
    """What is known beforehand of the ranks of a pattern set's samples. `levels(blur)` gives its
    levels for `order_model.simulate`; `even`: each pattern lights as much of any neighbourhood."""

    def __init__(self, levels: Callable[[float], Plane], even: bool = True) -> None:
        self._even = even
        patterns = levels(0.0).shape[0]
        self.keep = max(min(KEEP, patterns // 2), 1)
        self._models = simulate(levels, self.keep)
        for model in self._models:
            model.fine  # noqa: B018 - now, and not when the last frame is in

    def explain(
        self, low: Plane, high: Plane, noise: ScanNoise, response: Response, average: int
    ) -> Explained:
        """The blur and the noise that explain how far apart ranks are: `low` and `high` are light,
        (keep, places), the most extreme first."""
        groups = None if self.keep < RANKS else _grouped(low, high, response)
        if groups is None:
            return Explained(self._models[0], None, noise.told())
        own = noise.own()
        found, sigma = self._fitted(groups, own)
        if not own.measured:  # light that differs from pattern to pattern is in ranks, not in it
            pictured = own.deviation(groups.light.astype(np.float32))
            whole = groups.light - float(_ends(response)[1]) > _CLIPPED * sigma
            sigma = np.where(whole, np.minimum(sigma, pictured), sigma)
        ranks = None if own.measured else _by_level(response, groups.light, sigma * average**0.5)
        told = noise.told(ranks)
        if told.source == CALIBRATION:
            found, _ = self._fitted(groups, told)
        blur, uneven = found
        return Explained(self._models[blur], BLURS[blur], told, uneven)

    def _fitted(self, of: _Groups, told: Told) -> tuple[tuple[int, float], NDArray[np.float64]]:
        """The blur (an index of BLURS) and how many times its noise the samples differ by; the
        noise of each group."""
        if told.measured:
            kinds = told.deviation(of.light.astype(np.float32))[None].astype(np.float64)
        else:  # as much as in the picture, but of any share of shot noise
            typical = float(np.median(told.deviation(of.middle)))
            grown = np.maximum(of.light, 0.0) / max(float(np.median(of.middle)), 1e-6)
            kinds = np.stack([typical * np.sqrt(1.0 - shot + shot * grown) for shot in _SHOT])
        relative = np.maximum(kinds, 1e-3) / of.steps[:, None]
        blur, _, kind, amount = fit(
            self._models, of.gaps, relative, known=told.measured, even=self._even, used=of.used
        )
        # what more there is where patterns are uneven is global light, the same in a repeated scan
        uneven = 1.0 if self._even else max(amount, 1.0)
        return (blur, uneven), kinds[kind] * (amount / uneven)


@dataclass(frozen=True, slots=True)
class _Groups:
    """Pixels alike in step: the mean distances of their ranks (groups, 2, keep - 1) by the raw step
    (groups); light of lit and unlit samples (groups, 2), half-way between, and which of the two
    (groups, 2) have all of their noise."""

    gaps: NDArray[np.float64]
    steps: NDArray[np.float64]
    light: NDArray[np.float64]
    middle: Plane
    used: NDArray[np.bool_]


def _grouped(low: Plane, high: Plane, response: Response) -> _Groups | None:
    """Groups of the pixels whose ranks (keep, places) these are; None of too few."""
    step = high[:2].mean(axis=0) - low[:2].mean(axis=0)
    tenth, most = np.quantile(step, [0.1, 0.9])
    lit = np.flatnonzero(step > max(float(tenth), _DIM * float(most)))
    groups = np.array_split(lit[np.argsort(step[lit], kind="stable")], _GROUPS)
    groups = [group for group in groups if group.size >= _LEAST]
    if not groups:
        return None
    apart = np.stack([high[:1] - high[1:], low[1:] - low[:1]])
    steps = np.maximum([float(step[g].mean()) for g in groups], 1e-6)
    gaps = np.stack([apart[:, :, g].mean(axis=2) for g in groups]) / steps[:, None, None]
    light = np.stack([[np.median(end[g]) for end in (high[1], low[1])] for g in groups])
    middle = np.asarray(light.mean(axis=1), dtype=np.float32)
    # light at an end of the scale has its noise cut off there, and says nothing of it
    used = np.abs(light - _ends(response)) > _WITHIN * gaps[:, :, -1] * steps[:, None]
    if not used.any():
        used[:] = True
    there = used.any(axis=1)
    return _Groups(
        gaps[there].astype(np.float64),
        steps[there],
        light[there].astype(np.float64),
        middle[there],
        used[there],
    )


def _ends(response: Response) -> Plane:
    """The linear light of saturation and of 0 counts."""
    return response.linear_between(np.array([response.saturated_from, 0.0], dtype=np.float32))


_LOG = np.log(RATIOS)
_FIRST = 1.6  # deviations that the first of a dozen samples is off
_CLIPPED = 4.0  # deviations above 0 counts from which a picture has all of its noise
_SHOT = (0.0, 0.3, 0.6, 0.9, 1.0)  # shares of shot noise in the variance at the typical light


def _by_level(response: Response, light: NDArray[np.float64], sigma: NDArray[np.float64]) -> Noise:
    """Noise of counts from deviations of light; neighbouring levels are taken together."""
    flat = light.reshape(-1).astype(np.float32)
    counts = response.counts(flat).astype(np.float64)
    slope = response.slope(response.counts(flat))
    encoded = sigma.reshape(-1) / np.maximum(slope, 1e-9)
    order = np.array_split(np.argsort(counts, kind="stable"), max(counts.size // 2, 1))
    levels = [float(counts[pair].mean()) for pair in order]
    found = [max(float(np.sqrt(np.mean(encoded[pair] ** 2))), 12.0**-0.5) for pair in order]
    return Noise(tuple(levels), tuple(found))


@dataclass(frozen=True, slots=True)
class Explained:
    """The blur (None: not known), its errors, noise, and how many times it samples differ by."""

    model: OrderErrors
    blur: float | None
    told: Told
    uneven: float = 1.0

    def deviations(self, low: Plane, high: Plane) -> tuple[Plane, Plane]:
        """What the unlit and the lit samples differ by, from ranks (keep, ...).

        The darkest sample is darker than unlit light by noise, and so are its shot noise and the
        brightest's: the level that counts is that of the last kept rank, or of one by as much off.
        """
        by = np.float32(self.uneven)
        if len(low) >= KEEP:
            return self.told.deviation(low[-1]) * by, self.told.deviation(high[-1]) * by
        off = np.float32(_FIRST * by)
        unlit = low[0] + off * self.told.deviation(low[0])
        lit = high[0] - off * self.told.deviation(high[0])
        return self.told.deviation(unlit) * by, self.told.deviation(lit) * by

    def systematic(
        self, ends: Ends, deviation: Plane, b: float, g: float, k: int | None = None
    ) -> dict[str, Any]:
        """What means of the k most extreme samples (None: the best number) have beside scatter, for
        a pixel like most: `bias` of noise and of blur, which `estimate` takes off, and the `spread`
        that comes of where a pixel lies in the pattern, which nothing does."""
        at = places(deviation.size)
        steps = np.maximum(np.take(ends.lit, at) - np.take(ends.unlit, at), _TINY)
        step = float(np.median(steps))
        ratio = float(np.clip(np.median(np.take(deviation, at) / steps), RATIOS[0], RATIOS[-1]))
        if k is None:
            k = int(self.model.k[int(np.argmin(np.abs(_LOG - np.log(ratio))))])
        # L_d and L_g from lit and unlit light
        solved = np.array([[1.0, -1.0], [-b / g, 1.0 / g]]) * step / (1.0 - b)
        blurred = solved @ self._of(("lit", "unlit"), RATIOS[0], k)
        biased = solved @ self._of(("lit", "unlit"), ratio, k)
        lit, unlit, shared = self._of(("lit_place", "unlit_place", "shared_place"), ratio, k)
        spread = np.diag(solved @ np.array([[lit, shared], [shared, unlit]]) @ solved.T)
        return {
            "samples_averaged": k,
            "bias_of_noise": _named(biased - blurred),
            "bias_of_blur": _named(blurred),
            "spread_of_place": _named(np.sqrt(np.maximum(spread, 0.0))),
        }

    def _of(self, names: tuple[str, ...], ratio: float, k: int) -> NDArray[np.float64]:
        columns = (getattr(self.model, name)[:, k - 1] for name in names)
        return np.array([np.interp(np.log(ratio), _LOG, column) for column in columns])


def _named(pair: NDArray[np.float64]) -> dict[str, float]:
    return {name: round(float(v), 3) for name, v in zip(("direct", "global"), pair, strict=True)}


@dataclass(frozen=True, slots=True)
class Ends:
    """Lit and unlit light of each sample, the variances of their noise, and their covariance."""

    lit: Plane
    unlit: Plane
    lit_var: Plane
    unlit_var: Plane
    shared: Plane

    def variances(self, b: float, g: float, uneven: float) -> tuple[Plane, Plane]:
        """Of L_d and L_g: L_d = (lit - unlit)/(1 - b), L_g = (unlit - b lit)/((1 - b) g); of noise
        alone, where samples differ by `uneven` times it."""
        direct = self.lit_var + self.unlit_var
        direct -= np.float32(2.0) * self.shared
        direct *= np.float32(((1.0 - b) * uneven) ** -2)
        indirect = self.unlit_var + np.float32(b * b) * self.lit_var
        indirect -= np.float32(2.0 * b) * self.shared
        indirect *= np.float32(((1.0 - b) * g * uneven) ** -2)
        return np.maximum(direct, 0, out=direct), np.maximum(indirect, 0, out=indirect)


def estimate(
    model: OrderErrors,
    low: Plane,
    high: Plane,
    unlit_deviation: Plane,
    lit_deviation: Plane,
    k: int | None = None,
) -> Ends:
    """Lit and unlit light without the bias of noise and blur, from the darkest and brightest
    samples (keep, ...); `k` of them are averaged (None: as many as have the least error)."""
    two = min(2, len(low))
    raw: Plane = (
        high[0] - low[0]
        if two == 1
        else (high[:2].sum(axis=0) - low[:2].sum(axis=0)) * np.float32(0.5)
    )
    tables = _Tables(model, two)
    middle = tables.index((unlit_deviation + lit_deviation) * np.float32(0.5), raw)
    of_lit, of_unlit = tables.index(lit_deviation, raw), tables.index(unlit_deviation, raw)
    # beyond the table noise is all there is: its effect grows with it, not with the step
    step = raw / np.take(tables.step, middle)
    np.maximum(step, (unlit_deviation + lit_deviation) * np.float32(0.5 / RATIOS[-1]), out=step)
    square = step * step
    if k is None:
        which = np.take(tables.k, middle)
        used = np.unique(which)
    else:
        which, used = None, np.array([k])
    planes: list[Plane] = []
    lit_sum, unlit_sum = high[0].copy(), low[0].copy()
    for count in range(1, int(used[-1]) + 1):
        if count > 1:
            lit_sum += high[count - 1]
            unlit_sum += low[count - 1]
        if count not in used:
            continue
        at, of = count - 1, np.float32(1.0 / count)
        found = [
            lit_sum * of - np.take(tables.of(model.lit[:, at]), of_lit) * step,
            unlit_sum * of - np.take(tables.of(model.unlit[:, at]), of_unlit) * step,
            np.take(tables.of(model.lit_noise[:, at]), of_lit) * square,
            np.take(tables.of(model.unlit_noise[:, at]), of_unlit) * square,
            np.take(tables.of(model.shared_noise[:, at]), middle) * square,
        ]
        if not planes:
            planes = found
        elif which is not None:
            chosen = which == count
            for plane, values in zip(planes, found, strict=True):
                np.copyto(plane, values, where=chosen)
    lit, unlit, *moments = planes
    # corrected past each other: there is no step to be told from noise
    crossed = lit < unlit
    if crossed.any():
        between = (lit + unlit) * np.float32(0.5)
        np.copyto(lit, between, where=crossed)
        np.copyto(unlit, between, where=crossed)
    return Ends(lit, unlit, *moments)


class _Tables:
    """A model's columns at evenly spaced logarithms of noise over the raw step of k samples."""

    def __init__(self, model: OrderErrors, k: int) -> None:
        seen = _LOG - np.log(model.steps(k))
        self._low, self._high = float(seen[0]), float(seen[-1])
        self._at = np.interp(np.linspace(self._low, self._high, _FINE), seen, np.arange(seen.size))
        self.step = self.of(model.steps(k))
        self.k = model.k[np.rint(self._at).astype(np.intp)].astype(np.uint8)

    def of(self, column: NDArray[np.float64]) -> Plane:
        """A column (ratios) at the spacing of `index`."""
        return np.interp(self._at, np.arange(column.size), column).astype(np.float32)

    def index(self, deviation: Plane, raw: Plane) -> NDArray[np.uint16]:
        """The nearest place in the table of each sample."""
        ratio = deviation / np.maximum(raw, _TINY)
        np.maximum(ratio, np.float32(np.exp(self._low)), out=ratio)
        np.log(ratio, out=ratio)
        ratio -= np.float32(self._low)
        ratio *= np.float32((_FINE - 1) / (self._high - self._low))
        ratio += np.float32(0.5)
        np.minimum(ratio, np.float32(_FINE - 1), out=ratio)
        return ratio.astype(np.uint16)


def local_limits(low: Plane, high: Plane) -> tuple[Plane, Plane]:
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
