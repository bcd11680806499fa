"""Bayer mosaics in float32: separated raw, demosaiced after (§3.5).

OpenCV's own demosaicing refuses float32 and knows nothing of missing samples. Colours come in RGB
order.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

_ORDERS = ("RG", "GR", "GB", "BG")
_CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], dtype=np.float32)
_CELL = 16  # pixels a side, whose samples of one place in the mosaic are averaged
_CELLS = 16  # that are bright, to say anything
_COLOURED = 0.08  # of the light: the least difference of colours, as medians over the cells
_ERRORS = 4.0  # of such a median: noise alone makes no colours
_GREENS = 0.3  # of that: the greens differ by less
_SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], dtype=np.float32)


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
    """RGB from a Bayer mosaic: (H, W) float32 -> (H, W, 3) float32.

    Bilinear, normalised by the samples that are there: borders need no padding, and a NaN sample
    is left out of its neighbours and interpolated only in the colours that it was not a sample of.
    """
    valid = np.isfinite(mosaic)
    values = np.where(valid, mosaic, np.float32(0))
    rgb = np.empty((*mosaic.shape, 3), dtype=np.float32)
    for channel, mask in enumerate(colour_masks((mosaic.shape[0], mosaic.shape[1]), bayer)):
        kernel = _CROSS if channel == 1 else _SQUARE
        present = (mask & valid).astype(np.float32)
        weight = _filter(present, kernel)
        total = _filter(values * present, kernel)
        with np.errstate(invalid="ignore", divide="ignore"):
            interpolated = total / weight
        rgb[..., channel] = np.where(mask, mosaic, interpolated)
    return rgb


def demosaic_deviation(deviation: Plane, bayer: str) -> Plane:
    """Standard deviations (H, W) of independent samples -> those of `demosaic`'s colours (H, W, 3):
    a colour that is the mean of n neighbours has less noise than a sample."""
    valid = np.isfinite(deviation)
    variance = np.where(valid, np.square(deviation), np.float32(0))
    rgb = np.empty((*deviation.shape, 3), dtype=np.float32)
    masks = colour_masks((deviation.shape[0], deviation.shape[1]), bayer)
    for channel, mask in enumerate(masks):
        kernel = _CROSS if channel == 1 else _SQUARE
        present = (mask & valid).astype(np.float32)
        weight = _filter(present, kernel)
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.sqrt(_filter(variance * present, np.square(kernel))) / weight
        rgb[..., channel] = np.where(mask, deviation, spread)
    return rgb


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


def _filter(plane: Plane, kernel: Plane) -> Plane:
    filtered = cv2.filter2D(plane, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered, dtype=np.float32)
