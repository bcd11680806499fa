"""Light between the peaks of stripes, and means over squares: a picture at a lower resolution."""

from __future__ import annotations

import cv2
import numpy as np

from daemon.separation.radiometry import Plane


def block_mean(plane: Plane, k: int) -> Plane:
    """Means over squares of k x k pixels: (H//k, W//k, ...) float32; what is over is left out."""
    height, width = plane.shape[0] // k, plane.shape[1] // k
    squares = plane[: height * k, : width * k].reshape(height, k, width, k, *plane.shape[2:])
    return np.asarray(squares.mean(axis=(1, 3), dtype=np.float32))


def envelope(picture: Plane, window: int, along: int) -> Plane:
    """Light between the peaks of each row, interpolated: float32, the shape of `picture`.

    A peak is the brightest of `window` x `along` pixels around it; before the first and after the
    last one of a row its light goes on; a row without one takes the window's brightest.
    """
    kernel = np.ones((along, window), dtype=np.uint8)
    highest = np.asarray(cv2.dilate(picture, kernel, borderType=cv2.BORDER_REPLICATE))
    highest = highest.reshape(picture.shape)
    peak = picture >= highest
    columns = picture.shape[1]
    shape = (1, columns) + (1,) * (picture.ndim - 2)
    at = np.broadcast_to(np.arange(columns, dtype=np.int32).reshape(shape), picture.shape)
    before = np.maximum.accumulate(np.where(peak, at, np.int32(-1)), axis=1)
    after = np.where(peak, at, np.int32(columns))[:, ::-1]
    after = np.minimum.accumulate(after, axis=1)[:, ::-1]
    none = (before < 0) & (after >= columns)
    before, after = np.where(before < 0, after, before), np.where(after >= columns, before, after)
    left = np.take_along_axis(picture, np.clip(before, 0, columns - 1), axis=1)
    right = np.take_along_axis(picture, np.clip(after, 0, columns - 1), axis=1)
    gap = np.maximum(after - before, 1).astype(np.float32)
    between: Plane = left + (right - left) * ((at - before).astype(np.float32) / gap)
    return np.where(none, highest, between)
