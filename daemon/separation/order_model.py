"""What noise and blur do to the k brightest and darkest of a pixel's samples, by simulation.

A pixel under binary patterns takes levels between unlit and lit that depend on where it lies in the
pattern and on the projector's blur; noise adds to each. The mean of the k brightest samples is then
too bright by noise and too dark by blur, by amounts that this module finds for the very pattern set
of a scan: its patterns are blurred, sampled, made noisy (with a fixed seed, so that a result can be
had again) and ranked.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

_KNOTS = (0.0, 0.4, 0.55, 0.7, 0.85, 1.0, 1.2, 1.4, 1.6, 1.8, 2.1, 2.4)

# Of each interval but the first three parts, errors between knots being interpolated; a mean of a
# sharp pattern's and of a slightly blurred one's is neither's.
_TRIED = ((0, 0.0), *((at, part / 3) for at in range(1, len(_KNOTS) - 1) for part in range(3)))
BLURS = (
    *(round(_KNOTS[at] * (1 - part) + _KNOTS[at + 1] * part, 4) for at, part in _TRIED),
    _KNOTS[-1],
)
"""Standard deviations of the projector's blur that are tried, in projector pixels."""

RATIOS = (0.001, 0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Noise of a sample over the step from unlit to lit, for which errors are tabulated."""

_FINE = np.linspace(np.log(RATIOS[0]), np.log(RATIOS[-1]), 240)
_AMOUNTS = np.geomspace(1 / 30, 30, 172)  # 1 is not among them
_KNOWN = 1.0  # relative misfit that a factor e between fitted and known noise costs
_ABOVE = 0.1  # ... that a picture shows, which has at least its noise
_UNEVEN = 0.02  # ... either way, where patterns light a neighbourhood differently
_BELOW = 0.004  # ... at most, for texture in the picture may be the reason, ...
_TEXTURE = 0.2  # ... and half of that at this logarithm
_ALIKE = 0.1  # blurs whose cost differs by so much of the least explain about as well
_LOUD = 0.04  # noise over the step below which blur shows, and a picture matters less
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

    @cached_property
    def fine(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """`gaps` at the noise of _FINE, and the logarithms of that noise over the raw step."""
        log = np.log(RATIOS)
        table = np.stack(
            [np.interp(_FINE, log, column) for column in self.gaps.reshape(log.size, -1).T], axis=1
        ).reshape(_FINE.size, *self.gaps.shape[1:])
        return table, _FINE - np.log(np.interp(_FINE, log, self.step))

    @property
    def k(self) -> NDArray[np.int64]:
        """The number of samples whose mean has the least error (ratios)."""
        bias = np.maximum(np.abs(self.lit), np.abs(self.unlit))
        noise = self.lit_noise + self.unlit_noise - 2.0 * self.shared_noise
        place = self.lit_place + self.unlit_place - 2.0 * self.shared_place
        cost = noise + place + (2.0 * _DOUBT * bias) ** 2
        return np.asarray(np.argmin(cost, axis=1) + 1)


def simulate(levels: Callable[[float], Plane], keep: int) -> tuple[OrderErrors, ...]:
    """Errors for each of BLURS. `levels(blur)` gives (patterns, samples) of a pixel's level, 0 to
    1, at places all over the pattern set."""
    knots = [_errors(levels(blur), keep) for blur in _KNOTS]
    found = [_between(knots[at], knots[at + 1], part) for at, part in _TRIED]
    return (*found, knots[-1])


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


def fit(
    models: tuple[OrderErrors, ...],
    gaps: NDArray[np.float64],
    noise: NDArray[np.float64],
    *,
    known: bool = False,
    even: bool = True,
    used: NDArray[np.bool_] | None = None,
) -> tuple[int, NDArray[np.float64], int, float]:
    """The blur (an index of BLURS) and the noise that explain observed gaps.

    `gaps` (groups, 2, keep - 1) as in `OrderErrors`. `noise` (kinds, groups, 2) is that of the lit
    and of the unlit over the raw step, as it may depend on their light; how much of it there is, is
    found, starting from 1 times. Blur spreads the ranks ever wider, noise the first ones most, and
    blur in proportion to the step, so that the two are told apart; where hardly, the 1 decides,
    more so if `known`, less so if patterns do not light every neighbourhood alike (`even`). `used`
    (groups, 2), at least one a group: which gaps count (None: all).

    Returns the noise over the step (groups, 2), its kind, and how much of it there is.
    """
    share = np.ones(gaps.shape[:2]) if used is None else used.astype(np.float64)
    # misfits are relative to it, for each group to have its say
    size = np.maximum(np.einsum("gek,ge->g", gaps**2, share), 1e-9)  # 0: there is no noise at all
    away = np.log(_AMOUNTS)
    loud = min(float(np.median(noise)) / _LOUD, 1.0)
    texture = _BELOW * loud / (1.0 + np.square(_TEXTURE / away))
    below, above = (_KNOWN * away**2,) * 2 if known else (texture, _ABOVE * away**2)
    prior = np.where(away > 0, above, below) if even else _UNEVEN * away**2
    wanted = np.log(noise)[:, None] + away[:, None, None]  # (kinds, amounts, groups, 2)
    group, end = np.indices(noise.shape[1:])
    costs = np.empty(len(models))
    found: list[tuple[NDArray[np.float64], int, float]] = []
    for index, model in enumerate(models):
        table, raw = model.fine
        misfit = ((gaps[:, None] - table[None]) ** 2).sum(axis=3)
        misfit *= (share / size[:, None])[:, None]
        place = np.interp(wanted, raw, np.arange(raw.size))
        cost = misfit[group, np.rint(place).astype(np.intp), end].sum(axis=3)
        cost += prior[:, None] * share.sum(axis=1)  # (kinds, amounts, groups)
        if even:
            kind, amount = (
                int(n) for n in np.unravel_index(int(np.argmin(cost.sum(axis=2))), cost.shape[:2])
            )
            costs[index] = cost[kind, amount].sum()
        else:  # what global light adds differs from group to group
            kind = int(np.argmin(cost.min(axis=1).sum(axis=1)))
            costs[index] = cost[kind].min(axis=0).sum()
            amount = int(np.median(np.argmin(cost[kind], axis=0)))
        ratios = np.exp(np.interp(place[kind, amount], np.arange(raw.size), _FINE))
        found.append((ratios, kind, float(_AMOUNTS[amount])))
    # of blurs that explain it about as well the mean: none of them is far from it
    weight = np.exp((costs.min() - costs) / (_ALIKE * costs.min() + 1e-9))
    blur = round(float(weight @ np.arange(costs.size) / weight.sum()))
    return blur, *found[blur]
