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

NEAR = 0.05
"""Samples so far from the second most extreme one, of the way to the other end, are averaged too,
whatever the noise: where things stand close together the rest of the scene's light goes up and down
by about as much. The frames of penumbra that are within it are few."""

ALONE = 2.0
"""A sample that is so many widths of the band beyond the mean, or the second most extreme one, is
not of them: less, and a pixel that was twice there would count as covered once."""

MEMBERS = 1.25
"""Deviation of such a mean over that of one of as many samples: which of them are within the band
is a matter of noise, too (1.02 to 1.39 on simulated and rendered scenes)."""

Part = tuple[slice, slice]
WHOLE: Part = (slice(None), slice(None))

_KEPT = 2  # samples of each end that are kept in order: a level begins with them
_COUNTED = 256  # samples from which on the second most extreme of them is taken for as far off
_MOST = 65_535  # samples that are counted, and averaged
_CHUNK = 1 << 15  # samples that are worked on at a time, so that they stay in the cache


class Plateaus:
    """Both ends of each pixel's samples: the levels, and how many samples were there.

    Each band goes with the second most extreme sample; a mean that it leaves behind begins again,
    so what came before the first full light is forgotten. Constant memory: for each end two planes
    of the samples' type and two more. Samples are encoded counts.
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
        self._count = np.ones(samples.shape, np.uint16)

    def follow(
        self, samples: NDArray[Any], part: Any, span: Plane, deviation: Plane | None
    ) -> None:
        """Take in a part of a frame that `ranked` has taken in."""
        first, second = (plane[part] for plane in self.ranked.planes)
        edge = second.astype(np.float32)
        count = self._count[part]
        width = _band(count, span, noise_at(second, deviation))
        within = (samples.astype(np.float32) - edge) * self._sign >= -width
        within &= count < _MOST
        # arithmetic with masks: NumPy's `where=` takes ten times as long
        self._sum[part] += samples * within
        count += within

        # The edge goes outwards, but for the second frame: the first one was its own second.
        left = np.abs(edge - self._sum[part] / count) > width
        if left.any():
            self._restart(part, left, first, edge, width)

    def _restart(
        self, part: Any, left: NDArray[np.bool_], first: NDArray[Any], edge: Plane, width: Plane
    ) -> None:
        """Begin the mean again, with the two most extreme samples, or the second where the first
        stands alone."""
        first, edge = first[left], edge[left]
        alone = (first - edge) * self._sign > np.float32(ALONE) * width[left]
        self._sum[part][left] = np.where(alone, edge, edge + first)
        self._count[part][left] = np.where(alone, 1, _KEPT)

    def level(
        self, deviation: Plane | None, span: Plane, part: Part = WHOLE
    ) -> tuple[Plane, NDArray[np.uint16]]:
        """The level (float32 counts), and how many samples it rests on.

        A sample that is much further out than the others stands alone: it is taken for the level,
        which then rests on 1. `span` is from one end to the other, float32 counts. Raises
        ValueError with no frames.
        """
        extreme, count = self.extreme[part], self._count[part]
        mean = np.divide(self._sum[part], count, dtype=np.float32)
        width = _band(count, span, noise_at(extreme, deviation))
        beyond = (extreme.astype(np.float32) - mean) * self._sign
        alone = beyond > np.float32(ALONE) * width
        level = np.where(alone, extreme, mean).astype(np.float32)
        return level, np.where(alone, np.uint16(1), count)


def _second(count: int) -> float:
    """How far the second largest of so many samples of deviation 1 lies above their mean (Blom)."""
    return NormalDist().inv_cdf((count - 1.375) / (count + 0.25)) if count > 2 else 0.0


_REACHES = np.array([BAND + max(_second(n), 0.0) for n in range(_COUNTED)], dtype=np.float32)


def noise_at(counts: NDArray[Any], deviation: Plane | None) -> Plane | np.float32:
    """Deviation of a sample at the level `counts`; `deviation` as in `Plateaus.add`."""
    return np.float32(0) if deviation is None else np.take(deviation, counts)


def _band(count: NDArray[np.uint16], span: Plane, noise: Plane | np.float32) -> Plane:
    """How far a mean of `count` samples reaches from the second most extreme one."""
    reach = np.hypot(noise * np.take(_REACHES, count, mode="clip"), np.float32(NEAR) * span)
    return np.asarray(np.maximum(reach, np.float32(0.5)), dtype=np.float32)


def _chunks(shape: tuple[int, ...]) -> Iterator[slice]:
    rows = max(1, _CHUNK * shape[0] // max(int(np.prod(shape)), 1))
    return (slice(start, start + rows) for start in range(0, shape[0], rows))
