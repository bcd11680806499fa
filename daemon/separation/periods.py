"""Components by waves of several periods -> one, and how far the periods disagree.

Light that is scattered, or reflected between surfaces, over less than a period goes with the wave
and counts as direct, the more of it the longer the period. So the finest wave is nearest to direct
light, and the others join it where they say the same. Where they do not, some such light goes with
the finest, too: what is left at a period p is taken to be as p, as where scattering falls with its
reach, so that of two periods p < q, whose direct components differ by x, the finer one's is off by
x p/(q - p).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane
from daemon.separation.unsmooth import by_light

_AROUND = 9  # pixels across that a difference is averaged over
_SURE = 2.0  # deviations of that mean: less is noise
_LEFT = 3.0  # deviations of noise: what is left beyond is flagged
_DISAGREE = 5.0
"""Periods disagree when their direct components differ by so many standard deviations ..."""
_PART = 0.1
"""... and by this part of the light: a smaller difference is a bend of the projector's curve."""


@dataclass(frozen=True, slots=True)
class Agreed:
    """Direct light and its noise's variance; `left`: how far off it may be for what periods differ
    by, as a deviation, all of a frame's shape; `disagree` (H, W): by far too much."""

    direct: Plane
    direct_var: Plane
    left: Plane
    disagree: NDArray[np.bool_]


def agreed(solved: Sequence[tuple[Plane, Plane]], periods: Sequence[float], total: Plane) -> Agreed:
    """Direct light and its variance by each of some periods, in projector pixels (others than as
    many: not known, the finest first), taken together; `total` is all of the light."""
    known = len(periods) == len(solved)
    finest, coarsest = (
        (int(np.argmin(periods)), int(np.argmax(periods))) if known else (0, len(solved) - 1)
    )
    wider = periods[coarsest] - periods[finest] if known else 0.0
    lever = np.float32(periods[finest] / wider if wider else 1.0)
    direct, direct_var = solved[finest]
    left = np.zeros_like(direct)
    disagree = np.zeros(direct.shape[:2], dtype=np.bool_)
    if len(solved) == 1:
        return Agreed(direct, direct_var, left, disagree)
    weights, sums, squares = np.ones_like(direct), direct.copy(), direct_var.copy()
    for n, (coarse, coarse_var) in enumerate(solved):
        if n == finest:
            continue
        apart = coarse - direct
        variance: Plane = direct_var + coarse_var
        beyond = np.square(_around(apart))
        beyond -= np.float32((_SURE / _AROUND) ** 2) * _around(variance)
        np.maximum(beyond, 0, out=beyond)
        # as measurements are weighted of which one is off by so much
        weight = direct_var / np.maximum(coarse_var + beyond, np.float32(1e-12))
        weights += weight
        sums += weight * coarse
        squares += np.square(weight) * coarse_var
        off, deviation = np.abs(apart), np.sqrt(variance)
        least = np.float32(_PART) * total
        far = (off > np.float32(_DISAGREE) * deviation) & (off > least)
        if n == coarsest:
            left = np.sqrt(beyond) * lever
            around = np.maximum(np.float32(_LEFT) * np.sqrt(direct_var), least)
            far |= (left > around) & (off > np.float32(_SURE) * deviation)
        disagree |= far if far.ndim == 2 else by_light(far, total)
    sums /= weights
    squares /= np.square(weights)
    return Agreed(sums, squares, left, disagree)


def _around(plane: Plane) -> Plane:
    return np.asarray(cv2.blur(plane, (_AROUND, _AROUND)), dtype=np.float32)
