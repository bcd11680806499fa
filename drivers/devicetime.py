"""A device's own clock on the rig's clock, from pairs of readings of both."""

from __future__ import annotations

from collections import deque


class DeviceTime:
    """Maps device time to rig time. Each pair says: when the device's clock read `device_ns`, the
    rig's read at most `rig_ns`. What delays the rig's reading (a bus, a thread that slept) only
    ever adds, so the smallest difference of the last `window` pairs is the best; older pairs are
    forgotten because clocks drift apart (50 ppm: 3 ms a minute)."""

    def __init__(self, window: int = 64) -> None:
        self._differences: deque[int] = deque(maxlen=window)

    def observe(self, device_ns: int, rig_ns: int) -> None:
        """Learn from one pair."""
        self._differences.append(rig_ns - device_ns)

    def forget(self) -> None:
        """The device's clock was reset."""
        self._differences.clear()

    @property
    def known(self) -> bool:
        """Whether a pair was seen since the last `forget`."""
        return bool(self._differences)

    def to_rig(self, device_ns: int) -> int:
        """A moment of the device's clock on the rig's. Raises ValueError before the first pair."""
        if not self._differences:
            raise ValueError("no pair of readings yet")
        return device_ns + min(self._differences)
