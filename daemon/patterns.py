"""Patterns as images: pure functions of a pattern's data and the projector's size.

Coordinates are projector pixels, ``x`` to the right and ``y`` downwards; a shift moves the pattern
to the right and downwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import tau

import numpy as np
from numpy.typing import NDArray

from protocol.patterns import (
    AnyPattern,
    Axis,
    Checker,
    GrayCode,
    RandomBinary,
    RandomPhase,
    Sinusoid,
    Solid,
    Stripes,
    Unlit,
)

LEVELS = 255
"""The level of a fully lit pixel in a rendered pattern."""


def render(pattern: AnyPattern, width: int, height: int) -> NDArray[np.uint8]:
    """The image that shows a pattern: (height, width) uint8, 0 unlit, 255 lit.

    Raises ValueError for an empty size.
    """
    _check_size(width, height)
    match pattern:
        case Solid(level=level):
            return np.full((height, width), round(level * LEVELS), dtype=np.uint8)
        case Sinusoid():
            return _quantised(np.sin(sinusoid_phase(pattern, width, height)))
        case Unlit(base=base, points=points, size=size):
            image = render(base, width, height)
            for x, y in points:
                left, top = max(x - size // 2, 0), max(y - size // 2, 0)
                right, below = x - size // 2 + size, y - size // 2 + size
                image[top : max(below, 0), left : max(right, 0)] = 0
            return image
        case RandomPhase():
            return _quantised(np.sin(_random_phases(pattern, width, height) + pattern.phase))
        case _:
            lit = np.broadcast_to(_lit(pattern, width, height), (height, width))
            return np.where(lit, np.uint8(LEVELS), np.uint8(0))


def predistorted(image: NDArray[np.uint8], tone: Sequence[int]) -> NDArray[np.uint8]:
    """An image of wanted light as the levels that give it; `tone`: the level for each of 256."""
    return np.take(np.asarray(tone, dtype=np.uint8), image)


def lit_fraction(pattern: AnyPattern, width: int, height: int) -> float:
    """The source's mean level under a pattern on this projector: the paper's α, 0 to 1."""
    _check_size(width, height)
    match pattern:
        case Solid(level=level):
            return round(level * LEVELS) / LEVELS
        case Checker():
            columns, rows = _checker_parity(pattern, width, height)
            x, y = int(columns.sum()), int(rows.sum())
            odd = x * (height - y) + (width - x) * y
            total = width * height
            return (odd if pattern.inverted else total - odd) / total
        case _:
            return float(render(pattern, width, height).mean(dtype=np.float64)) / LEVELS


def sinusoid_phase(pattern: Sinusoid, width: int, height: int) -> NDArray[np.float64]:
    """The argument of a sinusoid's sine at each projector pixel, radians: (height, width)."""
    turn = tau / pattern.period
    x, y = np.arange(width) * turn, np.arange(height) * turn
    if pattern.axis is Axis.X:
        return np.asarray(x[None, :] + pattern.weave * np.sin(y)[:, None] + pattern.phase)
    return np.asarray(y[:, None] + pattern.weave * np.sin(x)[None, :] + pattern.phase)


def _random_phases(pattern: RandomPhase, width: int, height: int) -> NDArray[np.float64]:
    """φ of each pixel: ½ + ½ sin φ uniform over the patches.

    arcsin alone gives φ in ±π/2, where cos φ > 0: the next phase would light far more than half of
    the source and global light would change with it. So half of the patches have π - φ.
    """
    rows, columns = -(-height // pattern.patch), -(-width // pattern.patch)
    rng = np.random.default_rng(pattern.seed)
    patches = np.arcsin(2.0 * rng.random((rows, columns)) - 1.0)
    patches = np.where(rng.random((rows, columns)) < 0.5, patches, np.pi - patches)
    pixels = np.repeat(np.repeat(patches, pattern.patch, axis=0), pattern.patch, axis=1)
    return np.asarray(pixels[:height, :width])


def _lit(
    pattern: Checker | GrayCode | Stripes | RandomBinary, width: int, height: int
) -> NDArray[np.bool_]:
    """Which pixels a two-valued pattern lights: (height, width), or one row or column of it."""
    match pattern:
        case Checker():
            columns, rows = _checker_parity(pattern, width, height)
            return np.asarray((rows[:, None] ^ columns[None, :]) == pattern.inverted)
        case GrayCode():
            along = _along(pattern.axis, width, height)
            coded = (along ^ along >> 1) >> pattern.bit & 1 == 1
            return np.asarray(coded != pattern.inverted)
        case Stripes():
            along = _along(pattern.axis, width, height)
            return np.asarray((along - pattern.shift) // pattern.width % 2 == 0)
        case RandomBinary():
            return _random_patches(pattern, width, height)


def _along(axis: Axis, width: int, height: int) -> NDArray[np.int64]:
    """Coordinates along an axis, as a row or as a column."""
    return np.arange(width)[None, :] if axis is Axis.X else np.arange(height)[:, None]


def _random_patches(pattern: RandomBinary, width: int, height: int) -> NDArray[np.bool_]:
    """Each patch has an order of its own over the images; the first ones of it are lit."""
    if pattern.index >= pattern.count:
        raise ValueError(f"there is no image {pattern.index} of {pattern.count}")
    rows, columns = -(-height // pattern.patch), -(-width // pattern.patch)
    drawn = np.random.default_rng(pattern.seed).random((rows, columns, pattern.count))
    rank = np.count_nonzero(drawn < drawn[..., pattern.index, None], axis=2)
    lit = rank < round(pattern.lit_fraction * pattern.count)
    pixels = np.repeat(np.repeat(lit, pattern.patch, axis=0), pattern.patch, axis=1)
    return pixels[:height, :width]


def _quantised(sine: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.asarray(np.rint((0.5 + 0.5 * sine) * LEVELS), dtype=np.uint8)


def _checker_parity(
    pattern: Checker, width: int, height: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Parity of each column's and each row's checker."""
    columns = (np.arange(width) - pattern.shift_x) // pattern.size % 2 == 1
    rows = (np.arange(height) - pattern.shift_y) // pattern.size % 2 == 1
    return columns, rows


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1:
        raise ValueError(f"a projector of {width} x {height} pixels cannot show a pattern")
