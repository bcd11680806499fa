"""Single pictures for clients: a frame as PNG, a component as a small sRGB picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.pictures.display import common_white, fit, for_display
from daemon.separation.mosaic import demosaic
from drivers.base.pixelformat import PixelFormat

Picture = NDArray[np.uint8]


def narrowed(picture: Picture, width: int) -> Picture:
    """A picture of at most `width` columns."""
    height, width = fit(picture.shape[0], picture.shape[1], width)
    if (height, width) == picture.shape[:2]:
        return picture
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def component(linear: NDArray[np.float32], width: int) -> Picture:
    """Direct or global as a picture of at most `width` columns, its own bright parts white."""
    return for_display(linear, common_white(linear), width=width)


def png(pixels: NDArray[Any], pixel_format: PixelFormat, *, demosaiced: bool) -> Picture:
    """A frame as the bytes of a PNG at its full depth, RGB; 10 and 12 bit fill 16 bit."""
    full = pixel_format.full_scale
    if pixel_format.bayer and demosaiced:
        light = np.clip(demosaic(pixels.astype(np.float32), pixel_format.bayer), 0, full)
        pixels = np.rint(light).astype(pixels.dtype)
    if pixels.dtype == np.uint16 and full < 65535:
        pixels = np.rint(pixels * (65535 / full)).astype(np.uint16)
    ordered = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(ordered))
    if not done:
        raise ValueError(f"OpenCV cannot write {pixels.shape} {pixels.dtype} as PNG")
    return np.asarray(encoded, dtype=np.uint8).reshape(-1)
