"""Numbers in a report's words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


def in_words(value: Any) -> str:
    """A fact, for a table."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(in_words(v) for v in value)
    return str(value)


def percent(share: float | None) -> str:
    """A part of a whole; None or NaN: unknown."""
    if share is None or not math.isfinite(share):
        return "unknown"
    if 0 < share < 0.0001:
        return "< 0.01%"
    return f"{100 * share:.3g}%" if share < 0.9995 or share == 1 else "> 99.9%"


def size(count: int) -> str:
    """Of a file, in bytes."""
    left = float(count)
    for unit in ("B", "kB", "MB"):
        if left < 1000:
            return f"{left:.3g} {unit}"
        left /= 1000
    return f"{left:.3g} GB"


def frames(number: int) -> str:
    """So many of them."""
    return "1 frame" if number == 1 else f"{number} frames"


def ranges(numbers: Sequence[int]) -> str:
    """3, 7–9, 12"""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    shown = [str(a) if a == b else f"{a}–{b}" for a, b in runs[:12]]
    return ", ".join(shown) + (" …" if len(runs) > 12 else "")
