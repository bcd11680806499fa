"""Frames moved to where the reference lies: what is known of them there, and how well."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.noise import Noise
from daemon.separation.radiometry import Plane

NOISES = 3.0
"""Interpolation that may change a sample by more deviations of its noise spoils it."""

_SECOND = np.array([[1.0, -2.0, 1.0]], np.float32)
_ROUNDING = np.float32(12.0**-0.5)  # deviation of a count's rounding: noise that is not known


def aligned(pixels: NDArray[Any], warp: tuple[float, ...], bayer: bool) -> NDArray[Any]:
    """A frame moved by a warp to where the reference lies, same shape and dtype: bilinear, so that
    no sample is brighter or darker than its neighbours. A mosaic's four kinds of pixels are moved
    each by itself. What lies outside the frame repeats its edge: see `beyond`."""
    if not bayer:
        return _warped(pixels, np.asarray(warp, np.float64).reshape(2, 3))
    out = np.empty_like(pixels)
    for part, inner in _quarters(warp):
        out[part] = aligned(np.ascontiguousarray(pixels[part]), inner, False)
    return out


def uncertain(
    pixels: NDArray[Any],
    warp: tuple[float, ...],
    bayer: bool,
    noise: Noise | None,
    scene: NDArray[Any] | None,
) -> NDArray[np.bool_]:
    """Pixels (H, W) of an `aligned` frame whose light may be off, for it is interpolated, by more
    than `NOISES` of its noise: where it bends from pixel to pixel, and the more so the further from
    the frame's own pixels. None of a frame that was moved by whole pixels. `scene`: a frame that
    lies in place and is sharp, for a moved one may be blurred."""
    if bayer:
        found = np.zeros(pixels.shape, np.bool_)
        for part, inner in _quarters(warp):
            own = np.ascontiguousarray(pixels[part])
            like = None if scene is None else np.ascontiguousarray(scene[part])
            found[part] = uncertain(own, inner, False, noise, like)
        return found
    matrix = np.asarray(warp, np.float64).reshape(2, 3)
    bends = _warped(_bends(pixels, noise), matrix)
    if scene is not None:
        np.maximum(bends, _bends(scene, noise), out=bends)
    between = np.zeros(pixels.shape[:2], np.float32)
    for at in _sources(pixels.shape, matrix):
        away = np.abs(at - np.rint(at))
        np.maximum(between, (away * (1.0 - away)).astype(np.float32), out=between)
    return np.asarray(2.0 * between * bends > NOISES)


def _bends(pixels: NDArray[Any], noise: Noise | None) -> Plane:
    """How far each pixel is off the line through its neighbours, in deviations of its noise."""
    light = pixels.astype(np.float32)
    bend = np.zeros(pixels.shape, np.float32)
    for kernel in (_SECOND, _SECOND.T):
        np.maximum(bend, np.abs(cv2.filter2D(light, -1, kernel)), out=bend)
    bend /= _ROUNDING if noise is None else noise.deviation(pixels)
    return bend if bend.ndim == 2 else np.asarray(bend.max(axis=2))


def beyond(shape: tuple[int, ...], warp: tuple[float, ...], bayer: bool) -> NDArray[np.bool_]:
    """Pixels (H, W) of which a frame that was moved by a warp knows nothing."""
    matrix = np.asarray(warp, np.float64).reshape(2, 3)
    from_x, from_y = _sources(shape, matrix)
    edge = 1.0 if bayer else 0.0  # a mosaic's outermost colour may be one pixel in
    outside = np.zeros(shape[:2], np.bool_)
    for at, last in ((from_x, shape[1] - 1), (from_y, shape[0] - 1)):
        outside |= (at < edge - 0.01) | (at > last - edge + 0.01)
    return outside


def without(
    pixels: NDArray[Any],
    left_out: NDArray[np.bool_] | None,
    known: tuple[NDArray[Any], NDArray[Any]] | None,
) -> NDArray[Any]:
    """A frame of which some pixels (H, W) count as neither lit nor unlit: they are halfway between
    the extremes that are `known`."""
    if left_out is None or known is None:
        return pixels
    found = pixels.copy()
    first, second = (plane[left_out].astype(np.uint32) for plane in known)
    found[left_out] = (first + second) // 2
    return found


def _sources(
    shape: tuple[int, ...], matrix: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where each pixel of a moved frame comes from, x and y; of one row and one column where it is
    only shifted."""
    inverse = np.linalg.inv(matrix[:, :2])
    y, x = np.ogrid[: shape[0], : shape[1]]
    moved_x, moved_y = x - matrix[0, 2], y - matrix[1, 2]
    if inverse[0, 1] == 0.0 and inverse[1, 0] == 0.0:
        return inverse[0, 0] * moved_x, inverse[1, 1] * moved_y
    from_x = inverse[0, 0] * moved_x + inverse[0, 1] * moved_y
    return from_x, inverse[1, 0] * moved_x + inverse[1, 1] * moved_y


def _quarters(warp: tuple[float, ...]) -> Iterator[tuple[tuple[slice, slice], tuple[float, ...]]]:
    """The four kinds of a mosaic's pixels, and how each is moved in its own, smaller picture."""
    matrix = np.asarray(warp, np.float64).reshape(2, 3)
    for row, column in np.ndindex(2, 2):
        first = np.array([column, row], np.float64)
        shift = (matrix[:, :2] @ first + matrix[:, 2] - first) / 2.0
        a, b, d, e = (float(v) for v in matrix[:, :2].ravel())
        yield np.s_[row::2, column::2], (a, b, float(shift[0]), d, e, float(shift[1]))


def _warped(pixels: NDArray[Any], matrix: NDArray[np.float64]) -> NDArray[Any]:
    size = (pixels.shape[1], pixels.shape[0])
    return np.asarray(
        cv2.warpAffine(
            pixels, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    )
