"""Patterns as images: pure functions of a pattern's data and the projector's size.

Coordinates are projector pixels, ``x`` to the right and ``y`` downwards; a shift moves the pattern
to the right and downwards.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from protocol.patterns import AnyPattern, Checker, Solid

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
