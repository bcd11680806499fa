"""What every device has: a name, options, an identity, and the life from connect to close."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import msgspec

from drivers.clock import Clock, RealClock


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A driver's own keys in rig.toml. Subclass it; the registry validates strictly."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device says it is; compared after every reconnect."""

    model: str
    serial: str = ""
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class Context:
    """What drivers of one rig share: the clock, and a place to meet (the virtual bench)."""

    clock: Clock = field(default_factory=RealClock)
    shared: dict[str, Any] = field(default_factory=dict)


class Device(ABC):
    """The life of a device: made (touches nothing) -> connect -> ... -> close. `connect` may be
    called again after a loss."""

    options_type: ClassVar[type[Options]] = Options
    kind: ClassVar[str]

    def __init__(self, name: str, options: Options, context: Context) -> None:
        self.name = name
        self.options = options
        self.clock = context.clock

    @abstractmethod
    def connect(self) -> Identity:
        """Open the device and find out what it is. Raises DeviceError; then nothing is held."""

    @abstractmethod
    def check(self) -> None:
        """Ask for a sign of life, cheaply; called now and then while idle. Raises DeviceError."""

    @abstractmethod
    def safe(self) -> None:
        """Go to the safe state (dark, off, held, stopped); idempotent. Raises DeviceError."""

    @abstractmethod
    def halt(self) -> None:
        """From any thread: end a blocked call, stop what moves. Never blocks, never raises."""

    @abstractmethod
    def close(self) -> None:
        """Let go of everything; idempotent; does not raise for a device that is gone."""

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """What of this driver is attached: `model`, `serial`, and `options` to paste into rig.toml.
        [] where a driver cannot tell. Raises DeviceError."""
        return []

    def facts(self) -> dict[str, Any]:
        """What people and scripts want to know of it, JSON-able; no I/O."""
        return {}
