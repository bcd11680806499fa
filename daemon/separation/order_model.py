"""What noise and blur do to the k brightest and darkest of a pixel's samples, by simulation.

A pixel under binary patterns takes levels between unlit and lit that depend on where it lies in the
pattern and on the projector's blur; noise adds to each. The mean of the k brightest samples is then
too bright by noise and too dark by blur, by amounts that this module finds for the very pattern set
of a scan: its patterns are blurred, sampled, made noisy (with a fixed seed, so that a result can be
had again) and ranked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

BLURS = (0.0, 0.2, 0.4, 0.55, 0.7, 0.85, 1.0, 1.2, 1.4, 1.6, 1.8, 2.1, 2.4)
"""Standard deviations of the projector's blur that are tried, in projector pixels."""

RATIOS = (0.001, 0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Noise of a sample over the step from unlit to lit, for which errors are tabulated."""

_PRIOR = 0.02  # relative misfit that a factor e between fitted and pictured noise costs
_DOUBT = 0.5  # a bias that is corrected still costs this part of it: blur differs over a scene


@dataclass(frozen=True, slots=True)
class OrderErrors:
    """Errors of estimates from the k brightest and darkest, for one blur; step = 1.

    First axis RATIOS. `step`: mean of the raw step (two brightest less two darkest); `gaps`
    (ratios, keep - 1): mean distance of each rank from the first, over both ends, by raw step;
    `k`: the number of samples to average; `lit`, `unlit` (ratios, keep): bias of means of k;
    `spread_step`, `spread_unlit`: standard deviations of lit - unlit and of unlit, `covariance`
    theirs.
    """

    step: NDArray[np.float64]
    gaps: NDArray[np.float64]
    k: NDArray[np.int64]
    lit: NDArray[np.float64]
    unlit: NDArray[np.float64]
    spread_step: NDArray[np.float64]
    spread_unlit: NDArray[np.float64]
    covariance: NDArray[np.float64]


def simulate(levels: Callable[[float], Plane], keep: int) -> tuple[OrderErrors, ...]:
    """Errors for each of BLURS. `levels(blur)` gives (patterns, samples) of a pixel's level, 0 to
    1, at places all over the pattern set."""
    return tuple(_errors(levels(blur).astype(np.float64), keep) for blur in BLURS)


def _errors(levels: NDArray[np.float64], keep: int) -> OrderErrors:
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(levels.shape)
    rows = []
    for ratio in RATIOS:
        ranked = np.sort(levels + ratio * noise, axis=0)
        low, high = ranked[:keep], ranked[::-1][:keep]
        raw = high[:2].mean(axis=0) - low[:2].mean(axis=0)
        step = float(raw.mean())
        gaps = ((high[:1] - high[1:]) + (low[1:] - low[:1])).mean(axis=1) / (2 * step)
        best = None
        biases = []
        for k in range(1, keep + 1):
            lit, unlit = high[:k].mean(axis=0) - 1.0, low[:k].mean(axis=0)
            biases.append((lit.mean(), unlit.mean()))
            bias = max(abs(lit.mean()), abs(unlit.mean()))
            cost = (lit - unlit).var() + (2 * _DOUBT * bias) ** 2
            if best is None or cost < best[0]:
                covariance = np.cov(lit - unlit, unlit)
                best = cost, k, covariance
        assert best is not None
        rows.append((step, gaps, best[1], np.array(biases), best[2]))
    covariances = np.stack([row[4] for row in rows])
    return OrderErrors(
        step=np.array([row[0] for row in rows]),
        gaps=np.stack([row[1] for row in rows]),
        k=np.array([row[2] for row in rows]),
        lit=np.stack([row[3][:, 0] for row in rows]),
        unlit=np.stack([row[3][:, 1] for row in rows]),
        spread_step=np.sqrt(covariances[:, 0, 0]),
        spread_unlit=np.sqrt(covariances[:, 1, 1]),
        covariance=covariances[:, 0, 1],
    )


@dataclass(frozen=True, slots=True)
class Extremes:
    """Bias and spread of the largest and the smallest sample for noise of deviation 1, far smaller
    than the step from unlit to lit."""

    lit_bias: float
    unlit_bias: float
    lit_spread: float
    unlit_spread: float


def extremes(levels: Plane) -> Extremes:
    """For a sharp pattern set, `levels` (patterns, samples) as for `simulate` with no blur."""
    noise = np.random.default_rng(0).standard_normal(levels.shape)
    lit = np.where(levels > 0.5, noise, -np.inf).max(axis=0)
    unlit = np.where(levels <= 0.5, noise, np.inf).min(axis=0)
    lit, unlit = lit[np.isfinite(lit)], unlit[np.isfinite(unlit)]
    return Extremes(*(float(v) for v in (lit.mean(), unlit.mean(), lit.std(), unlit.std())))


def fit(
    models: tuple[OrderErrors, ...], gaps: NDArray[np.float64], seen: NDArray[np.float64]
) -> tuple[int, NDArray[np.float64]]:
    """The blur (an index of BLURS) and each group's noise ratio that explain observed gaps.

    `gaps` (groups, keep - 1) as in `OrderErrors`. Blur spreads the ranks ever wider, noise the
    first ones most, so that the two are told apart; where hardly, `seen` (groups), the noise over
    the raw step as a picture shows it, decides.
    """
    fine = np.geomspace(RATIOS[0], RATIOS[-1], 200)
    size = (gaps**2).sum(axis=1)  # misfits are relative to it, for each group to have its say
    best: tuple[float, int, NDArray[np.float64]] | None = None
    for index, model in enumerate(models):
        table = np.stack(
            [np.interp(np.log(fine), np.log(RATIOS), column) for column in model.gaps.T], axis=1
        )
        misfit = ((gaps[:, None, :] - table[None]) ** 2).sum(axis=2) / size[:, None]
        raw = fine / np.interp(np.log(fine), np.log(RATIOS), model.step)
        misfit += _PRIOR * np.log(raw[None, :] / seen[:, None]) ** 2
        cost = float(misfit.min(axis=1).sum())
        if best is None or cost < best[0]:
            best = cost, index, fine[np.argmin(misfit, axis=1)]
    assert best is not None
    return best[1], best[2]
