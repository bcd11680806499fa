"""The line to a TMCL module: one exchange at a time, repeated when it failed.

Every command that Umbra sends is safe to send again, and is, up to `ATTEMPTS` times: reads change
nothing, positions are absolute targets, speeds and stops are states.

An answer that comes late would be taken for the next one's: it names the command, but not which
parameter was asked for. So after an exchange that failed, and after a frame that nobody waited for,
a *fence* is sent first, a request for the module's version. Answers come in order: what is before
the fence's answer is stale, and is passed over.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.clock import NS, Clock
from drivers.serialport import SerialPort
from drivers.tmcl_protocol import (
    DAMAGED,
    OK,
    STATUS,
    Axis,
    Command,
    encode,
    find_answer,
    other_module,
)

REPLY_S = 0.2  # a module answers within 5 ms
ATTEMPTS = 3
MOST_BYTES = 64  # kept of what came before the answer


class TmclLine:
    """One module's line. Calls from one thread; `urge` from any."""

    def __init__(self, port: SerialPort, clock: Clock, address: int, motor: int) -> None:
        self.port = port
        self.on_lost: Callable[[], None] = lambda: None
        self.damaged = 0  # exchanges that failed, since it was made
        self._clock = clock
        self._address = address
        self._motor = motor
        self._halted = threading.Event()
        self._stale = False  # an answer that nobody waits for may come

    def open(self) -> None:
        """Open the port. Raises DeviceLost, DeviceRefused."""
        self.port.close()
        self._halted.clear()
        self.port.open()
        self._stale = True  # of whoever had it before

    def begin(self, phase: str) -> None:
        """At the start of each of the owner's calls. Raises DeviceLost."""
        self._halted.clear()
        if not self.port.is_open:
            raise DeviceLost(self.port.device, phase, "it is not connected", "reconnect it")

    def wait(self, seconds: float) -> None:
        """For the clock's `seconds`, or until a halt."""
        self._clock.wait(seconds, self._halted)

    def urge(self, command: Command, kind: int = 0) -> None:
        """From any thread: a frame whose answer is passed over by whoever asks next."""
        self._stale = True
        self.port.urge(encode(self._address, command, kind, self._motor, 0))

    def halt(self) -> None:
        """From any thread: end the exchange under way."""
        self._halted.set()

    def get(self, axis: Axis, phase: str) -> int:
        """An axis parameter."""
        return self.ask(Command.GET_AXIS, axis, phase=phase)

    def set(self, axis: Axis, value: int, phase: str) -> None:
        """Set an axis parameter."""
        self.ask(Command.SET_AXIS, axis, value, phase=phase)

    def ask(self, command: Command, kind: int = 0, value: int = 0, *, phase: str) -> int:
        """One exchange. Raises DeviceRefused (the status by its name), DeviceTimeout (silence),
        DeviceGarbled (damaged answers, or another module's), DeviceLost."""
        frame = encode(self._address, command, kind, self._motor, value)
        heard = b""
        for _ in range(ATTEMPTS):
            if self._halted.is_set():
                raise DeviceError(self.port.device, phase, "interrupted by a halt")
            if self._stale:
                self._stale = False
                fence = encode(self._address, Command.GET_VERSION, 1, self._motor, 0)
                passed, received = self._exchange(fence, Command.GET_VERSION)
                heard += received
                if passed is None:
                    self._fail()
                    continue
            answer, received = self._exchange(frame, command)
            heard += received
            if answer is None or answer[0] == DAMAGED:
                self._fail()
                continue
            status, result = answer
            if status not in OK:
                problem, remedy = STATUS.get(status, (f"it answered status {status}", ""))
                raise DeviceRefused(
                    self.port.device, phase, f"{problem} ({command.name} {kind})", remedy
                )
            return result
        if self._halted.is_set():
            raise DeviceError(self.port.device, phase, "interrupted by a halt")
        raise self._no_answer(command, heard, phase)

    def _fail(self) -> None:
        self.damaged += 1
        self._stale = True

    def _exchange(self, frame: bytes, command: Command) -> tuple[tuple[int, int] | None, bytes]:
        """Send, and what came within `REPLY_S`, until it holds the answer."""
        data = b""
        try:
            self.port.write(frame)
            deadline = self._clock.now_ns() + round(REPLY_S * NS)
            while self._clock.now_ns() < deadline and not self._halted.is_set():
                data = data[-MOST_BYTES:] + self.port.read()
                answer = find_answer(data, self._address, command)
                if answer is not None:
                    return answer, data
        except DeviceLost:
            self.on_lost()
            raise
        return None, data

    def _no_answer(self, command: Command, heard: bytes, phase: str) -> DeviceError:
        device = self.port.device
        where = f"{self.port.spec}, address {self._address}, {self.port.baud} baud"
        if not heard:
            return DeviceTimeout(
                device,
                phase,
                f"no answer from {where} to {command.name}",
                "check supply, cable, address and baud rate",
            )
        other = other_module(heard, self._address)
        if other is not None:
            return DeviceGarbled(
                device,
                phase,
                f"the module that answers at {self.port.spec} has address {other}, not "
                f"{self._address}",
                f"set address = {other}, or find the module that is meant",
            )
        return DeviceGarbled(
            device, phase, f"only damaged answers from {where}", "check cable and baud rate"
        )
