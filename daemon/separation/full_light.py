"""The mean of a pixel's samples in full light, and in the umbra, while an occluder goes by.

A pixel is in full light for most of a sweep, so that its level there is a mean of many frames. In
the umbra it may have been once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane

LIT = 0.25
"""A sample that has lost less, of what a pixel lost at its darkest, is taken for lit: a frame or
two of penumbra among many ..."""

LIT_DEVIATIONS = 5.0
"""... or that noise may have made so."""

PARTED = 2.0 * 2.0**0.5
"""Deviations by which noise parts two samples of one level."""

_WORTH = 1.25**-2
"""What a sample of many in the umbra is worth of others: which of them noise lets in differs (see
`plateau.MEMBERS`)."""

_LIMITED = 8
"""Frames after which it is asked again what is lit."""

_MOST = 65_535
"""Samples that are averaged: their number is kept in 16 bits."""


class FullLight:
    """The mean of a pixel's samples in full light: three planes.

    A sample counts as lit above a limit that lies a little below the second brightest so far. The
    limit rises with the brightest samples; it is set anew every few frames only, for an old one
    lets too many samples pass, not too few. A mean that has come to lie below the limit (the first
    frames had the shadow there) begins again.
    """

    def __init__(self) -> None:
        self._frames = 0
        self._sum = np.zeros(0, np.uint32)
        self._count = np.zeros(0, np.uint16)
        self._least: NDArray[Any] = np.zeros(0, np.uint8)

    def add(
        self, samples: NDArray[Any], edge: NDArray[Any], darkest: NDArray[Any], table: Plane | None
    ) -> None:
        """Take in a frame; `edge` is the second brightest sample of each pixel, `darkest` the
        darkest, this frame's among them; `table` the deviation of noise by counts."""
        if not self._frames:
            self._sum = np.zeros(samples.shape, np.uint32)
            self._count = np.zeros(samples.shape, np.uint16)
        if self._frames < _LIMITED or self._frames % _LIMITED == 0:
            self._least = _least_lit(edge, darkest, table)
            left = self._sum < self._least.astype(np.uint32) * self._count
            self._sum[left], self._count[left] = 0, 0
        lit = (samples >= self._least) & (self._count < _MOST)
        self._sum += samples * lit
        self._count += lit
        self._frames += 1

    def level(
        self, edge: NDArray[Any], darkest: NDArray[Any], table: Plane | None
    ) -> tuple[Plane, NDArray[np.uint16]]:
        """The mean, float32 counts, and of how many: the second brightest sample where none was
        lit."""
        mean = self._sum / np.maximum(self._count, 1).astype(np.float32)
        behind = (self._count == 0) | (mean < _least_lit(edge, darkest, table))
        level = np.where(behind, edge, mean).astype(np.float32)
        return level, np.where(behind, np.uint16(1), self._count)


def _least_lit(edge: NDArray[Any], darkest: NDArray[Any], table: Plane | None) -> NDArray[Any]:
    """The least sample of each pixel that is taken for lit, in the samples' type."""
    brightest = edge.astype(np.float32)
    width = np.float32(LIT) * (brightest - darkest)
    if table is not None:
        np.maximum(width, np.float32(LIT_DEVIATIONS) * np.take(table, edge), out=width)
    least: NDArray[Any] = np.ceil(np.maximum(brightest - width, 0)).astype(edge.dtype)
    return least


class Umbra:
    """The mean of a pixel's samples that noise alone may part from the second darkest: two planes.

    It begins again, with the two darkest, when it is further off than that itself: what came before
    was lit.
    """

    def __init__(self) -> None:
        self._sum = np.zeros(0, np.uint32)
        self._count = np.zeros(0, np.uint16)

    def add(self, samples: NDArray[Any], darkest: NDArray[Any], table: Plane | None) -> None:
        """Take in a frame; `darkest` are the darkest samples of each pixel, two or more, this
        frame's among them; `table` as in `FullLight`."""
        if not self._count.size:
            self._sum = samples.astype(np.uint32)
            self._count = np.ones(samples.shape, np.uint16)
            return
        most = _most_dark(darkest[1], table)
        dark = (samples <= most) & (self._count < _MOST)
        self._sum += samples * dark
        self._count += dark
        left = self._sum > self._count * most.astype(np.uint32)
        if left.any():
            self._sum[left] = darkest[0][left].astype(np.uint32) + darkest[1][left]
            self._count[left] = 2

    def level(
        self, kept: NDArray[Any], lit: Plane, table: Plane | None
    ) -> tuple[Plane, NDArray[np.uint16]]:
        """The mean, float32 counts, and how many samples it is worth.

        `kept` are the darkest samples, in order, `lit` the level in full light. Those that noise
        alone may part from the darkest are the umbra's. Where they all are, there may be more, and
        the mean is of those, unless noise may take lit ones for them.
        """
        near = kept <= _most_dark(kept[0], table)
        count = np.count_nonzero(near, axis=0).astype(np.uint16)
        few = np.sum(kept * near, axis=0, dtype=np.float32) / count
        apart = _most_dark(_most_dark(kept[1], table), table) < lit
        many = (count == len(kept)) & (self._count > count) & apart
        mean = self._sum / self._count.astype(np.float32)
        level = np.where(many, mean, few).astype(np.float32)
        worth = (self._count * _WORTH).astype(np.uint16)
        return level, np.where(many, np.maximum(worth, count), count)


def _most_dark(darkest: NDArray[Any], table: Plane | None) -> NDArray[Any]:
    """The largest sample of each pixel that noise alone may part from `darkest`."""
    if table is None:
        return darkest
    every = np.arange(table.size)
    most = np.minimum(every + PARTED * table, table.size - 1).astype(darkest.dtype)
    return np.take(most, darkest)
