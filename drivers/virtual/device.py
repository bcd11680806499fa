"""What all devices of the virtual rig have in common."""

from __future__ import annotations

import threading
from typing import ClassVar

from drivers.base.device import Context, Device, Identity, Options
from drivers.base.errors import DeviceLost
from drivers.virtual.bench import Bench
from drivers.virtual.faults import Fault, Faults


class VirtualOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys that every virtual device understands."""

    serial: str = ""  # what it calls itself; "": made of its name
    faults: tuple[str, ...] = ()  # see drivers.virtual.faults


class VirtualDevice(Device):
    """A device on the bench of its context."""

    options_type = VirtualOptions
    main_act: ClassVar[str]  # what faults strike at unless told otherwise

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, VirtualOptions)
        self._serial = options.serial or f"virtual-{name}"
        self.bench = Bench.of(context)
        self.faults = Faults(name, self.main_act, options.faults, context.clock)
        self._halted = threading.Event()
        self._connected = False

    def connect(self) -> Identity:
        """See Device."""
        self._halted.clear()
        self.faults.connect()
        self._connected = True
        suffix = f"-{self.faults.renamed}" if self.faults.renamed else ""
        return Identity(f"Umbra virtual {self.kind}", self._serial + suffix, "1")

    def check(self) -> None:
        """See Device."""
        self._begin("check")

    def halt(self) -> None:
        """See Device."""
        self._halted.set()

    def _begin(self, act: str, timeout_s: float = 1.0) -> frozenset[Fault]:
        """Every call starts here. Raises what the fault schedule has for it."""
        self._halted.clear()
        if not self._connected:
            raise DeviceLost(
                self.name,
                act,
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        try:
            return self.faults.strike(act, self._halted, timeout_s)
        except DeviceLost:
            self._connected = False
            raise
