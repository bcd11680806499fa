"""An XY stage under Grbl 1.1, grblHAL or FluidNC, over a serial port or a network.

Coordinates are the controller's machine coordinates (what it reports as MPos) less `origin_mm`, in
mm. After Grbl's own homing these are negative: -$130 < x < 0.

Safe to send again, and so repeated here: status queries, hold, resume, reset. Not safe, and never
repeated: a motion line that was not acknowledged, because it may have been made. After a reset,
a reconnect, an alarm or a lost acknowledgement the position is unknown and nothing moves before
`home`; the one exception is `stop`, which proves that nothing was lost (see there).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from drivers import grbl_protocol as grbl
from drivers.base import (
    Context,
    DeviceError,
    DeviceGarbled,
    DeviceLost,
    DeviceRefused,
    DeviceTimeout,
    Identity,
    Options,
    Stage,
    StageInfo,
    StageState,
    StageStatus,
)
from drivers.clock import NS
from drivers.grbl_link import REPLY_S, GrblLink
from drivers.grbl_motion import (
    MODES,
    Limits,
    Range,
    Stream,
    arcs,
    jog,
    line,
    machine_travel,
)
from drivers.serialport import SerialPort, attached
from drivers.track import Arc, Point, Track

ACCEPT_S = 2.0  # a first motion line is acknowledged within milliseconds
KEPT_MM = 0.002  # a position is reported to .001 mm: this near is the same
SETTLE_S = 1.0  # a hold, beyond the time of its deceleration


def _stands(report: grbl.Report) -> bool:
    """Whether it says by itself that nothing moves (Idle aside: a motion may be about to begin)."""
    if report.state == "Hold":
        return report.substate == 0
    if report.state == "Door":
        return report.substate in {0, 1}
    return report.state in {"Alarm", "Sleep", "Check"}


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
        self._link.on_report = self._on_report
        self._link.on_lost = self._position_lost
        self._track = Track()
        self._arcs: deque[Arc] = deque(maxlen=4)  # those of lines that may be under way
        self._stream = Stream(self._link)
        self._travelling = False  # from the first line of a motion until it is known to rest
        self._homed = False
        self._homing = False
        self._halted_by_reset = False
        self._offset: Point = options.origin_mm  # machine position of the stage's origin
        self._info: StageInfo | None = None
        self._identity: Identity | None = None
        self._settings: dict[int, float] = {}
        self._build = grbl.Build()

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device. Ports that may lead to a Grbl; none is opened, which would reset it."""
        return attached(CHIPS)

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """Open, wait for the banner, identify, read the settings. The position is unknown then.

        Safe to try again. Raises DeviceLost (no such port), DeviceTimeout (nothing answers),
        DeviceGarbled (not Grbl), DeviceRefused (taken, too old, or another controller).
        """
        self.close()
        self._link.open(self.options.boot_s)
        try:
            identity = self._identify()
            self._info = self._limits()
            self._link.alarm = None  # of the reset: known to be unknown is no alarm
            self._link.ask("connect")
        except DeviceError:
            self.close()
            raise
        self._identity = identity
        return identity

    def _identify(self) -> Identity:
        link, banner = self._link, self._link.banner
        assert banner is not None
        if banner.version < (1, 1):
            raise DeviceRefused(
                self.name, "connect", f"its firmware is {banner.text[:40]!r}", "install Grbl 1.1"
            )
        said = link.command("$I", REPLY_S, "connect")
        self._build = grbl.parse_build(said)
        self._settings = grbl.parse_settings(link.command("$$", REPLY_S, "connect"))
        link.rx_bytes = min(self._build.rx_bytes, 256) - 1
        link.scale = grbl.MM_PER_INCH if self._settings.get(13) else 1.0
        wanted = self.options.identity
        # Grbl keeps its label in capitals, whatever was sent
        if wanted and not any(wanted.lower() in text.lower() for text in said):
            raise DeviceRefused(
                self.name,
                "connect",
                f"the controller at {link.port.path} is {self._build.label or 'unnamed'!r}, not "
                f"{wanted!r}",
                f"correct `port`, or name the controller once with $I={wanted}",
            )
        usb = link.port.identity
        identity = Identity(
            banner.name,
            (usb.serial if usb else "") or self._build.label,
            self._build.version or banner.text,
        )
        before = self._identity
        if before is not None and before.serial and identity.serial != before.serial:
            raise DeviceRefused(
                self.name,
                "connect",
                f"another controller ({identity.serial or 'unnamed'}) has come back in the place "
                f"of {before.serial}",
                "restore the cabling, or restart the daemon if it was exchanged on purpose",
            )
        return identity

    def _limits(self) -> StageInfo:
        """Travel, feed and acceleration from $110..$131 and the options; see `info`."""
        settings, options = self._settings, self.options
        travel = options.travel_mm
        if travel is None and options.homing == "switches":
            x, y = (machine_travel(settings, self._build, axis) for axis in (0, 1))
            (x0, y0) = options.origin_mm
            if x is not None and y is not None:
                travel = (x[0] - x0, x[1] - x0), (y[0] - y0, y[1] - y0)
        if travel is None:
            raise DeviceRefused(
                self.name, "connect", "its travel is not known", "set travel_mm in rig.toml"
            )
        if not all(low < high for low, high in travel):
            raise DeviceRefused(self.name, "connect", f"travel_mm {travel} is empty", "mend it")
        rates = [settings[n] / 60 for n in (110, 111) if settings.get(n, 0) > 0]
        feed = options.max_feed_mm_s or min(rates, default=0.0)
        if not feed:
            raise DeviceRefused(
                self.name, "connect", "its greatest feed is not known", "set max_feed_mm_s"
            )
        acceleration = min((settings[n] for n in (120, 121) if n in settings), default=0.0)
        return StageInfo(travel, min([feed, *rates]), acceleration)

    def check(self) -> None:
        """One status query. Raises DeviceRefused for an alarm that nobody has acknowledged."""
        self._begin("check")
        self._raise_alarm("check")
        self._ask("check")

    def safe(self) -> None:
        """Stopped and held by its motors, nothing queued. See `stop`."""
        if self._link.port.is_open:
            self.stop()

    def halt(self) -> None:
        """Feed hold; while homing, which ignores it, a reset. See Device."""
        self._halted_by_reset = self._homing
        self._link.urge(grbl.RESET if self._homing else grbl.HOLD)

    def close(self) -> None:
        """See Device. What moves is held first: nobody would hear of its end."""
        if self._link.port.is_open and self._travelling:
            self._link.urge(grbl.HOLD)
        self._link.close()
        self._position_lost()

    def facts(self) -> dict[str, Any]:
        """See Device."""
        info, link = self._info, self._link
        return {
            "port": link.port.path or link.port.spec,
            "firmware": self._build.version,
            "label": self._build.label,
            "homed": self._homed,
            "travel_mm": info.travel_mm if info else None,
            "max_feed_mm_s": info.max_feed_mm_s if info else None,
            "soft_limits": bool(self._settings.get(20)),
            "hard_limits": bool(self._settings.get(21)),
            "homing": bool(self._settings.get(22)),
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
        self._begin("status")
        if self._link.alarm is not None:
            return self._status()
        self._ask("status")
        for _ in range(3):  # Idle is believed at its second report only
            if self._link.in_flight or self._at_rest():
                break
            self._ask("status")
        return self._status()

    def _begin(self, phase: str) -> None:
        """What every call begins with."""
        self._link.begin(phase)
        self._notice(phase)

    def _notice(self, phase: str) -> None:
        """Draw the consequences of what came unasked."""
        if self._link.alarm is not None:
            self._position_lost()
        if self._link.was_reset:
            self._position_lost()
            raise DeviceLost(
                self.name,
                phase,
                "the controller was reset (a power dip, its button, or another program)",
                "it has to be connected and homed again",
            )
        if self._link.lost_acknowledgement:
            self._position_lost()
            self._link.reset(phase)
            raise DeviceGarbled(
                self.name,
                phase,
                "an acknowledgement was lost on the line: which motions were made is not known",
                "check cable and interference, then `umbra stage home`",
            )

    def _position_lost(self) -> None:
        self._homed = False
        self._track.forget()
        self._arcs.clear()
        self._abandon()

    def _abandon(self) -> None:
        """Forget motions that are not sent yet."""
        self._stream.clear()
        self._travelling = False

    def _ask(self, phase: str) -> grbl.Report:
        try:
            report = self._link.ask(phase)
        except DeviceTimeout:
            self._notice(phase)
            if self._link.alarm is None:
                raise
            assert self._link.report is not None
            return self._link.report
        self._notice(phase)
        return report

    def _on_report(self, report: grbl.Report) -> None:
        if report.position is None or not self._homed:
            return
        if report.state in {"Alarm", "Sleep"}:
            self._link.alarm = self._link.alarm or 0
            self._position_lost()
            return
        point = (report.position[0] - self._offset[0], report.position[1] - self._offset[1])
        at_rest = self._at_rest() or _stands(report)
        arc = next((a for a in self._arcs if a.holds(point)), None)
        self._track.add(report.at_ns, point, speed=report.speed or 0.0, arc=arc, at_rest=at_rest)
        if at_rest and report.state == "Idle":
            self._travelling = False
            self._arcs.clear()

    def _at_rest(self) -> bool:
        return self._stream.empty and (self._link.quiet or not self._travelling)

    def _locked(self) -> bool:
        """In the lock of a power-up or an alarm, by a fresh report."""
        return self._ask("status").state == "Alarm"

    def _status(self) -> StageStatus:
        report, link = self._link.report, self._link
        if link.alarm is not None:
            words, remedy = grbl.alarm(link.alarm)
            return StageStatus(StageState.ALARM, None, self._at(report), f"{words}; {remedy}")
        if report is None or not self._homed:
            return StageStatus(
                StageState.UNKNOWN, None, self._at(report), "its position is not known: home it"
            )
        detail = ""
        if _stands(report):
            state = StageState.HELD
            if report.state == "Door":
                detail = "the safety door is open" if report.substate else "the door was opened"
        elif report.state == "Idle" and self._at_rest():
            state = StageState.IDLE
        else:
            state = StageState.MOVING
        position = report.position
        if position is not None:
            position = (position[0] - self._offset[0], position[1] - self._offset[1])
        return StageStatus(state, position, report.at_ns, detail)

    def _at(self, report: grbl.Report | None) -> int:
        return report.at_ns if report else self.clock.now_ns()

    def position_at(self, at_ns: int) -> Point | None:
        """See Stage and drivers/track.py. From any thread; no I/O.

        Error in steady circular motion: speed times the jitter of a report's arrival (1 ms on a
        direct USB line); in acceleration a Δt²/8 more, .12 mm at 100 mm/s² and 10 reports a second.
        """
        return self._track.at(at_ns)

    # ------------------------------------------------------------ homing

    def home(self, timeout_s: float) -> None:
        """See Stage. The controller is silent meanwhile; after `timeout_s` it is reset.

        Not repeated by itself: a switch that was not found stays so.
        """
        self._begin("home")
        self._clear_for("home")
        if self.options.homing == "here":
            self._home_here()
            return
        link = self._link
        self._position_lost()
        link.alarm = None
        self._halted_by_reset = False
        self._homing = True
        try:
            link.command("$H", timeout_s, "home")
            if link.alarm is not None:
                link.settle_alarm("home")
        except DeviceTimeout:
            self._homing = False
            link.reset("home")
            raise DeviceTimeout(
                self.name,
                "home",
                f"homing did not end within {timeout_s:g} s, and was stopped",
                "check that both axes turn; raise the time, or $25 (seek rate)",
            ) from None
        except DeviceError:
            if link.interrupted and not self._halted_by_reset:
                link.urge(grbl.RESET)  # the halt came before the `$H`: it has only held
            raise
        finally:
            self._homing = False
        self._raise_homing_alarm()
        report = self._ask("home")
        if report.state != "Idle" or link.was_reset:
            raise DeviceRefused(
                self.name, "home", f"it says {report.state} after homing", "home it again"
            )
        self._settle("home")

    def _home_here(self) -> None:
        """The place where it stands becomes the origin: for stages without switches."""
        if self._locked():
            self._link.command("$X", REPLY_S, "home")
        self._link.alarm = None
        report = self._ask("home")
        if report.position is None:
            raise DeviceRefused(
                self.name,
                "home",
                "it reports work coordinates only",
                "set $10=1 (machine position)",
            )
        self._offset = report.position
        self._settle("home")

    def _settle(self, phase: str) -> None:
        """Homed: modes set, and the position known from a fresh report on."""
        self._link.command(MODES, REPLY_S, phase)
        self._homed = True
        for _ in range(40):  # WCO, where it is needed, comes with every 30th report at least
            if self._ask(phase).position is not None:
                return
        self._homed = False
        raise DeviceRefused(
            self.name, phase, "it reports work coordinates only", "set $10=1 (machine position)"
        )

    def _raise_homing_alarm(self) -> None:
        code = self._link.alarm
        if code is None:
            return
        self._position_lost()
        words, remedy = grbl.alarm(code)
        try:
            pins = self._link.ask("home").pins
        except DeviceError:
            pins = ""
        closed = "".join(axis for axis in "XYZ" if axis in pins)
        seen = f"; closed now: {', '.join(closed)}" if closed else "; no switch is closed now"
        raise DeviceRefused(self.name, "home", words + seen, remedy)

    def unlock(self) -> None:
        """See Stage. Safe to send again."""
        self._begin("unlock")
        self._clear_for("unlock")
        self._link.command("$X", REPLY_S, "unlock")
        self._link.alarm = None
        self._position_lost()

    def _clear_for(self, phase: str) -> None:
        """Bring it to where `$H` and `$X` are heard: nothing queued, no critical alarm."""
        self._abandon()
        self._link.await_banner(phase)
        if self._link.alarm in {1, 2}:
            self._position_lost()
            self._link.reset(phase)  # it hears nothing else
            return
        if self._link.in_flight or self._ask(phase).state not in {"Idle", "Alarm"}:
            self.stop()

    # ------------------------------------------------------------ motion

    def move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """See Stage. Not safe to send again after DeviceTimeout: ask for the status first."""
        self._begin("move")
        target = self._checked("move", (x_mm, y_mm), feed_mm_s)
        self._ready("move")
        self._start("move", iter([line(target, feed_mm_s)]))

    def jog(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """See Stage. Grbl's own jog: `hold` and `stop` end it at once, and lose nothing.

        Not safe to send again after DeviceTimeout.
        """
        self._begin("jog")
        target = self._checked("jog", (x_mm, y_mm), feed_mm_s)
        self._ready("jog")
        self._track.depart(self.clock.now_ns())
        self._travelling = True
        self._link.command(jog(target, feed_mm_s), REPLY_S, "jog")
        self._raise_trouble("jog")

    def circle(self, centre_mm: Point, radius_mm: float, feed_mm_s: float, turns: float) -> None:
        """See Stage. Counter-clockwise (x towards y), one G3 arc a turn; `turns` may be inf.

        Goes to the circle's first point, (x + r, y), in a straight line with the same feed.
        """
        self._begin("circle")
        arc, limits = Arc(centre_mm, radius_mm), self._limits_known()
        limits.check_feed("circle", feed_mm_s)
        limits.check_circle("circle", arc, turns)
        self._ready("circle")
        self._start("circle", self._round(arc, feed_mm_s, turns))

    def _round(self, arc: Arc, feed: float, turns: float) -> Iterator[str]:
        self._arcs.append(arc)
        yield line(self._machine(arc.point(0.0)), feed)
        yield from arcs(arc.radius, feed, turns)

    def _limits_known(self) -> Limits:
        return Limits(self.name, self.info())

    def _checked(self, phase: str, point: Point, feed: float) -> Point:
        """The machine position of a point that may be gone to. Raises DeviceRefused."""
        limits = self._limits_known()
        limits.check_feed(phase, feed)
        limits.check_box(phase, (point[0], point[0]), (point[1], point[1]))
        return self._machine(point)

    def _machine(self, point: Point) -> Point:
        return point[0] + self._offset[0], point[1] + self._offset[1]

    def _ready(self, phase: str) -> None:
        """Raises DeviceRefused unless it may move now."""
        self._raise_trouble(phase)
        if not self._homed:
            raise DeviceRefused(
                self.name, phase, "its position is not known", "`umbra stage home` first"
            )
        report = self._ask(phase)
        self._raise_trouble(phase)
        if report.state == "Hold":
            if self._travelling or self._link.in_flight:
                raise DeviceRefused(self.name, phase, "it is held", "resume it or stop it first")
            self._link.realtime(grbl.RESUME)  # there is nothing that could go on
        elif report.state not in {"Idle", "Run", "Jog"}:
            raise DeviceRefused(
                self.name, phase, f"it is in its state {report.state}", "`umbra stage status`"
            )

    def _start(self, phase: str, lines: Iterator[str]) -> None:
        """Accept a motion; the first line of an idle stage is waited for, to hear a refusal."""
        was_idle = not self._travelling and not self._link.in_flight
        self._track.depart(self.clock.now_ns())
        self._travelling = True
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
        self._begin("pump")
        self._raise_trouble("pump")
        self._stream.feed()
        self._link.poll(1 / self.options.poll_hz)
        return self._status()

    def _raise_trouble(self, phase: str) -> None:
        self._raise_alarm(phase)
        refused = self._link.refused
        if refused is not None:
            text, code = refused
            self._abandon()
            self._travelling = True  # others may be under way
            self.stop()
            self._link.refused = None
            problem, remedy = grbl.refusal(code)
            raise DeviceRefused(self.name, phase, f"{problem}: {text}", remedy)

    def _raise_alarm(self, phase: str) -> None:
        if self._link.alarm is not None:
            raise DeviceRefused(self.name, phase, *grbl.alarm(self._link.alarm))

    def hold(self) -> None:
        """See Stage. Safe to send again. Returns when it stands: deceleration plus 1 s at most."""
        self._begin("hold")
        self._stand("hold")

    def _stand(self, phase: str) -> grbl.Report:
        """Decelerate to a stand; the report that proves it. A jog ends in Idle, others in Hold."""
        sent = self._travelling or self._link.in_flight > 0
        if sent:
            self._link.realtime(grbl.HOLD)
        deadline_ns = self.clock.now_ns() + round((SETTLE_S + self._stop_s()) * NS)
        idle = 0
        while True:
            report = self._ask(phase)
            if self._link.alarm is not None or _stands(report):
                return report
            # a report can overtake the hold that was sent before it: one Idle proves nothing
            idle += report.state == "Idle"
            if report.state == "Idle" and (not sent or idle > 1):
                return report
            if self.clock.now_ns() > deadline_ns:
                raise DeviceTimeout(
                    self.name, phase, "it does not come to a stand", "switch its power off"
                )
            if report.state in {"Run", "Jog"}:
                self._link.realtime(grbl.JOG_CANCEL if report.state == "Jog" else grbl.HOLD)
                sent = True

    def _stop_s(self) -> float:
        info = self._info
        if info is None or not info.max_acceleration_mm_s2:
            return 2.0
        return info.max_feed_mm_s / info.max_acceleration_mm_s2

    def resume(self) -> None:
        """See Stage. Safe to send again."""
        self._begin("resume")
        self._raise_trouble("resume")
        report = self._ask("resume")
        for _ in range(3):
            if report.state not in {"Hold", "Door"}:
                return
            self._track.depart(self.clock.now_ns())
            self._link.realtime(grbl.RESUME)
            report = self._ask("resume")
        if report.state in {"Hold", "Door"}:
            raise DeviceRefused(
                self.name,
                "resume",
                "it stays held" + (" by the safety door" if report.state == "Door" else ""),
                "close the door, release the hold button",
            )

    def stop(self) -> None:
        """End every motion: decelerate, drop what is queued, hold by the motors. Idempotent.

        A feed hold is waited for and the buffers are then emptied by a reset. A reset at a stand
        loses no step; the position stays known if the controller says so: held before, no alarm
        and the same position after. In any other case it is unknown.
        """
        self._begin("stop")
        self._stream.clear()
        if self._link.alarm is not None:
            return
        before = self._stand("stop")
        if self._link.alarm is not None:
            return
        if before.state == "Idle" and not self._link.in_flight:
            self._abandon()
            return
        known = self._homed and before.state == "Hold" and before.substate == 0
        self._homed = False
        self._link.reset("stop")
        after = self._ask("stop")
        self._abandon()
        if self._link.alarm is not None or not known or after.state != "Idle":
            self._position_lost()
            return
        assert before.position is not None
        if after.position is None or math.dist(before.position, after.position) > KEPT_MM:
            self._position_lost()
            return
        self._settle("stop")
