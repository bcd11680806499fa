"""What can go wrong with a virtual device, when it is told to.

A fault is written ``kind@n`` or ``kind:act@n``: it strikes at the n-th call (counted from 1) of an
act, by default the device's main one (a camera's `grab`, a projector's `show`, a stage's `status`,
a light's `set`). A camera's `trigger` is any trigger, its `pulse` one that comes by wire.
``vanish@12*3`` stays away for three attempts to connect.
"""

from __future__ import annotations

import enum
import re
import threading
from collections import Counter
from collections.abc import Iterable

from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceTimeout
from drivers.clock import Clock

PATTERN = re.compile(r"(?P<kind>[a-z-]+)(:(?P<act>[a-z_]+))?@(?P<call>[1-9]\d*)(\*(?P<times>\d+))?")


class Fault(enum.StrEnum):
    """Kinds of failure."""

    TIMEOUT = "timeout"  # no answer: the call waits its time-out and fails
    GARBAGE = "garbage"  # an answer that makes no sense
    VANISH = "vanish"  # gone, until a later attempt to connect
    RENAME = "rename"  # gone, and back with another serial number
    STALL = "stall"  # the call blocks until it is halted
    DROP_TRIGGER = "drop-trigger"  # the camera does not hear a trigger
    DUPLICATE_FRAME = "duplicate-frame"  # the camera gives the frame before once more
    INCOMPLETE_FRAME = "incomplete-frame"  # the lower half of a frame is missing
    TORN_FRAME = "torn-frame"  # the upper half of a frame is that of the frame before
    FALSE_TRIGGER = "false-trigger"  # the camera hears a pulse that the projector did not send
    NO_SWITCH = "no-switch"  # the stage's homing finds no limit switch
    LATE_FLIP = "late-flip"  # the projector flips one refresh later than it says


MAIN_OF = {
    Fault.DROP_TRIGGER: "trigger",
    Fault.DUPLICATE_FRAME: "grab",
    Fault.INCOMPLETE_FRAME: "grab",
    Fault.TORN_FRAME: "grab",
    Fault.FALSE_TRIGGER: "trigger",
    Fault.LATE_FLIP: "show",
    Fault.NO_SWITCH: "home",
}


class Faults:
    """The faults in store for one device. Thread-safe: tests inject while the device works."""

    def __init__(self, device: str, main: str, schedule: Iterable[str], clock: Clock) -> None:
        """Raises ValueError for a fault that is not understood."""
        self._device = device
        self._main = main
        self._clock = clock
        self._lock = threading.Lock()
        self._calls: Counter[str] = Counter()
        self._due: dict[tuple[str, int], list[tuple[Fault, int]]] = {}
        self._away = 0  # failing attempts to connect that are left; -1: until `come_back`
        self._gone = False
        self.renamed = 0  # how often it came back as another
        for text in schedule:
            found = PATTERN.fullmatch(text)
            if found is None or found["kind"] not in set(Fault):
                raise ValueError(
                    f"{device}: fault {text!r} is not understood; write kind@call, "
                    f"as in vanish@12, with a kind of {', '.join(Fault)}"
                )
            kind = Fault(found["kind"])
            self._store(kind, found["act"], int(found["call"]), int(found["times"] or 1))

    def _store(self, kind: Fault, act: str | None, call: int, times: int) -> None:
        act = act or MAIN_OF.get(kind, self._main)
        self._due.setdefault((act, call), []).append((kind, times))

    def inject(
        self, kind: Fault, act: str | None = None, *, calls: int = 1, times: int = 1
    ) -> None:
        """Strike at the `calls`-th next call of an act; `times`: see the module (-1: for ever)."""
        with self._lock:
            name = act or MAIN_OF.get(kind, self._main)
            self._store(kind, act, self._calls[name] + calls, times)

    def come_back(self) -> None:
        """The next attempt to connect succeeds."""
        with self._lock:
            self._away = 0

    def connect(self) -> None:
        """An attempt to connect. Raises DeviceLost while the device is away."""
        with self._lock:
            if self._away:
                self._away -= self._away > 0
                raise DeviceLost(self._device, "connect", "no such device", "plug it in again")
            self._gone = False

    def strike(self, act: str, halted: threading.Event, timeout_s: float = 1.0) -> frozenset[Fault]:
        """Count one call of an act and suffer what is due; gives the faults that are the device's
        own to play. Raises DeviceLost, DeviceTimeout, DeviceGarbled."""
        with self._lock:
            self._calls[act] += 1
            due = self._due.pop((act, self._calls[act]), [])
            for kind, times in due:
                if kind in {Fault.VANISH, Fault.RENAME}:
                    self._gone, self._away = True, times
                    self.renamed += kind is Fault.RENAME
            gone = self._gone
        kinds = frozenset(kind for kind, _ in due)
        if gone:
            raise DeviceLost(self._device, act, "the device is gone", "connect again")
        if Fault.STALL in kinds:
            halted.wait()
            raise DeviceTimeout(self._device, act, "stalled until it was halted", "connect again")
        if Fault.TIMEOUT in kinds:
            self._clock.wait(timeout_s, halted)
            raise DeviceTimeout(
                self._device, act, f"no answer within {timeout_s:g} s", "check its cable and power"
            )
        if Fault.GARBAGE in kinds:
            raise DeviceGarbled(self._device, act, "answered 0xDEADBEEF", "connect again")
        return kinds
