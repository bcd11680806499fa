"""What a light is: a source that can only be switched."""

from __future__ import annotations

from abc import abstractmethod

from drivers.base.device import Device


class Light(Device):
    """A source that can only be switched."""

    kind = "light"

    @abstractmethod
    def set(self, on: bool) -> None:
        """Switch it; returns when it has switched. Safe to send again."""

    @abstractmethod
    def is_on(self) -> bool:
        """What it was last told; no I/O."""
