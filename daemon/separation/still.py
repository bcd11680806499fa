"""A camera's noise, from frames over which a shadow moves.

While a mesh goes round hardly a pixel is as it was, and what it changed by says little of noise.
But where no shadow's edge passed a pixel's eight neighbours changed alike. So places are looked for
whose neighbours differ least in their change, and what the pixel did otherwise than their mean is
noise. Choosing by the neighbours leaves the pixel's own noise as it is; what all of them did, as
light that comes and goes with the rest of the scene, is not counted.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.noise import Noise
from daemon.separation.radiometry import Plane, Response

_EVERY = 16  # frames after which another one is what the next are compared with
_APART = 5  # rows and columns from one place to the next: odd, for all of a mosaic's colours
_LEVELS = 24  # of the square root of light: noise is much the same in each
_PER_OCTAVE = 6
_BINS = 17 * _PER_OCTAVE
_QUIET = 0.04  # part of a level's places that are taken for still
_ENOUGH = 60  # places that make a level's deviation
_MAD = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
_OF_EIGHT = math.sqrt(2.0 * (1.0 + 1.0 / 8.0))  # deviation of a change less that of eight others
_ROUNDING = 12.0**-0.5  # deviation of a count's rounding error


class StillPlaces:
    """Frames as they come -> the camera's noise by level. Memory: a sample of a frame, and two
    tables of a megabyte."""

    def __init__(self, response: Response) -> None:
        self._response = response
        self._taken = 0
        self._kept: Plane | None = None
        self._kept_moved = False
        # places by level, how unlike their neighbours' changes are, and their own change
        self._table = np.zeros((_LEVELS, _BINS, _BINS), np.uint32)
        self._smoothed = np.zeros_like(self._table)  # of pairs with an interpolated frame

    def add(self, pixels: NDArray[Any], *, interpolated: bool = False) -> None:
        """Take in a frame, (H, W) or (H, W, 3). Interpolation smooths noise away: interpolated
        frames speak only where there are no others."""
        patches = _patches(pixels)
        if self._kept is not None:
            moved = interpolated or self._kept_moved
            self._compare(patches, self._kept, self._smoothed if moved else self._table)
        if self._taken % _EVERY == 0:
            self._kept, self._kept_moved = patches, interpolated
        self._taken += 1

    def _compare(self, now: Plane, before: Plane, table: NDArray[np.uint32]) -> None:
        change = now - before
        if not change.any():  # a copy, as in slowed-down videos
            return
        low, high = np.minimum(now, before).min(axis=0), np.maximum(now, before).max(axis=0)
        whole = (low > 0) & (high < self._response.saturated_from)  # else noise is cut off
        now, before, change = now[:, whole], before[:, whole], change[:, whole]
        own, others = change[0], change[1:]
        light = self._response.linear_between((now[0] + before[0]) * np.float32(0.5))
        share = np.maximum(light, 0) * np.float32(1.0 / self._response.linear_full_scale)
        level = np.minimum(_LEVELS * np.sqrt(share), _LEVELS - 1).astype(np.intp)
        flat = (level * _BINS + _bin(others.std(axis=0))) * _BINS
        flat += _bin(np.abs(own - others.mean(axis=0)))
        table += np.bincount(flat, minlength=table.size).reshape(table.shape).astype(np.uint32)

    def noise(self) -> Noise | None:
        """The deviation of a frame's counts by level; None for want of data.

        No level is noisier than a sensor can be, whose variance a + b x light (read and shot noise)
        is bounded by that of any other level: where places in full light are never still, what is
        beyond it is motion.
        """
        found = self._by_level()
        if not found:
            return None
        light = np.asarray(list(found), dtype=np.float32)
        counts = self._response.counts(light)
        slope = self._response.slope(counts)
        deviation = np.asarray(list(found.values())) * slope
        grown = np.sqrt(np.maximum(light[:, None] / light[None, :], 1.0))
        bounds = np.sort(deviation[None, :] * grown, axis=1)
        bounded = bounds[:, min(1, light.size - 1)] / slope  # the least one may be chance
        return Noise(
            tuple(float(x) for x in counts), tuple(float(max(x, _ROUNDING)) for x in bounded)
        )

    def _by_level(self) -> dict[float, float]:
        """The deviation in still places, encoded counts, by the light of a level."""
        table = self._table if self._table.any() else self._smoothed
        found = {}
        for index, places in enumerate(table):
            unlike = np.cumsum(places.sum(axis=1, dtype=np.int64))
            if unlike[-1] < _ENOUGH:
                continue
            quiet = int(np.searchsorted(unlike, max(_QUIET * unlike[-1], _ENOUGH))) + 1
            light = ((index + 0.5) / _LEVELS) ** 2 * self._response.linear_full_scale
            found[light] = _MAD * _median(places[:quiet].sum(axis=0, dtype=np.int64)) / _OF_EIGHT
        return found


def _patches(pixels: NDArray[Any]) -> Plane:
    """Samples here and there, and their eight neighbours: (9, n) float32, each sample first."""
    height, width = pixels.shape[0] - 2, pixels.shape[1] - 2
    around = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    planes = [
        pixels[y : height + y : _APART, x : width + x : _APART].reshape(-1)
        for y, x in [(1, 1), *around]
    ]
    return np.asarray(planes, dtype=np.float32)


def _bin(size: Plane) -> NDArray[np.intp]:
    bins: NDArray[np.intp] = np.minimum(np.log2(1.0 + size) * _PER_OCTAVE, _BINS - 1).astype(
        np.intp
    )
    return bins


def _median(row: NDArray[np.int64]) -> float:
    """Of the sizes that a row of bins counts."""
    share = np.cumsum(row) / row.sum()
    at = int(np.searchsorted(share, 0.5))
    before = float(share[at - 1]) if at else 0.0
    within = (0.5 - before) / (float(share[at]) - before)
    return float(np.exp2((at + within) / _PER_OCTAVE) - 1.0)
