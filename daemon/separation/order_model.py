"""What noise and blur do to the k brightest and darkest of a pixel's samples, by simulation.

A pixel under binary patterns takes levels between unlit and lit that depend on where it lies in the
pattern and on the projector's blur; noise adds to each. The mean of the k brightest samples is then
too bright by noise and too dark by blur. By how much is simulated for the pattern set of the scan:
its patterns are blurred, sampled, made noisy (with a fixed seed, so that the same frames give the
same result) and ranked.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane

# Blurs that are simulated, in projector pixels; errors between them are interpolated.
_KNOTS = (
    *(0.0, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7),
    *(0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.6, 1.8, 2.1, 2.4),
)

_PARTS = 3  # that each interval between knots is tried in
_TRIED = tuple((at, part / _PARTS) for at in range(len(_KNOTS) - 1) for part in range(_PARTS))
BLURS = (
    *(round(_KNOTS[at] * (1 - part) + _KNOTS[at + 1] * part, 4) for at, part in _TRIED),
    _KNOTS[-1],
)
"""Standard deviations of the projector's blur that are tried, in projector pixels."""

RATIOS = (0.001, 0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Noise of a sample over the step from unlit to lit, for which errors are tabulated."""

_FINE = 120  # noise over the raw step that gaps are looked up at, evenly in its logarithm
_AMOUNTS = np.geomspace(1.0, 30.0, 171)  # times their noise that samples may differ by
_ALIKE = 0.1  # blurs whose cost differs by so much of the least explain about as well
_DOUBT = 0.5  # a bias that is corrected still costs this part of it: blur differs over a scene


@dataclass(frozen=True)
class OrderErrors:
    """Errors of estimates from the k brightest and darkest, for one blur; step = 1.

    First axis RATIOS. `gaps` (ratios, 2, keep - 1): mean distance of each rank from the first, of
    the brightest and of the darkest samples, by the raw step (two brightest less two darkest).
    `lit`, `unlit` (ratios, keep): bias of means of k. Variances and covariance of the two, from
    noise alone (`lit_noise`, `unlit_noise`, `shared_noise`) and from where a pixel lies in the
    pattern (`lit_place`, `unlit_place`, `shared_place`), which repeated scans do not show.
    """

    gaps: NDArray[np.float64]
    lit: NDArray[np.float64]
    unlit: NDArray[np.float64]
    lit_noise: NDArray[np.float64]
    unlit_noise: NDArray[np.float64]
    shared_noise: NDArray[np.float64]
    lit_place: NDArray[np.float64]
    unlit_place: NDArray[np.float64]
    shared_place: NDArray[np.float64]

    @property
    def step(self) -> NDArray[np.float64]:
        """Mean of the raw step (ratios)."""
        return self.steps(min(2, self.lit.shape[1]))

    def steps(self, k: int) -> NDArray[np.float64]:
        """Mean of the k brightest less the k darkest (ratios)."""
        return 1.0 + self.lit[:, k - 1] - self.unlit[:, k - 1]

    @property
    def k(self) -> NDArray[np.int64]:
        """The number of samples whose mean has the least error (ratios)."""
        bias = np.maximum(np.abs(self.lit), np.abs(self.unlit))
        noise = self.lit_noise + self.unlit_noise - 2.0 * self.shared_noise
        place = self.lit_place + self.unlit_place - 2.0 * self.shared_place
        cost = noise + place + (2.0 * _DOUBT * bias) ** 2
        return np.asarray(np.argmin(cost, axis=1) + 1)


class OrderModels:
    """`OrderErrors` at each of BLURS, for a pattern set: `levels(blur)` gives (patterns, samples)
    of a pixel's level, 0 to 1, at places all over it."""

    def __init__(self, levels: Callable[[float], Plane], keep: int) -> None:
        knots = [_errors(levels(blur), keep) for blur in _KNOTS]
        found = [_between(knots[at], knots[at + 1], part) for at, part in _TRIED]
        self._models = (*found, knots[-1])
        ratios = np.asarray(RATIOS)
        seen = [ratios / model.step for model in self._models]
        self._low = float(np.log(min(s[0] for s in seen)))
        self._high = float(np.log(max(s[-1] for s in seen)))
        fine = np.exp(np.linspace(self._low, self._high, _FINE))
        gaps = [
            [np.interp(fine, s, c) for c in m.gaps.reshape(ratios.size, 2 * (keep - 1)).T]
            for s, m in zip(seen, self._models, strict=True)
        ]  # none with keep 1
        columns = np.array(gaps).reshape(len(self._models), 2 * (keep - 1), _FINE)
        self._gaps = np.ascontiguousarray(np.moveaxis(columns, 1, 2)).reshape(
            len(self._models), _FINE, 2, keep - 1
        )

    def at(self, place: float) -> tuple[float, OrderErrors]:
        """A blur, and its errors, at a place of BLURS that `fit` has found."""
        first = min(int(place), len(BLURS) - 2)
        part = place - first
        blur = round((1.0 - part) * BLURS[first] + part * BLURS[first + 1], 3)
        return blur, _between(self._models[first], self._models[first + 1], part)

    def fit(
        self,
        gaps: NDArray[np.float64],
        noise: NDArray[np.float64],
        used: NDArray[np.bool_] | None = None,
        *,
        uneven: bool = False,
    ) -> tuple[float, float]:
        """The blur that explains observed gaps, as a place of BLURS.

        `gaps` (groups, 2, keep - 1) as in `OrderErrors`; `noise` (groups, 2) is that of lit and of
        unlit samples over the raw step; `used` (groups, 2), at least one a group: which gaps count
        (None: all). The second figure is by how many times their noise samples differ: 1, or with
        `uneven`, where global light differs from pattern to pattern, what fits best.
        """
        share = np.ones(gaps.shape[:2]) if used is None else used.astype(np.float64)
        # misfits are relative to it, for each group to have its say
        size = np.maximum(np.einsum("gek,ge->g", gaps**2, share), 1e-9)  # 0: no noise at all
        away = np.log(_AMOUNTS) if uneven else np.zeros(1)
        wanted = np.log(noise) + away[:, None, None]  # (amounts, groups, 2)
        place = (wanted - self._low) * ((_FINE - 1) / (self._high - self._low))
        first = np.clip(place, 0, _FINE - 2).astype(np.intp)
        part = np.clip(place - first, 0.0, 1.0)[..., None]
        below, above = (self._gaps[:, at, np.arange(2)] for at in (first, first + 1))
        table = below + part * (above - below)  # (blurs, amounts, groups, 2, keep - 1)
        cost = (np.square(table - gaps).sum(axis=4) * share).sum(axis=3) / size
        costs = cost.min(axis=1).sum(axis=1)
        amounts = _AMOUNTS[np.median(np.argmin(cost, axis=1), axis=1).astype(np.intp)]
        # of blurs that explain it about as well the mean: none of them is far from it
        weight = np.exp((costs.min() - costs) / (_ALIKE * costs.min() + 1e-9))
        if uneven:  # which looks like the least of blurs: there is none, or that of the first knot
            weight[1:_PARTS] = 0.0
        weight /= weight.sum()
        found = float(weight @ np.arange(costs.size))
        if uneven and found < _PARTS:
            found = float(_PARTS * round(found / _PARTS))
            return found, float(amounts[int(found)])
        return found, float(weight @ amounts)


def _between(low: OrderErrors, high: OrderErrors, part: float) -> OrderErrors:
    return OrderErrors(
        *((1.0 - part) * getattr(low, f.name) + part * getattr(high, f.name) for f in fields(low))
    )


@functools.lru_cache(maxsize=4 * len(_KNOTS))
def _place_for(digest: bytes, keep: int) -> list[OrderErrors]:
    """Where errors are kept once they are known: the next scan is often of the same patterns."""
    del digest, keep
    return []


def _errors(levels: Plane, keep: int) -> OrderErrors:
    places = np.ascontiguousarray(levels.T, dtype=np.float32)
    shape = str(places.shape).encode()
    kept = _place_for(hashlib.blake2b(places.tobytes(), digest_size=32, key=shape).digest(), keep)
    if not kept:
        kept.append(_simulated(places, keep))
    return kept[0]


def _simulated(places: Plane, keep: int) -> OrderErrors:
    rng = np.random.default_rng(0)
    # two draws a place: what they differ by is noise, not place
    noise = rng.standard_normal((2, *places.shape), dtype=np.float32)
    k = np.arange(1, keep + 1)
    rows = []
    for ratio in RATIOS:
        ranked = np.sort(places + np.float32(ratio) * noise, axis=-1)
        low = ranked[..., :keep].astype(np.float64)
        high = ranked[..., ::-1][..., :keep].astype(np.float64)
        apart = np.stack([high[..., :1] - high[..., 1:], low[..., 1:] - low[..., :1]])
        lit, unlit = np.cumsum(high, axis=-1) / k - 1.0, np.cumsum(low, axis=-1) / k
        biases = lit.mean(axis=(0, 1)), unlit.mean(axis=(0, 1))
        lit -= biases[0]
        unlit -= biases[1]
        two = min(2, keep) - 1
        gaps = apart.mean(axis=(1, 2)) / (1.0 + biases[0][two] - biases[1][two])
        of_noise = _covariances(lit[0] - lit[1], unlit[0] - unlit[1]) / 2.0
        whole = (_covariances(lit[0], unlit[0]) + _covariances(lit[1], unlit[1])) / 2.0
        rows.append((gaps, *biases, *of_noise, *(whole - of_noise)))
    return OrderErrors(*(np.stack(column) for column in zip(*rows, strict=True)))


def _covariances(lit: NDArray[np.float64], unlit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of (places, keep): the variances of both, and their covariance: (3, keep)."""
    pairs = (lit, lit), (unlit, unlit), (lit, unlit)
    return np.stack([np.einsum("pk,pk->k", a, b) for a, b in pairs]) / len(lit)
