"""Bayer mosaics in float32: separated raw, demosaiced after (§3.5).

OpenCV's own demosaicing refuses float32 and knows nothing of missing samples. Colours come in RGB
order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

_ORDERS = ("RG", "GR", "GB", "BG")
_CELL = 16  # pixels a side, whose samples of one place in the mosaic are averaged
_CELLS = 16  # that are bright, to say anything
_COLOURED = 0.08  # of the light: the least difference of colours, as medians over the cells
_ERRORS = 4.0  # of such a median: noise alone makes no colours
_GREENS = 0.3  # of that: the greens differ by less
_NEAR = np.array([1, 2, 1], dtype=np.float32)  # along each axis: of any colour its neighbours
_NEXT = np.array([1, 0, 1, 0, 1], dtype=np.float32)  # the next samples of the same colour
_MISSED = np.float32(0.36)  # of that distance's texture: .7 .. 1.8 of the error at 1.5 .. 8 px
_DARK = np.float32(5.0)  # deviations of noise: a sample of less tells no proportion


def colour_masks(shape: tuple[int, int], bayer: str) -> NDArray[np.bool_]:
    """Which samples of a mosaic are red, green, blue: (3, H, W) bool.

    `bayer` names the first two pixels of the first row: RG, GR, GB or BG. Raises ValueError.
    """
    if bayer not in _ORDERS:
        raise ValueError(f"the mosaic {bayer!r} is none of {', '.join(_ORDERS)}")
    below = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[bayer]
    masks = np.zeros((3, *shape), dtype=np.bool_)
    for row, colours in enumerate((bayer, below)):
        for column, colour in enumerate(colours):
            masks["RGB".index(colour), row::2, column::2] = True
    return masks


def demosaic(mosaic: Plane, bayer: str) -> Plane:
    """RGB from a Bayer mosaic: see `Mosaic.colours`."""
    return Mosaic(np.isfinite(mosaic), bayer).colours(mosaic)


class Mosaic:
    """Where the samples of a mosaic lie, for planes (H, W) float32 that are of one frame.

    `valid` (H, W) bool: samples that are there. What is not is left out of its neighbours, and
    interpolated only in the colours that it was not a sample of: it stays as it is, NaN.
    """

    def __init__(self, valid: NDArray[np.bool_], bayer: str) -> None:
        masks = colour_masks(_sides(valid), bayer)
        self._valid = valid
        self._missing = None if valid.all() else ~valid
        self._masks = masks
        self._present = (masks & valid).astype(np.float32)
        self._apart = (~masks).astype(np.float32)
        with np.errstate(invalid="ignore", divide="ignore"):
            self._shares = [
                apart / _around(present, _NEAR)
                for apart, present in zip(self._apart, self._present, strict=True)
            ]

    def colours(self, plane: Plane) -> Plane:
        """(H, W) -> (H, W, 3) in RGB order: bilinear, normalised by the samples that are there, so
        that borders need no padding."""
        return _merged(self._interpolated(self._there(plane), _NEAR, self._shares))

    def noise(self, deviation: Plane) -> Plane:
        """Standard deviations (H, W) of independent samples -> those of `colours`, (H, W, 3): a
        colour that is the mean of n neighbours has less noise than a sample."""
        variance = np.square(self._there(deviation))
        shares = [np.square(share) for share in self._shares]
        spread = self._interpolated(variance, np.square(_NEAR), shares)
        return _merged([np.sqrt(plane, out=plane) for plane in spread])

    def error(self, plane: Plane, noise: Plane, colours: Plane) -> Plane:
        """What texture finer than the mosaic may put colours off by, as a deviation (H, W, 3): 0
        for those that are samples.

        A sample tells how far the light at its own place is from the mean of its neighbours of the
        same colour, two pixels off. Beyond `noise` (H, W), the deviation of samples, that is
        texture, which the other colours have in proportion, more or less; and the nearer neighbours
        that they are interpolated from miss about a third of it.
        """
        values = self._there(plane)
        there = self._valid.astype(np.float32)
        around = _around(values, _NEXT) - values  # and the corners, which are of its colour too
        around /= np.maximum(_around(there, _NEXT) - there, np.float32(1))
        noise = self._there(noise)
        level = np.maximum(np.abs(around), _DARK * noise)
        least = np.float32(1e-6) * level.max()  # 0 where no sample is known
        np.maximum(level, least if least > 0 else np.float32(1), out=level)
        texture = np.square((values - around) * there)
        texture -= np.float32(1 + 1 / 8) * np.square(noise)
        texture /= np.square(level)
        part = cv2.blur(texture, (3, 3), borderType=cv2.BORDER_REFLECT)
        part = _MISSED * np.sqrt(np.maximum(part, 0))
        parts = _merged([part * apart for apart in self._apart])
        return np.asarray(np.abs(colours) * parts, dtype=np.float32)

    def _there(self, plane: Plane) -> Plane:
        return plane if self._missing is None else np.where(self._valid, plane, np.float32(0))

    def _interpolated(self, values: Plane, weights: Plane, shares: Sequence[Plane]) -> list[Plane]:
        planes = []
        for mask, present, share in zip(self._masks, self._present, shares, strict=True):
            samples = values * present
            with np.errstate(invalid="ignore"):  # where there is no neighbour
                plane = _around(samples, weights) * share
            plane += samples
            if self._missing is not None:
                plane[mask & self._missing] = np.nan
            planes.append(plane)
        return planes


def orders_of(pixels: NDArray[np.generic]) -> tuple[str, ...]:
    """Which mosaics a grey picture (H, W) may be: RG and BG, or GR and GB; () if it is none.

    Neighbours of a mosaic differ in the same way all over the picture, by their colours, but for
    the two greens, which lie on a diagonal. Texture and noise differ now this way, now that.
    """
    height, width = (side // _CELL * _CELL for side in pixels.shape)
    if not height or not width:
        return ()
    picture = pixels[:height, :width].astype(np.float32)
    samples = picture.reshape(height // _CELL, _CELL // 2, 2, width // _CELL, _CELL // 2, 2)
    means = samples.mean(axis=(1, 4)).transpose(1, 3, 0, 2).reshape(4, -1)  # of 2 x 2 places
    light = means.mean(axis=0)
    bright = light > 0.1 * np.quantile(light, 0.99)
    if np.count_nonzero(bright) < _CELLS:
        return ()
    parts = means[:, bright] / light[bright]
    middle = np.median(parts, axis=1, keepdims=True)
    first, right, below, last = middle[:, 0]
    apart = float(np.ptp((first, right, below, last)))
    spread = 1.4826 * float(np.median(np.abs(parts - middle), axis=1).max())
    error = 1.25 * spread / np.sqrt(parts.shape[1])  # of a median
    if apart < max(_COLOURED, _ERRORS * error):
        return ()
    falling, rising = abs(first - last), abs(right - below)
    if min(falling, rising) > _GREENS * apart:
        return ()
    if max(falling, rising) > _GREENS * apart:
        sure = rising - falling
    else:  # red is about as bright as blue, and green is brighter
        sure = (first + last - right - below) / 2
    if abs(sure) < _ERRORS * error:
        return ()
    return ("RG", "BG") if sure < 0 else ("GR", "GB")


def _around(plane: Plane, weights: Plane) -> Plane:
    """Sums over a square, weighted along each axis; beyond the border is nothing."""
    summed = cv2.sepFilter2D(plane, -1, weights, weights, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, dtype=np.float32)


def _merged(planes: Sequence[Plane]) -> Plane:
    return np.asarray(cv2.merge(list(planes)), dtype=np.float32)


def _sides(plane: NDArray[Any]) -> tuple[int, int]:
    return plane.shape[0], plane.shape[1]
