"""The noise of a camera, measured in pictures of the scan itself.

Noise is given as a standard deviation against the level of encoded counts, so that it holds for
any tone curve; two frames of an unchanged scene tell it best (`TemporalNoise`), one picture tells
an upper bound (`from_picture`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

_MAD = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
_ROUNDING = 12.0**-0.5  # deviation of a count's rounding error

_CLIPPED = 4.0  # deviations above 0 counts from which noise is whole
_CURVE = 65  # levels that a calibrated curve is given at

_LEVELS = 32  # of counts, with a table of differences each
_PER_OCTAVE = 8  # bins of a difference: 1/8 octave
_BINS = 17 * _PER_OCTAVE
_ENOUGH = 200  # differences that make a level's deviation

_SECOND_DIFFERENCE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_SECOND_DIFFERENCE_NORM = 6.0  # what it makes of independent samples of deviation 1
_BLOCK = 16  # pixels a side
_QUIET = 0.91  # of pure noise, what the quietest fifth of such blocks has
_BLOCKS = 12  # blocks that make a level's deviation
_CUT = 0.05  # of a block's samples at an end of the scale: its median difference has less noise


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviation of one frame's counts at levels of counts (both encoded, ascending)."""

    levels: tuple[float, ...]
    deviations: tuple[float, ...]

    def deviation(self, counts: NDArray[Any]) -> Plane:
        """Standard deviation at each sample's level: float32, same shape; linear between levels."""
        return np.asarray(np.interp(counts, self.levels, self.deviations), dtype=np.float32)

    @classmethod
    def of_read_and_shot(
        cls, read_counts: float, counts_per_e: float, black: float, full_scale: int
    ) -> Noise:
        """Of a calibrated linear camera: variance read² + counts_per_e x (counts - black), and the
        rounding of counts."""
        root = np.linspace(0.0, np.sqrt(max(full_scale - black, 1.0)), _CURVE)  # even in its bends
        levels = np.square(root)
        variance = read_counts**2 + counts_per_e * levels + _ROUNDING**2
        return cls(tuple((levels + black).tolist()), tuple(np.sqrt(variance).tolist()))

    def over(self, other: Noise) -> float:
        """This deviation over another's: the median over this one's levels, but for those so near
        to 0 counts that noise is cut off."""
        levels, expected = np.asarray(self.levels), other.deviation(np.asarray(self.levels))
        ratio = np.asarray(self.deviations) / expected
        whole = levels > _CLIPPED * expected
        return float(np.median(ratio[whole] if whole.any() else ratio))

    @classmethod
    def mean(cls, found: Sequence[Noise]) -> Noise:
        """The mean of some, in whatever order, at each level of those that know it."""
        levels = np.unique(np.concatenate([one.levels for one in found]))
        curves = [
            np.interp(levels, one.levels, one.deviations, left=np.nan, right=np.nan)
            for one in found
        ]
        return cls(tuple(levels.tolist()), tuple(np.nanmean(curves, axis=0).tolist()))

    def bounded_by(self, other: Noise) -> Noise:
        """The lower of two upper bounds where both are known, else the one that is."""
        levels = np.union1d(self.levels, other.levels)
        curves = []
        for one in (self, other):
            known = np.interp(levels, one.levels, one.deviations)
            curves.append(
                np.where((levels < one.levels[0]) | (levels > one.levels[-1]), np.inf, known)
            )
        lowest = np.minimum(*curves)
        # between two ranges neither knows: the line from one to the other
        inside = np.isfinite(lowest)
        return Noise(tuple(levels[inside].tolist()), tuple(lowest[inside].tolist()))

    @property
    def typical(self) -> float:
        """The median over levels, for people."""
        return float(np.median(self.deviations))


class TemporalNoise:
    """Noise from pairs of frames in which part of the scene was the same.

    Differences are counted by level and size; the median of a level's tells its noise, whatever
    moved in less than half of the picture (see `still` for more). Memory: one small table.
    """

    def __init__(self, full_scale: int) -> None:
        self._full_scale = full_scale
        self._table = np.zeros((_LEVELS, _BINS), dtype=np.int64)
        self._smoothed = np.zeros_like(self._table)  # of pairs with an interpolated frame
        self.pairs = 0

    def add(self, one: NDArray[Any], other: NDArray[Any], *, interpolated: bool = False) -> None:
        """Take in two frames of one shape (uint8, uint16 or float32 counts). Copies of one frame,
        as in slowed-down videos, say nothing and are left out. Interpolation smooths noise away:
        pairs with an `interpolated` frame speak only where there are no others."""
        difference = np.abs(one.astype(np.float32) - other)
        if not difference.any():
            return
        level = np.minimum(one.astype(np.float32) * (_LEVELS / (self._full_scale + 1)), _LEVELS - 1)
        size = np.minimum(np.log2(1.0 + difference) * _PER_OCTAVE, _BINS - 1)
        flat = level.astype(np.intp) * _BINS + size.astype(np.intp)
        counted = np.bincount(flat.reshape(-1), minlength=_LEVELS * _BINS)
        table = self._smoothed if interpolated else self._table
        table += counted.reshape(_LEVELS, _BINS)
        self.pairs += 1

    def noise(self) -> Noise | None:
        """The deviation by level, never less than the rounding of counts; None for want of data."""
        levels, deviations = [], []
        for index, row in enumerate(self._table if self._table.any() else self._smoothed):
            if row.sum() < _ENOUGH:
                continue
            found = _MAD * _difference(row) / np.sqrt(2.0)
            levels.append((index + 0.5) * (self._full_scale + 1) / _LEVELS)
            deviations.append(float(max(found, _ROUNDING)))
        return Noise(tuple(levels), tuple(deviations)) if levels else None


def _difference(row: NDArray[np.int64]) -> float:
    """The median of a row of the table; differences of whole counts stand for ± half a count."""
    edges = np.exp2(np.arange(_BINS + 1) / _PER_OCTAVE) - 1.0
    share = np.cumsum(row) / row.sum()
    at = int(np.searchsorted(share, 0.5))
    before = share[at - 1] if at else 0.0
    within = (0.5 - before) / (share[at] - before)
    # a bin holds at most one whole count where it is narrow: spread it over ± half a count
    low, high = edges[at], edges[at + 1]
    if high - low < 1.0:
        whole = np.ceil(low)
        low, high = max(whole - 0.5, 0.0), whole + 0.5
    return float(low + within * (high - low))


def noise_range(samples: int) -> float:
    """How far apart noise alone may drive the largest and smallest of so many samples, in standard
    deviations: the bound 2√(2 ln n) of a Gaussian's mean range, and 2 more to be sure."""
    return float(2.0 * np.sqrt(2.0 * np.log(max(samples, 2))) + 2.0)


def from_picture(counts: Plane, full_scale: int, step: int = 1) -> Noise:
    """Noise of a single picture (H, W) by level: what a second difference leaves where the scene is
    smooth.

    Textured blocks say too much, so that at each level the quietest fifth of the blocks speaks: an
    upper bound in a scene that is textured everywhere. Blocks at either end of the scale are left
    out, for noise is cut off there. `step` is the distance of samples of one colour (2 in a
    mosaic). Never less than the rounding of counts.
    """
    plane = np.ascontiguousarray(counts[::step, ::step])
    height, width = (n // _BLOCK for n in plane.shape)
    if height * width == 0:
        return Noise((0.0, float(full_scale)), (_ROUNDING, _ROUNDING))
    second = np.abs(cv2.filter2D(plane, -1, _SECOND_DIFFERENCE, borderType=cv2.BORDER_REFLECT))

    def by_block(values: NDArray[Any]) -> NDArray[Any]:
        tiles = values[: height * _BLOCK, : width * _BLOCK]
        tiles = tiles.reshape(height, _BLOCK, width, _BLOCK).transpose(0, 2, 1, 3)
        return tiles.reshape(height * width, -1)

    cut = by_block((plane <= 0) | (plane >= full_scale)).mean(axis=1) > _CUT
    whole = ~cut if not cut.all() else cut
    spread = np.median(by_block(np.asarray(second, dtype=np.float32))[whole], axis=1)
    level = np.median(by_block(plane)[whole], axis=1)
    order = np.argsort(level, kind="stable")
    levels, deviations = [], []
    for group in np.array_split(order, min(max(order.size // _BLOCKS, 1), 8)):
        quiet = float(np.quantile(spread[group], 0.2)) * _MAD / _SECOND_DIFFERENCE_NORM / _QUIET
        levels.append(float(np.mean(level[group])))
        deviations.append(max(quiet, _ROUNDING))
    return Noise(tuple(levels), tuple(deviations))


def from_frame(counts: NDArray[Any], full_scale: int, bayer: str) -> Noise:
    """`from_picture` of a frame (H, W) or (H, W, 3): the noisiest of its channels."""
    if counts.ndim == 2:
        return from_picture(counts.astype(np.float32), full_scale, step=2 if bayer else 1)
    channels = (from_picture(c.astype(np.float32), full_scale) for c in np.moveaxis(counts, 2, 0))
    return max(channels, key=lambda one: one.typical)
