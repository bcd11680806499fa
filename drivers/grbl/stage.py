"""The stage: connecting, motions, and what they may not do.

Coordinates are the controller's machine coordinates (what it reports as MPos) less `origin_mm`, in
mm. After Grbl's own homing these are negative: -$130 < x < 0.

Safe to send again, and so repeated here: status queries, hold, resume, reset. Not safe, and never
repeated: a motion line that was not acknowledged, because it may have been made. After a reset,
a reconnect, an alarm or a lost acknowledgement the position is unknown and nothing moves before
`home`; the one exception is `stop`, which proves that nothing was lost (see there).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.stage import Stage, StageInfo, StageStatus
from drivers.grbl import controller, faults, standstill
from drivers.grbl import protocol as grbl
from drivers.grbl.condition import Condition
from drivers.grbl.controller import Range
from drivers.grbl.homing import Homing
from drivers.grbl.link import REPLY_S, GrblLink
from drivers.grbl.motion import Stream, arcs, jog, line
from drivers.limits import Limits
from drivers.serialport import SerialPort, attached
from drivers.track import Arc, Point

ACCEPT_S = 2.0  # a first motion line is acknowledged within milliseconds


CHIPS = {
    (0x2341, None), (0x2A03, None),  # Arduino
    (0x1A86, None),  # WCH: CH340, CH9102
    (0x10C4, 0xEA60),  # CP210x
    (0x0403, 0x6001), (0x0403, 0x6010), (0x0403, 0x6015),  # FTDI
    (0x0483, 0x5740),  # STM32: grblHAL
}  # fmt: skip
"""USB serial chips that motion controllers carry; they may carry other firmware as well."""


class GrblOptions(Options, frozen=True, kw_only=True):
    """[stage] driver = "grbl"."""

    port: str  # /dev/serial/by-id/..., usb:VID:PID:SERIAL, socket://host:port, rfc2217://host:port
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] = 115_200
    identity: str = ""  # must be in what `$I` reports, e.g. the label that `$I=umbra-stage` stored
    homing: Literal["switches", "here"] = "switches"  # here: a person has put it at its origin
    origin_mm: Point = (0.0, 0.0)  # machine position of the stage's origin (homing = "switches")
    travel_mm: tuple[Range, Range] | None = None  # ((x min, max), (y min, max)); None: $130, $131
    max_feed_mm_s: Annotated[float, Meta(gt=0)] | None = None  # None: $110, $111
    boot_s: Annotated[float, Meta(gt=0, le=60)] = 4.0  # from opening the port to the banner
    poll_hz: Annotated[float, Meta(gt=0, le=50)] = 10.0  # status reports while moving


class GrblStage(Stage):
    """See the module. Motion calls may be queued: each begins where the one before it ends."""

    options_type: ClassVar[type[Options]] = GrblOptions
    options: GrblOptions

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, GrblOptions)
        self.options = options
        self._link = GrblLink(SerialPort(name, options.port, options.baud), context.clock)
        self._stream = Stream(self._link)
        self._condition = Condition(self._link, self._stream, context.clock, options.origin_mm)
        self._homing = Homing(self._condition, self._stop)
        self._controller = controller.NOBODY
        self._info: StageInfo | None = None

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device. Ports that may lead to a Grbl; none is opened, which would reset it."""
        return attached(CHIPS)

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """Open, wait for the banner, identify, read the settings. The position is unknown then.

        Safe to try again. Raises DeviceLost (no such port), DeviceTimeout (nothing answers),
        DeviceGarbled (not Grbl), DeviceRefused (taken, too old, or not the one named).
        """
        self.close()
        self._link.open(self.options.boot_s)
        try:
            identity = self._identify()
            self._info = self._limits()
            self._condition.fastest_mm_s = self._info.max_feed_mm_s
            self._link.alarm = None  # of the reset: known to be unknown is no alarm
            self._link.ask("connect")
        except DeviceError:
            self.close()
            raise
        return identity

    def _identify(self) -> Identity:
        link = self._link
        self._controller = it = controller.ask(link, "connect", identity=self.options.identity)
        link.rx_bytes = it.rx_bytes
        link.scale = grbl.MM_PER_INCH if it.inches else 1.0
        usb = link.port.identity
        return Identity(str(it.firmware), (usb.serial if usb else "") or it.label, it.version)

    def _limits(self) -> StageInfo:
        """Travel, feed and acceleration from the controller and the options; see `info`."""
        it, options = self._controller, self.options
        travel = options.travel_mm
        if travel is None and options.homing == "switches":
            x, y = it.travel
            (x0, y0) = options.origin_mm
            if x is not None and y is not None:
                travel = (x[0] - x0, x[1] - x0), (y[0] - y0, y[1] - y0)
        if travel is None:
            raise DeviceRefused(
                self.name, "connect", "its travel is not known", "set travel_mm in rig.toml"
            )
        if not all(low < high for low, high in travel):
            raise DeviceRefused(self.name, "connect", f"travel_mm {travel} is empty", "mend it")
        feeds = [feed for feed in (options.max_feed_mm_s, it.feed_mm_s) if feed]
        if not feeds:
            raise DeviceRefused(
                self.name, "connect", "its greatest feed is not known", "set max_feed_mm_s"
            )
        return StageInfo(travel, min(feeds), it.acceleration_mm_s2)

    def check(self) -> None:
        """One status query. An alarm is a state, for somebody to look at, and not a fault that a
        new connection might mend: that would forget it."""
        self._condition.begin("check")
        if self._link.alarm is None:
            self._condition.ask("check")

    def safe(self) -> None:
        """Stopped and held by its motors, nothing queued. See `stop`."""
        if self._link.port.is_open:
            self.stop()

    def halt(self) -> None:
        """Feed hold; while homing, which ignores it, a reset. See Device."""
        self._link.urge(self._homing.halt_byte())

    def close(self) -> None:
        """See Device. What moves is held first: nobody would hear of its end."""
        if self._link.port.is_open and self._condition.travelling:
            self._link.urge(grbl.HOLD)
        self._link.close()
        self._condition.lost()

    def facts(self) -> dict[str, Any]:
        """See Device."""
        info, link, it = self._info, self._link, self._controller
        return {
            "port": link.port.path or link.port.spec,
            "controller": str(it.firmware),
            "firmware": it.version,
            "label": it.label,
            "homed": self._condition.homed,
            "travel_mm": info.travel_mm if info else None,
            "max_feed_mm_s": info.max_feed_mm_s if info else None,
            "soft_limits": it.soft_limits,
            "hard_limits": it.hard_limits,
            "homing": it.homing,
            "rx_bytes": link.rx_bytes,
            "garbled_lines": link.strange,
            "last_garbled": list(link.strange_lines)[-3:],
        }

    # ------------------------------------------------------------ state

    def info(self) -> StageInfo:
        """See Stage."""
        if self._info is None:
            raise DeviceLost(self.name, "info", "it is not connected", "reconnect it")
        return self._info

    def status(self) -> StageStatus:
        """See Stage. Asks up to five times within 1.2 s before it concludes."""
        condition = self._condition
        condition.begin("status")
        if self._link.alarm is not None:
            return condition.status()
        condition.ask("status")
        for _ in range(3):  # Idle is believed at its second report only
            if self._link.in_flight or condition.at_rest:
                break
            condition.ask("status")
        return condition.status()

    def position_at(self, at_ns: int) -> Point | None:
        """See Stage and drivers/track.py. From any thread; no I/O.

        Error in steady circular motion: speed times the jitter of a report's arrival (1 ms on a
        direct USB line); in acceleration a Δt²/8 more, .12 mm at 100 mm/s² and 10 reports a second.
        """
        return self._condition.track.at(at_ns)

    # ------------------------------------------------------------ homing

    def home(self, timeout_s: float) -> None:
        """See Stage and homing.py: by its switches, or here, as the options say."""
        self._condition.begin("home")
        if self.options.homing == "here":
            self._homing.here()
        else:
            self._homing.by_switches(timeout_s)

    def unlock(self) -> None:
        """See Stage. Safe to send again."""
        self._condition.begin("unlock")
        self._homing.unlock()

    # ------------------------------------------------------------ motion

    def move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """See Stage. Not safe to send again after DeviceTimeout: ask for the status first."""
        self._condition.begin("move")
        target = self._checked("move", (x_mm, y_mm), feed_mm_s)
        self._ready("move")
        self._start("move", iter([line(target, feed_mm_s)]))

    def jog(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """See Stage. Grbl's own jog: `hold` and `stop` end it at once, and lose nothing.

        Not safe to send again after DeviceTimeout.
        """
        self._condition.begin("jog")
        target = self._checked("jog", (x_mm, y_mm), feed_mm_s)
        self._ready("jog")
        self._condition.depart()
        self._link.command(jog(target, feed_mm_s), REPLY_S, "jog")
        self._raise_trouble("jog")

    def circle(self, centre_mm: Point, radius_mm: float, feed_mm_s: float, turns: float) -> None:
        """See Stage. Counter-clockwise (x towards y), one G3 arc a turn; `turns` may be inf.

        Goes to the circle's first point, (x + r, y), in a straight line with the same feed.
        """
        self._condition.begin("circle")
        arc, limits = Arc(centre_mm, radius_mm), self._limits_known()
        limits.check_feed("circle", feed_mm_s)
        limits.check_circle("circle", arc, turns)
        self._ready("circle")
        self._start("circle", self._round(arc, feed_mm_s, turns))

    def _round(self, arc: Arc, feed: float, turns: float) -> Iterator[str]:
        self._condition.arcs.append(arc)
        yield line(self._condition.machine(arc.point(0.0)), feed)
        yield from arcs(arc.radius, feed, turns)

    def _limits_known(self) -> Limits:
        return Limits(self.name, self.info())

    def _checked(self, phase: str, point: Point, feed: float) -> Point:
        """The machine position of a point that may be gone to. Raises DeviceRefused."""
        limits = self._limits_known()
        limits.check_feed(phase, feed)
        limits.check_box(phase, (point[0], point[0]), (point[1], point[1]))
        return self._condition.machine(point)

    def _ready(self, phase: str) -> None:
        """Raises DeviceRefused unless it may move now."""
        self._raise_trouble(phase)
        if not self._condition.homed:
            raise DeviceRefused(
                self.name, phase, "its position is not known", "`umbra stage home` first"
            )
        report = self._condition.ask(phase)
        self._raise_trouble(phase)
        if report.state == "Hold":
            if self._condition.travelling or self._link.in_flight:
                raise DeviceRefused(self.name, phase, "it is held", "resume it or stop it first")
            self._link.realtime(grbl.RESUME)  # there is nothing that could go on
        elif report.state not in {"Idle", "Run", "Jog"}:
            raise DeviceRefused(
                self.name, phase, f"it is in its state {report.state}", "`umbra stage status`"
            )

    def _start(self, phase: str, lines: Iterator[str]) -> None:
        """Accept a motion; the first line of an idle stage is waited for, to hear a refusal."""
        was_idle = not self._condition.travelling and not self._link.in_flight
        self._condition.depart()
        self._stream.add(lines)
        self._stream.feed()
        if was_idle:
            # the buffers are empty, so the first ok comes at once, or an error does
            count = self._link.in_flight
            if not self._link.wait(
                lambda: self._link.in_flight < count or self._link.alarm is not None,
                ACCEPT_S,
                phase,
            ):
                raise DeviceTimeout(
                    self.name,
                    phase,
                    f"the motion was not acknowledged within {ACCEPT_S:g} s",
                    "it may have been made and is not sent again: `umbra stage status`",
                )
            self._raise_trouble(phase)
            self._stream.feed()

    def pump(self) -> StageStatus:
        """See Stage. Never blocks: the report is the last one that came.

        Raises DeviceRefused when a line was refused or an alarm ended the motion, DeviceGarbled
        when an acknowledgement was lost on the line (the position is unknown after that).
        """
        self._condition.begin("pump")
        self._raise_trouble("pump")
        self._condition.raise_stall("pump")
        self._stream.feed()
        self._link.poll(1 / self.options.poll_hz)
        return self._condition.status()

    def _raise_trouble(self, phase: str) -> None:
        self._condition.raise_alarm(phase)
        refused = self._link.refused
        if refused is not None:
            text, code = refused
            self._condition.abandon()
            self._condition.travelling = True  # others may be under way
            self._stop(phase)
            self._link.refused = None
            problem, remedy = faults.refusal(code, self._link.firmware)
            raise DeviceRefused(self.name, phase, f"{problem}: {text}", remedy)

    # ------------------------------------------------------------ standstill

    def hold(self) -> None:
        """See Stage. Safe to send again. Returns when it stands: deceleration plus 1 s at most."""
        self._condition.begin("hold")
        standstill.stand(self._condition, "hold", self._deceleration_s())

    def resume(self) -> None:
        """See Stage. Safe to send again."""
        self._condition.begin("resume")
        self._raise_trouble("resume")
        standstill.resume(self._condition, "resume")

    def stop(self) -> None:
        """See Stage and standstill.py. Idempotent."""
        self._condition.begin("stop")
        self._stop("stop")

    def _stop(self, phase: str) -> None:
        standstill.stop(self._condition, phase, self._deceleration_s())

    def _deceleration_s(self) -> float:
        info = self._info
        if info is None or not info.max_acceleration_mm_s2:
            return 2.0
        return info.max_feed_mm_s / info.max_acceleration_mm_s2
