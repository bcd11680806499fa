"""The levels at which a pixel's samples gather: in full light, and in the umbra.

The most extreme of n noisy samples is off by about √(2 ln n) standard deviations. Here all samples
near the extreme are averaged as they come, so that noise averages out however long the scan.

The rest of the scene's light makes extremes, too: behind a mesh it is not quite β of what it is in
the open, but comes and goes as the shadow moves, and the darkest moment is the one in which it was
least. So samples are averaged over a part of what the pixel's light changes by, even without noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.order import Ranked
from daemon.separation.radiometry import Plane

BAND = 1.5
"""Samples so many standard deviations short of a level are averaged; those beyond it all are."""

GOING = 0.003
"""Deviation of light from the rest of the scene, of the way to the other end, in samples without
any noise. It goes up and down; but penumbra, which a wider band takes in, adds to an umbra only."""

LEFT = 0.75
"""Part of the band's width by which its edge may leave the mean behind before that begins again."""

NEAR = 0.1
"""Samples so far from the second most extreme one, of the way to the other end, count as being
there; or within the band, if that is wider."""

ALONE = 1.5
"""A sample that is so many widths of the band beyond the mean is not of it."""

Part = tuple[slice, slice]
WHOLE: Part = (slice(None), slice(None))

_KEPT = 2  # samples of each end that are kept in order: a level begins with them
_COUNTED = 256  # samples from which on the second most extreme of them is taken for as far off
_MOST = 65_535  # samples that are counted, and averaged
_CHUNK = 1 << 15  # samples that are worked on at a time, so that they stay in the cache


class Plateaus:
    """Both ends of each pixel's samples: the levels, and how many samples were there.

    Each band's edge follows the second most extreme sample; the mean begins again when the edge has
    moved on, so what came before the first full light is forgotten. Constant memory: for each end
    two planes of the samples' type and four more. Samples are encoded counts.
    """

    def __init__(self) -> None:
        self.high = _End(largest=True)
        self.low = _End(largest=False)

    @property
    def frames(self) -> int:
        """Frames taken in."""
        return self.high.ranked.frames

    def add(self, samples: NDArray[Any], deviation: Plane | None) -> None:
        """Take in a frame; `deviation` of one sample is float32, by count (a table); None: 0."""
        ends = (self.high, self.low)
        for end in ends:
            end.ranked.add(samples)
        if self.frames == 1:
            for end in ends:
                end.begin(samples)
            return
        for part in _chunks(samples.shape):
            span = self.high.edge(part) - self.low.edge(part)
            for end in ends:
                end.follow(samples[part], part, span, deviation)


class _End:
    """One end of the samples' range."""

    def __init__(self, *, largest: bool) -> None:
        self.ranked = Ranked(_KEPT, largest=largest)
        self._sign = np.float32(1 if largest else -1)

    @property
    def extreme(self) -> NDArray[Any]:
        """The most extreme sample. Raises ValueError with no frames."""
        first: NDArray[Any] = self.ranked.planes[0]
        return first

    def edge(self, part: Any) -> Plane:
        """The second most extreme sample of a part of the picture, float32."""
        second: Plane = self.ranked.planes[1][part].astype(np.float32)
        return second

    def begin(self, samples: NDArray[Any]) -> None:
        """Take the first frame for what there is."""
        self._sum = samples.astype(np.float32)
        self._near_base = self._sum.copy()  # the edge when counting began
        self._count = np.ones(samples.shape, np.uint16)
        self._near = np.ones(samples.shape, np.uint16)

    def follow(
        self, samples: NDArray[Any], part: Any, span: Plane, deviation: Plane | None
    ) -> None:
        """Take in a part of a frame that `ranked` has taken in."""
        first, second = (plane[part] for plane in self.ranked.planes)
        edge = second.astype(np.float32)
        count, near = self._count[part], self._near[part]
        width = _band(count, spread(second, span, deviation))
        reach = np.maximum(np.float32(NEAR) * span, width)
        beyond = (samples.astype(np.float32) - edge) * self._sign
        within = beyond >= -width
        within &= count < _MOST
        # arithmetic with masks: NumPy's `where=` takes ten times as long
        self._sum[part] += samples * within
        count += within
        near += (beyond >= -reach) & (near < _MOST)

        # The edge goes outwards, but for the second frame: the first one was its own second.
        left = np.abs(edge - self._sum[part] / count) > np.float32(LEFT) * width
        if left.any():
            self._restart(part, left, first, edge, width)
        afar = np.abs(edge - self._near_base[part]) > reach
        if afar.any():
            alone = (first[afar] - edge[afar]) * self._sign > reach[afar]
            near[afar] = np.where(alone, 1, _KEPT)
            self._near_base[part][afar] = edge[afar]

    def _restart(
        self, part: Any, left: NDArray[np.bool_], first: NDArray[Any], edge: Plane, width: Plane
    ) -> None:
        """Begin the mean again, with the two most extreme samples, or the second where the first
        stands alone."""
        first, edge = first[left], edge[left]
        alone = (first - edge) * self._sign > width[left]
        self._sum[part][left] = np.where(alone, edge, edge + first)
        self._count[part][left] = np.where(alone, 1, _KEPT)

    def level(
        self, deviation: Plane | None, span: Plane, part: Part = WHOLE
    ) -> tuple[Plane, NDArray[np.uint16], NDArray[np.uint16]]:
        """The level (float32 counts), how many samples it rests on, and how many were near it.

        A sample beyond the level by a tenth of `span` (float32, counts) and more than noise stands
        alone: it is taken for the level, which then rests on 1. Raises ValueError with no frames.
        """
        extreme, count = self.extreme[part], self._count[part]
        mean = np.divide(self._sum[part], count, dtype=np.float32)
        width = _band(count, spread(extreme, span, deviation))
        beyond = (extreme.astype(np.float32) - mean) * self._sign
        alone = beyond > np.maximum(np.float32(NEAR) * span, np.float32(ALONE) * width)
        level = np.where(alone, extreme, mean).astype(np.float32)
        one = np.uint16(1)
        near = np.maximum(self._near[part], count)
        return level, np.where(alone, one, count), np.where(alone, one, near)


def _second(count: int) -> float:
    """How far the second largest of so many samples of deviation 1 lies above their mean (Blom)."""
    return NormalDist().inv_cdf((count - 1.375) / (count + 0.25)) if count > 2 else 0.0


_REACHES = np.array([BAND + max(_second(n), 0.0) for n in range(_COUNTED)], dtype=np.float32)


def spread(counts: NDArray[Any], span: Plane, deviation: Plane | None) -> Plane:
    """How far samples of one level lie apart (standard deviation, float32 counts), at the level
    `counts`. `span` is from one end of the pixel's samples to the other, `deviation` as in
    `Plateaus.add`."""
    going = np.float32(GOING) * span
    if deviation is not None:
        going = np.hypot(going, np.take(deviation, counts))
    return np.asarray(going, dtype=np.float32)


def _band(count: NDArray[np.uint16], apart: Plane) -> Plane:
    """How far a mean of `count` samples, spread so far, reaches from the second most extreme."""
    return np.maximum(apart * np.take(_REACHES, count, mode="clip"), np.float32(0.5))


def _chunks(shape: tuple[int, ...]) -> Iterator[slice]:
    rows = max(1, _CHUNK * shape[0] // max(int(np.prod(shape)), 1))
    return (slice(start, start + rows) for start in range(0, shape[0], rows))
