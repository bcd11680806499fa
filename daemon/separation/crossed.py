"""Where an occluder's shadow has passed over the picture, and where it never did (§4.2).

L_max and L_min say nothing of a pixel that the shadow never crossed: its minimum is its own noise,
and direct = 0 would be a lie. The frames tell it from a pixel that the source never reaches, whose
direct light *is* 0:

- *drop*: L_max - L_min beyond what noise does over that many frames and beyond the part of the
  light that comes and goes with the rest of the scene. Seen: the shadow was here.
- no drop, though the drop of the pixels around, at this pixel's brightness, would have been seen:
  the pixel is either *never unlit* or in the scene's own shadow. In such a shadow it is about as
  bright as its surroundings are unlit, and the occluder passed on both sides of it.
- no drop, and none to be expected of so dark a pixel: the same question is put to the mean of a
  cell of pixels, whose noise is smaller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import NotYet
from daemon.separation.noise import TemporalNoise, noise_range
from daemon.separation.radiometry import Plane, Response

CELL = 8
"""Side of a cell, in pixels: its mean has an eighth of a pixel's noise."""

LEAST_DROP = 0.05
"""A smaller part of the light comes and goes with interreflection when an occluder passes by."""

LEAST_SHARE = 0.15
"""Nor is a drop the occluder's that is a smaller share of what most of the crossed scene lost."""

_TINY = np.float32(1e-6)


class Cells:
    """The darkest and the brightest mean of each cell, as frames come: two small planes."""

    def __init__(self, response: Response) -> None:
        self._response = response
        self._low: Plane | None = None
        self._high: Plane | None = None
        self._last: Plane | None = None
        self._noise = TemporalNoise(response.full_scale)

    def add(self, pixels: NDArray[Any]) -> None:
        """Take in a frame."""
        cells = _means(pixels)
        if self._low is None or self._high is None or self._last is None:
            self._low, self._high = cells.copy(), cells.copy()
        else:
            np.minimum(self._low, cells, out=self._low)
            np.maximum(self._high, cells, out=self._high)
            self._noise.add(self._last, cells)
        self._last = cells

    def crossed(self, frames: int) -> Crossed:
        """What they tell of the shadow's way over so many frames. Raises NotYet."""
        if self._low is None or self._high is None:
            raise NotYet("no frame has come yet")
        low = self._response.linear_between(self._low)
        high = self._response.linear_between(self._high)
        deviation = self._response.deviation(self._noise.noise(), self._high)
        noisy: Plane = np.float32(noise_range(frames)) * deviation
        fraction = np.divide(high - low, np.maximum(high, _TINY), dtype=np.float32)
        least = LEAST_DROP
        crossed = (high - low > noisy) & (fraction > least)
        if crossed.any():
            least = max(least, LEAST_SHARE * float(np.median(fraction[crossed])))
            crossed &= fraction > least
        return Crossed(low, high, noisy, fraction, crossed, least, frames)


@dataclass(frozen=True, slots=True)
class Crossed:
    """What the cells tell of a sweep. Of each cell, in linear light (float32): its darkest and its
    brightest mean, how much of their difference noise explains, the fraction that was lost, and
    whether the shadow crossed it. `least` is the least fraction that says so."""

    low: Plane
    high: Plane
    noisy: Plane
    fraction: Plane
    crossed: NDArray[np.bool_]
    least: float
    frames: int

    def seen(self, low: Plane, high: Plane, deviation: Plane) -> NDArray[np.bool_]:
        """Pixels (H, W) whose light fell beyond noise: twice, or once with their whole cell.

        `low` and `high` (n, H, W[, 3]): their darkest and brightest samples, the most extreme
        first; `deviation`: of noise in them.
        """
        enough = np.maximum(
            np.float32(noise_range(self.frames)) * deviation, np.float32(self.least) * high[0]
        )
        twice = _any(high[1] - low[1] > enough)
        once = _any(high[0] - low[0] > enough)
        return twice | (once & _grown(self.crossed, twice.shape))

    def never_unlit(
        self, seen: NDArray[np.bool_], brightest: Plane, deviation: Plane
    ) -> NDArray[np.bool_]:
        """Pixels (H, W) that the shadow never reached, as far as the pixels around can tell."""
        if not self.crossed.any():
            return np.ones_like(seen)
        unlit_around, lit_around = self._around()
        lost = lit_around - unlit_around
        fraction = np.divide(lost, np.maximum(lit_around, _TINY), dtype=np.float32)
        between: Plane = (unlit_around + lit_around) * np.float32(0.5)
        passed_by = _enclosed(self.crossed)
        cell_never = self._never()
        shape = seen.shape
        grey = grey_of(brightest)
        expected = _smooth(fraction, shape) * grey
        tells = expected > np.maximum(
            np.float32(noise_range(self.frames)) * grey_of(deviation), self.least * grey
        )
        shadow = (grey < _smooth(between, shape)) & _grown(passed_by, shape)
        near = cv2.dilate(cell_never.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        return ~seen & np.where(tells, ~shadow & _grown(near, shape), _grown(cell_never, shape))

    def shares(self) -> tuple[float, float]:
        """The part of the cells that the shadow has crossed: of all, and of those on which it would
        show."""
        crossed = float(self.crossed.mean())
        if crossed == 0.0:
            return 0.0, 0.0
        return crossed, crossed / (crossed + float(self._never().mean()))

    def _around(self) -> tuple[Plane, Plane]:
        """What crossed cells around say of each cell: its light in shadow, and out of it."""
        weight = np.where(self.crossed, self.fraction, np.float32(0)) ** 4
        return _around(self.low, weight), _around(self.high, weight)

    def _never(self) -> NDArray[np.bool_]:
        """Cells that the shadow never reached though it would show on them; some are crossed."""
        unlit, lit = self._around()
        fraction = np.divide(lit - unlit, np.maximum(lit, _TINY), dtype=np.float32)
        between = (unlit + lit) * np.float32(0.5)
        return np.asarray(
            ~self.crossed
            & (fraction * self.high > np.maximum(self.noisy, self.least * self.high))
            & ~((self.high < between) & _enclosed(self.crossed))
        )


def _means(pixels: NDArray[Any]) -> Plane:
    """Means of cells of CELL x CELL pixels and all channels: float32, the last ones partial."""
    height, width = (-(-n // CELL) for n in pixels.shape[:2])
    pad = ((0, height * CELL - pixels.shape[0]), (0, width * CELL - pixels.shape[1]))
    whole = (
        pixels
        if not any(after for _, after in pad)
        else cv2.copyMakeBorder(pixels, 0, pad[0][1], 0, pad[1][1], cv2.BORDER_REPLICATE)
    )
    rows = np.add.reduce(
        whole.reshape(height, CELL, -1), axis=1, dtype=np.uint32
    )  # (height, width * CELL * channels)
    sums = np.add.reduce(rows.reshape(height, width, -1), axis=2, dtype=np.uint32)
    samples = CELL * CELL * (1 if pixels.ndim == 2 else pixels.shape[2])
    return np.asarray(sums, dtype=np.float32) * np.float32(1.0 / samples)


def _around(plane: Plane, weight: Plane) -> Plane:
    """Each cell's surroundings: weighted means, from as near as there is any weight."""
    filled = np.zeros_like(plane)
    missing = np.ones(plane.shape, dtype=np.bool_)
    values = plane * weight
    enough = np.float32(0.02) * weight.max()
    reach = 2.0
    while missing.any():
        near = np.asarray(cv2.GaussianBlur(weight, (0, 0), reach), dtype=np.float32)
        total = np.asarray(cv2.GaussianBlur(values, (0, 0), reach), dtype=np.float32)
        found = missing & (near > enough)
        filled[found] = total[found] / near[found]
        missing &= ~found
        reach *= 2.0
        if reach > max(plane.shape):
            filled[missing] = values.sum() / weight.sum()
            break
    return filled


def _grown(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """A mask of cells as one of pixels."""
    pixels = np.repeat(np.repeat(mask, CELL, axis=0), CELL, axis=1)
    return pixels[: shape[0], : shape[1]]


def _smooth(plane: Plane, shape: tuple[int, ...]) -> Plane:
    """A plane of cells as one of pixels, interpolated between the cells' centres."""
    size = (plane.shape[1] * CELL, plane.shape[0] * CELL)
    pixels = cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(pixels[: shape[0], : shape[1]], dtype=np.float32)


def _enclosed(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells from which a crossed cell lies in three of the four directions at least."""
    left = np.logical_or.accumulate(seen, axis=1)
    right = np.logical_or.accumulate(seen[:, ::-1], axis=1)[:, ::-1]
    above = np.logical_or.accumulate(seen, axis=0)
    below = np.logical_or.accumulate(seen[::-1], axis=0)[::-1]
    sides = left.astype(np.uint8) + right + above + below
    return np.asarray(sides >= 3)


def _any(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask if mask.ndim == 2 else np.asarray(np.logical_or.reduce(mask, axis=2))


def grey_of(light: Plane) -> Plane:
    """The mean of a plane's colours."""
    return light if light.ndim == 2 else np.asarray(light.mean(axis=2), dtype=np.float32)
