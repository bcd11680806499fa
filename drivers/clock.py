"""The one clock of a rig, injectable: real for a bench, faster than real for tests and soaks."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod

NS = 1_000_000_000


class Clock(ABC):
    """Time as the rig lives it: monotonic for durations, UTC for people. Thread-safe."""

    @abstractmethod
    def now_ns(self) -> int:
        """Monotonic nanoseconds; comparable within one process only."""

    @abstractmethod
    def utc_ns(self) -> int:
        """UTC nanoseconds since 1970, that advance with `now_ns`."""

    @abstractmethod
    def wait_until(self, deadline_ns: int, wake: threading.Event | None = None) -> bool:
        """Wait for a moment of `now_ns`; True if `wake` was set before it came."""

    def wait(self, seconds: float, wake: threading.Event | None = None) -> bool:
        """Wait for a duration of this clock; True if `wake` was set before its end."""
        return self.wait_until(self.now_ns() + round(seconds * NS), wake)


class RealClock(Clock):
    """The machine's own monotonic clock."""

    def __init__(self) -> None:
        self._utc_offset = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """See Clock."""
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        """See Clock. The offset is fixed at start, so a step of wall time moves no frame."""
        return time.monotonic_ns() + self._utc_offset

    def wait_until(self, deadline_ns: int, wake: threading.Event | None = None) -> bool:
        """See Clock."""
        event = wake or threading.Event()
        while (left := deadline_ns - time.monotonic_ns()) > 0:
            if event.wait(left / NS):
                return True
        return event.is_set()


class ScaledClock(Clock):
    """A clock `speed` times as fast as the machine's: an hour of a virtual rig in minutes."""

    def __init__(self, speed: float) -> None:
        if not speed > 0:
            raise ValueError(f"clock speed must be positive, not {speed}")
        self.speed = speed
        self._real_start = time.monotonic_ns()
        self._utc_start = time.time_ns()

    def now_ns(self) -> int:
        """See Clock."""
        return round((time.monotonic_ns() - self._real_start) * self.speed)

    def utc_ns(self) -> int:
        """See Clock."""
        return self._utc_start + self.now_ns()

    def wait_until(self, deadline_ns: int, wake: threading.Event | None = None) -> bool:
        """See Clock."""
        event = wake or threading.Event()
        while (left := deadline_ns - self.now_ns()) > 0:
            if event.wait(left / self.speed / NS):
                return True
        return event.is_set()
