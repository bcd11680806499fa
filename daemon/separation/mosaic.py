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


def _filter(plane: Plane, kernel: Plane) -> Plane:
    filtered = cv2.filter2D(plane, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered, dtype=np.float32)
