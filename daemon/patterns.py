"""Patterns as images: pure functions of a pattern's data and the projector's size.

Coordinates are projector pixels, ``x`` to the right and ``y`` downwards; a shift moves the pattern
to the right and downwards.
"""

from __future__ import annotations

from math import tau

import numpy as np
from numpy.typing import NDArray

from protocol.patterns import AnyPattern, Axis, Checker, RandomPhase, Sinusoid, Solid

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
        case Checker():
            columns, rows = _checker_parity(pattern, width, height)
            lit = (rows[:, None] ^ columns[None, :]) == pattern.inverted
            return np.where(lit, np.uint8(LEVELS), np.uint8(0))
        case Sinusoid():
            return _quantised(np.sin(sinusoid_phase(pattern, width, height)))
        case RandomPhase():
            return _quantised(np.sin(_random_phases(pattern, width, height) + pattern.phase))


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
    """φ of each pixel: ½ + ½ sin φ uniform over the patches."""
    rows, columns = -(-height // pattern.patch), -(-width // pattern.patch)
    level = np.random.default_rng(pattern.seed).random((rows, columns))
    patches = np.arcsin(2.0 * level - 1.0)
    pixels = np.repeat(np.repeat(patches, pattern.patch, axis=0), pattern.patch, axis=1)
    return np.asarray(pixels[:height, :width])


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
