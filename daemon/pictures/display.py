"""From linear light to something to look at: sRGB, 8 bits, small.

Pictures here are for eyes. Nothing is measured in them.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation import radiometry
from drivers.base.pixelformat import PixelFormat

Picture = NDArray[np.uint8]
"""(h, w, 3) sRGB, RGB order."""

UNMEASURED = (255, 0, 200)
"""The colour of NaN: no scene has it."""

_STRIPE = 4  # pixels of a hatching stripe


def for_display(
    linear: NDArray[Any],
    full_scale: float,
    white_balance: tuple[float, float, float] | None = None,
    width: int | None = None,
) -> Picture:
    """Linear light as a picture, white at `full_scale`; what is above is clipped.

    `linear`: (H, W) or (H, W, 3) RGB, uint8, uint16 or float32. Larger pictures than `width` are
    reduced by area averages. NaN is left out of averages, and hatched where nothing else is.
    `white_balance` are gains of R, G, B.
    """
    light, measured = _reduced(linear, width)
    if light.ndim == 2:
        light = np.repeat(light[..., None], 3, axis=2)
    gains = np.asarray(white_balance or (1.0, 1.0, 1.0), dtype=np.float32)
    picture = encode(light * (gains / np.float32(full_scale)))
    if measured is not None:
        y, x = np.indices(measured.shape)
        stripe = (x + y) // _STRIPE % 2 == 0
        hatching = np.where(stripe[..., None], UNMEASURED, (70, 0, 55))
        picture = np.where((measured < 0.5)[..., None], hatching, picture).astype(np.uint8)
    return picture


def thumbnail(
    pixels: NDArray[Any], pixel_format: PixelFormat, width: int, tone: str = "linear"
) -> Picture:
    """A camera's frame as a small picture, white at its full scale.

    See `frame_light`; the result is at most `width` columns wide.
    """
    return for_display(frame_light(pixels, pixel_format, width, tone), pixel_format.full_scale)


def frame_light(
    pixels: NDArray[Any], pixel_format: PixelFormat, width: int, tone: str = "linear"
) -> NDArray[np.float32]:
    """A camera's frame reduced to at most `width` columns, in linear counts, float32.

    A mosaic is reduced to half its size, two by two samples to a colour. `tone` is the curve that
    the camera encoded with; it is undone after the reduction, which is near enough for eyes.
    """
    small = _binned(pixels, pixel_format.bayer) if pixel_format.bayer else pixels
    reduced, _ = _reduced(small, width)
    if tone == "linear":
        return reduced
    full_scale = pixel_format.full_scale
    encoded = np.clip(reduced / full_scale, 0, 1).astype(np.float64)
    return (radiometry.decode(encoded, tone) * full_scale).astype(np.float32)


def encode(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Light from 0 to 1 as 8-bit sRGB (IEC 61966-2-1); clipped, NaN to 0."""
    steps = np.clip(np.nan_to_num(linear) * np.float32(_TABLE.size - 1), 0, _TABLE.size - 1)
    return np.asarray(_TABLE[steps.astype(np.uint16)])


def common_white(*planes: NDArray[Any]) -> float:
    """The level that is shown as white when these planes (the same scene) are compared.

    The 99.5th percentile of their brightest channels, from a sample; 1 where all is dark.
    """
    found = 0.0
    for plane in planes:
        step = max(1, int((plane.shape[0] * plane.shape[1] / 250_000) ** 0.5))
        sample = plane[::step, ::step].astype(np.float32)
        if sample.ndim == 3:
            sample = sample.max(axis=2)
        finite = sample[np.isfinite(sample)]
        if finite.size:
            found = max(found, float(np.percentile(finite, 99.5)))
    return found if found > 0 else 1.0


def fit(height: int, width: int, limit: int | None) -> tuple[int, int]:
    """Height and width of a picture reduced to at most `limit` columns."""
    if limit is None or width <= limit:
        return height, width
    return max(1, round(height * limit / width)), limit


def _reduced(
    linear: NDArray[Any], width: int | None
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Area averages as float32, and which share of each is measured (None: all of all)."""
    height, width = fit(linear.shape[0], linear.shape[1], width)
    if linear.dtype.kind != "f":
        small = _area(linear, height, width)
        return small.astype(np.float32), None
    valid = np.isfinite(linear)
    if valid.all():
        return _area(linear, height, width).astype(np.float32), None
    weight = _area(valid.astype(np.float32), height, width)
    total = _area(np.where(valid, linear, 0).astype(np.float32), height, width)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / weight
    return mean, weight if weight.ndim == 2 else weight.min(axis=2)


def _area(plane: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    if plane.shape[:2] == (height, width):
        return plane
    return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_AREA))


def _binned(mosaic: NDArray[Any], bayer: str) -> NDArray[np.float32]:
    """A mosaic's two by two samples as one colour each: (H, W) -> (H // 2, W // 2, 3)."""
    height, width = mosaic.shape[0] // 2 * 2, mosaic.shape[1] // 2 * 2
    below = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[bayer]
    colours = np.zeros((height // 2, width // 2, 3), dtype=np.float32)
    for y, row in enumerate((bayer, below)):
        for x, colour in enumerate(row):
            share = 0.5 if colour == "G" else 1.0
            colours[..., "RGB".index(colour)] += mosaic[y:height:2, x:width:2] * np.float32(share)
    return colours


_TABLE: NDArray[np.uint8] = np.rint(
    255 * radiometry.encode(np.linspace(0.0, 1.0, 4096), "srgb")
).astype(np.uint8)
