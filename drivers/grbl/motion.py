"""Motions as lines of G-code, and the stream that carries them.

Straight lines go to absolute machine positions (G53): work offsets do not matter. Arcs cannot (Grbl
refuses G53 with them) and are incremental: whole turns end where they began, so nothing adds up,
and they are independent of offsets too.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

from drivers.grbl.link import GrblLink
from drivers.track import Point

MODES = "G21G17G94G90"  # mm, XY plane, feed in mm/min, absolute: set after each reset

LEAST_TURN = 1e-4  # of a turn; less is rounding


def line(machine: Point, feed_mm_s: float) -> str:
    """To a machine position."""
    return f"G53G1{_target(machine)}F{feed_mm_s * 60:.1f}"


def jog(machine: Point, feed_mm_s: float) -> str:
    """To a machine position, by Grbl's own jog."""
    return f"$J=G53{_target(machine)}F{feed_mm_s * 60:.1f}"


def _target(machine: Point) -> str:
    return f"X{machine[0]:.4f}Y{machine[1]:.4f}"


def arcs(radius_mm: float, feed_mm_s: float, turns: float) -> Iterator[str]:
    """Counter-clockwise from a circle's point at angle 0: a line a turn, then the rest of one.

    `turns` may be infinite.
    """
    r, feed = radius_mm, f"F{feed_mm_s * 60:.1f}"
    whole = turns if math.isinf(turns) else math.floor(turns + LEAST_TURN)
    done = 0
    while done < whole:
        yield f"G91G3X0Y0I{-r:.4f}J0{feed}"
        done += 1
    if turns - done > LEAST_TURN:
        end = math.tau * (turns - done)
        dx, dy = r * (math.cos(end) - 1), r * math.sin(end)
        yield f"G91G3X{dx:.4f}Y{dy:.4f}I{-r:.4f}J0{feed}"


class Stream:
    """Motions that wait, each a series of lines, and are sent as the controller takes them."""

    def __init__(self, link: GrblLink) -> None:
        self._link = link
        self._motions: deque[Iterator[str]] = deque()
        self._line: str | None = None  # has no room yet

    @property
    def empty(self) -> bool:
        """Whether every line was sent."""
        return not self._motions and self._line is None

    def add(self, lines: Iterator[str]) -> None:
        """Queue a motion."""
        self._motions.append(lines)

    def clear(self) -> None:
        """Forget what was not sent."""
        self._motions.clear()
        self._line = None

    def feed(self) -> None:
        """Send as many lines as the controller's receive buffer has room for."""
        while (text := self._line or self._next()) is not None:
            self._line = text
            if not self._link.room(text):
                return
            self._line = None
            self._link.send(text)

    def _next(self) -> str | None:
        while self._motions:
            text = next(self._motions[0], None)
            if text is not None:
                return text
            self._motions.popleft()
        return None
