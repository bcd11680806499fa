"""What was so at which moment: the memory of the bench."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

V = TypeVar("V")


class Forgotten(LookupError):
    """The moment lies before the oldest that is remembered."""


class Timeline(Generic[V]):
    """A value that changes at moments of the clock; remembers the last `length` changes."""

    def __init__(self, first: V, length: int = 256) -> None:
        self._changes: deque[tuple[int, V]] = deque([(-(1 << 62), first)], maxlen=length)

    def __len__(self) -> int:
        return len(self._changes)

    def change(self, at_ns: int, value: V) -> None:
        """From `at_ns` on it is `value`; what was planned for then or later does not happen."""
        while self._changes and self._changes[-1][0] >= at_ns:
            self._changes.pop()
        self._changes.append((at_ns, value))

    def spans(self, start_ns: int, end_ns: int) -> list[tuple[int, int, V]]:
        """The values in an interval with their parts of it, in order. Raises Forgotten."""
        if self._changes[0][0] > start_ns:
            raise Forgotten
        found: list[tuple[int, int, V]] = []
        until = end_ns
        for at, value in reversed(self._changes):
            if at < until:
                found.append((max(at, start_ns), until, value))
                until = at
            if at <= start_ns:
                break
        return found[::-1]
