"""The conversation with a Grbl controller: lines and their acknowledgements, reports, resets.

Lines are streamed by *character counting*: the bytes of all lines that are not acknowledged yet
never exceed the controller's receive buffer, and its oks come in order. Real-time bytes (? ! ~
reset) go past that buffer at any time.

Nothing hangs, and each failure has its policy:

- a status query is safe to send again: it is, `REPEAT_S` after one that was not answered (Grbl
  drops one now and then), and only silence for `QUERY_S` is a DeviceTimeout;
- a reset is safe to send again, and is, until the banner comes;
- ``$I``, ``$$``, ``$X`` and modal lines change nothing twice, but an answer that comes late would
  be taken for the next line's: after a time-out only a reset makes the count right again;
- a motion that was not acknowledged may have been made: it is never sent again.

An answer damaged by noise is counted and dropped; if it was an acknowledgement, the controller ends
up idle with lines unacknowledged, which `lost_acknowledgement` tells.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.clock import NS, Clock
from drivers.grbl import faults
from drivers.grbl import protocol as grbl
from drivers.serialport import LineReader, SerialPort

REPEAT_S = 0.25  # a report takes 8 to 20 ms: this one was dropped
QUERY_S = 1.2  # Grbl is silent for .5 s after an alarm
STILL_SILENT_S = 0.6  # asked again after a silence: a safe state is not to wait for long
REPLY_S = 2.0  # $$ takes .2 s at 115200 baud
BANNER_S = 1.5  # from a soft reset, the .5 s after an alarm included
LOST_ACK_S = 1.0  # idle for this long with lines unacknowledged
WATCH_S = 0.5  # between questions whether a long command has begun
IDLE_LOOKS = 3  # it has not: Idle so often
STRANGE_KEPT = 20


@dataclass(slots=True)
class _Sent:
    """A line on its way, and the lines that came before its ok."""

    text: str
    bytes: int
    replies: list[str] = field(default_factory=list)
    streamed: bool = True
    answer: str = ""  # "ok" or "error:N"


class GrblLink:
    """One open controller. Calls from one thread; `urge` and `interrupt` from any."""

    def __init__(self, port: SerialPort, clock: Clock) -> None:
        self.port = port
        self.alarm: int | None = None  # the last ALARM's code, until `clear_alarm`
        self.was_reset = False  # a banner came that nobody had asked for
        self.refused: tuple[str, int] | None = None  # a streamed line, and its error
        self.banner: grbl.Banner | None = None
        self.firmware = faults.Firmware.GRBL
        self.report: grbl.Report | None = None  # the last
        self.rx_bytes = 127
        self.scale = 1.0  # mm a reported unit
        self.strange = 0  # lines that made no sense
        self.strange_lines: deque[str] = deque(maxlen=STRANGE_KEPT)
        self.on_report: Callable[[grbl.Report], None] = lambda _report: None
        self.on_lost: Callable[[], None] = lambda: None
        self.believes: Callable[[grbl.Report], bool] = lambda _report: True
        self._clock = clock
        self._arrived = threading.Event()
        self._interrupted = threading.Event()
        self._reader: LineReader | None = None
        self._flight: deque[_Sent] = deque()
        self._awaiting_banner = False
        self._first_ask_ns: int | None = None  # of the query not answered yet
        self._last_ask_ns = 0
        self._traffic_ns = 0  # the last line sent or acknowledged
        self._idle_since_ns: int | None = None
        self._quiet_reports = 0
        self._silent = False  # a query was not answered, and nothing came since
        self._owed = False  # an answer that nobody waits for any more

    # ------------------------------------------------------------ opening

    def open(self, boot_s: float) -> None:
        """Open the port and bring the controller to its banner; DeviceError, then all is closed.

        Opening resets an Arduino through DTR: its banner comes by itself within `boot_s`. Others
        answer a status query at once and are soft-reset, so that nothing of an earlier session
        is left in any buffer.
        """
        self.close()
        self._interrupted.clear()
        self.port.open()
        self._reader = LineReader(self.port, self._clock, self._arrived)
        self._awaiting_banner = True
        self.banner = self.report = None
        self.firmware = faults.Firmware.GRBL
        try:
            deadline = self._after(boot_s)
            while self.banner is None and self.report is None and self._now() < deadline:
                self.realtime(grbl.STATUS)
                self.wait(lambda: bool(self.banner or self.report), REPEAT_S, "open")
            if self.banner is None:
                self.reset("open")
        except DeviceError:
            self.close()
            raise

    def close(self) -> None:
        """Idempotent."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
        self.port.close()
        self._forget()
        self.alarm = None
        self.was_reset = False

    def _forget(self) -> None:
        self._flight.clear()
        self.refused = None
        self._first_ask_ns = None
        self._idle_since_ns, self._quiet_reports = None, 0
        self._silent = self._owed = False

    def reset(self, phase: str) -> None:
        """Soft reset: everything in flight is gone. Returns after the banner. DeviceTimeout."""
        for _ in range(3):
            self.banner = None
            self._awaiting_banner = True
            self.alarm = None
            self.realtime(grbl.RESET)
            if self.wait(lambda: self.banner is not None, BANNER_S, phase):
                self.refused = None
                return
        where = f"{self.port.spec} at {self.port.baud} baud"
        if self.strange:
            raise DeviceGarbled(
                self.port.device,
                phase,
                f"{where} sends what is not Grbl: {self.strange_lines[-1][:40]!r}",
                "check the baud rate, and that it is Grbl 1.1, grblHAL or FluidNC",
            )
        raise DeviceTimeout(
            self.port.device,
            phase,
            f"no answer from {where}",
            "check its power, the cable and the baud rate, and that it is Grbl 1.1",
        )

    def await_banner(self, phase: str) -> None:
        """After a reset that nobody waited for: it hears nothing before its banner."""
        if self._awaiting_banner:
            self.wait(lambda: not self._awaiting_banner, BANNER_S, phase)

    def settle_alarm(self, phase: str) -> None:
        """Most alarms end in a banner, which empties all buffers: wait for it where it comes."""
        self.banner = None
        self.wait(lambda: self.banner is not None, BANNER_S, phase)
        self._flight.clear()

    # ------------------------------------------------------------ sending

    @property
    def in_flight(self) -> int:
        """Lines sent and not acknowledged."""
        return len(self._flight)

    def room(self, text: str) -> bool:
        """Whether the controller's receive buffer can take the line now."""
        return sum(s.bytes for s in self._flight) + len(text) + 1 <= self.rx_bytes

    def send(self, text: str) -> None:
        """Stream a line; the caller has asked for `room`. Not sent again whatever happens."""
        self._send(_Sent(text, len(text) + 1))

    def _send(self, sent: _Sent) -> None:
        self._flight.append(sent)
        self._traffic_ns, self._idle_since_ns = self._now(), None
        self._quiet_reports = 0
        self._write(sent.text.encode("ascii") + b"\n")

    def command(
        self, text: str, timeout_s: float, phase: str, *, watched: bool = False
    ) -> list[str]:
        """Send a line and wait for its ok; gives what came before it.

        Raises DeviceRefused (the error by its name), DeviceTimeout, DeviceLost; when `watched`,
        DeviceGarbled for a line that set nothing going. Also returns when an alarm or a reset
        came in the ok's place: the caller looks at `alarm` and `was_reset`.
        """
        sent = _Sent(text, len(text) + 1, streamed=False)
        self._send(sent)
        alarms = self.alarm

        def ended() -> bool:
            return bool(sent.answer) or sent not in self._flight or self.alarm != alarms

        deadline = self._after(timeout_s)
        while not self.wait(ended, min(WATCH_S, timeout_s) if watched else timeout_s, phase):
            if self._now() >= deadline:
                raise DeviceTimeout(
                    self.port.device,
                    phase,
                    f"no answer to {text} within {timeout_s:g} s",
                    "check the cable; the stage has to be connected and homed again",
                )
            if self._quiet_reports >= IDLE_LOOKS:
                raise DeviceGarbled(
                    self.port.device,
                    phase,
                    f"it stands idle: {text} or its answer was lost on the line",
                    "check cable and interference, then again",
                )
            self.realtime(grbl.STATUS)
        if sent.answer.startswith("error:"):
            problem, remedy = faults.refusal(int(sent.answer[6:]), self.firmware)
            raise DeviceRefused(self.port.device, phase, problem, remedy)
        return sent.replies

    def realtime(self, byte: bytes) -> None:
        """Send a real-time byte."""
        if byte == grbl.STATUS:
            self._last_ask_ns = self._now()
            if self._first_ask_ns is None:
                self._first_ask_ns = self._last_ask_ns
        self._write(byte)

    def _write(self, data: bytes) -> None:
        try:
            self.port.write(data)
        except DeviceLost:
            self.on_lost()
            raise

    def urge(self, byte: bytes) -> None:
        """From any thread: a real-time byte, and an end to the wait under way. Never raises."""
        if byte == grbl.RESET:
            self._awaiting_banner = True
        self.port.urge(byte)
        self.interrupt()

    def interrupt(self) -> None:
        """From any thread: end the wait under way; the next `begin` makes waiting possible again"""
        self._interrupted.set()
        self._arrived.set()

    @property
    def interrupted(self) -> bool:
        """Whether someone interrupted since the last `begin`."""
        return self._interrupted.is_set()

    def begin(self, phase: str) -> None:
        """At the start of each of the owner's calls: take what has come. Raises DeviceLost."""
        self._owed = self._interrupted.is_set() and self._first_ask_ns is not None
        self._interrupted.clear()
        if not self.port.is_open or self._reader is None:
            raise DeviceLost(self.port.device, phase, "it is not connected", "reconnect it")
        self.take()

    # ------------------------------------------------------------ asking

    def ask(self, phase: str) -> grbl.Report:
        """A fresh report. Asks again when one was dropped; DeviceTimeout, DeviceLost."""
        if self._owed:  # what an interrupted call asked for is older than what interrupted it
            self._owed, before = False, self._now()
            self.wait(lambda: self._fresh(before), REPEAT_S, phase)
        began = self._now()
        allowed_s = STILL_SILENT_S if self._silent else QUERY_S
        deadline = began + round(allowed_s * NS)
        self._first_ask_ns = None
        while self._now() < deadline:
            self.realtime(grbl.STATUS)
            self.wait(lambda: self._fresh(began), REPEAT_S, phase)
            report = self.report
            if report is not None and self._fresh(began):
                return report
            if faults.is_critical(self.alarm, self.firmware) or self.was_reset:
                break  # it answers nothing until it is reset; the caller looks
        raise self._silence(phase, allowed_s)

    def _silence(self, phase: str, seconds: float) -> DeviceTimeout:
        self._silent = True
        return DeviceTimeout(
            self.port.device,
            phase,
            f"no status report within {seconds} s",
            "check the cable and the controller's power",
        )

    def _fresh(self, since_ns: int) -> bool:
        return self.report is not None and self.report.at_ns >= since_ns

    def poll(self, period_s: float) -> None:
        """Ask for a report now and then without waiting; DeviceTimeout after `QUERY_S` of silence.

        The answer arrives through `on_report` in a later `take`.
        """
        now = self._now()
        if self._first_ask_ns is None:
            if now - self._last_ask_ns >= period_s * NS:
                self.realtime(grbl.STATUS)
        elif now - self._first_ask_ns > QUERY_S * NS:
            self._first_ask_ns = None
            raise self._silence("poll", QUERY_S)
        elif now - self._last_ask_ns > REPEAT_S * NS:
            self.realtime(grbl.STATUS)

    @property
    def quiet(self) -> bool:
        """Whether the last two reports say Idle and were asked for after the last line's ok.

        One is not enough: between a line's ok and the start of its motion Grbl still says Idle.
        """
        return not self._flight and self._quiet_reports >= 2

    @property
    def lost_acknowledgement(self) -> bool:
        """Whether the controller has been idle for `LOST_ACK_S` with lines unacknowledged."""
        since = self._idle_since_ns
        return bool(self._flight) and since is not None and self._now() - since > LOST_ACK_S * NS

    # ------------------------------------------------------------ receiving

    def wait(self, done: Callable[[], bool], timeout_s: float, phase: str) -> bool:
        """Take lines until `done`; False at the time-out. DeviceLost; DeviceError if interrupted"""
        deadline = self._after(timeout_s)
        while True:
            self._arrived.clear()
            self.take()
            if done():
                return True
            if self._interrupted.is_set():
                raise DeviceError(self.port.device, phase, "interrupted by a halt")
            if self._now() >= deadline:
                return False
            self._clock.wait_until(deadline, self._arrived)

    def take(self) -> None:
        """Digest every line that has come. Raises DeviceLost when the line is dead."""
        reader = self._reader
        if reader is None:
            return
        while (item := reader.take()) is not None:
            self._digest(*item)
        if reader.error is not None:
            self.on_lost()
            raise DeviceLost(
                self.port.device, "read", reader.error.problem, "check cable and power; then home"
            ) from reader.error

    def _digest(self, at_ns: int, line: str) -> None:
        self._silent = False
        line = grbl.plain(line)
        if not line:
            return
        if line == "ok" or line.startswith("error:"):
            self._acknowledge(line)
        elif line.startswith("<"):
            self._reported(at_ns, line)
        elif line.startswith("ALARM:") and line[6:].isascii() and line[6:].isdigit():
            self.alarm = int(line[6:])
        elif (banner := grbl.parse_banner(line)) is not None:
            self._welcomed(banner)
        elif line.startswith(("[", "$", ">")):
            if self._flight and not self._flight[0].streamed:
                self._flight[0].replies.append(line)
        else:
            self._wonder(line)

    def _acknowledge(self, line: str) -> None:
        if line != "ok" and not (line[6:].isascii() and line[6:].isdigit()):
            self._wonder(line)
            return
        if not self._flight:
            self._wonder(line)
            return
        sent = self._flight.popleft()
        sent.answer = line
        self._traffic_ns = self._now()
        self._idle_since_ns = None
        self._quiet_reports = 0
        if line != "ok" and sent.streamed and self.refused is None:
            self.refused = (sent.text, int(line[6:]))

    def _reported(self, at_ns: int, line: str) -> None:
        asked = self._first_ask_ns
        report = grbl.parse_report(
            line,
            scale=self.scale,
            offset=self.report.offset if self.report else None,
            at_ns=at_ns,
            asked_ns=asked if asked is not None else at_ns,
        )
        if report is None or not self.believes(report):
            self._wonder(line)
            return
        self.report = report
        self._first_ask_ns = None
        if report.state != "Idle":
            self._idle_since_ns, self._quiet_reports = None, 0
        else:
            if self._idle_since_ns is None:
                self._idle_since_ns = at_ns
            self._quiet_reports += report.asked_ns > self._traffic_ns
        self.on_report(report)

    def _welcomed(self, banner: grbl.Banner) -> None:
        if not self._awaiting_banner and self.alarm is None:
            self.was_reset = True
        self._awaiting_banner = False
        self.banner = banner
        if banner.name is not faults.Firmware.GRBL:  # a compatible one may call itself Grbl
            self.firmware = banner.name
        self._flight.clear()  # its buffers are empty now, whatever was in them
        self._first_ask_ns = None
        self._idle_since_ns, self._quiet_reports = None, 0
        self._traffic_ns = self._now()

    def _wonder(self, line: str) -> None:
        self.strange += 1
        self.strange_lines.append(line)

    def _now(self) -> int:
        return self._clock.now_ns()

    def _after(self, seconds: float) -> int:
        return self._now() + round(seconds * NS)
