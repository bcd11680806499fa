"""A Trinamic TMCL module that turns an eccentric: one stepper, whose rotation is the mesh's circle.

The occluder hangs on a pin of the motor's shaft (tmcl_eccentric.py) and can be nowhere but on its
circle: `move` takes points of that circle, and `circle` only that circle.

A position read after a reconnect means nothing (the module may have lost its supply, or the shaft
been turned): homed first. What the line does about damaged, late and missing answers is said in
tmcl_line.py; every command sent here is safe to send again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.stage import Stage, StageInfo, StageState, StageStatus
from drivers.clock import NS
from drivers.limits import NEAR_MM, Limits
from drivers.serialport import SerialPort, attached
from drivers.tmcl_eccentric import Eccentric
from drivers.tmcl_line import TmclLine
from drivers.tmcl_protocol import Axis, Command, signed
from drivers.track import Arc, Point, Track

POLL_S = 0.02
STALL_S = 1.0  # a motor that was told to turn has begun by then


CHIPS = {(0x2A3C, None)}
"""Trinamic's USB modules; one on RS485 shows its adapter only, and is not found."""


class TmclOptions(Options, frozen=True, kw_only=True):
    """[stage] driver = "tmcl"."""

    port: str  # as for grbl; RS485 and USB modules alike
    radius_mm: Annotated[float, Meta(gt=0)]  # of the eccentric
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] = 9600
    address: Annotated[int, Meta(ge=1, le=255)] = 1
    motor: Annotated[int, Meta(ge=0, le=5)] = 0
    identity: str = ""  # the module's type as it says it, e.g. "1140"; "": any
    centre_mm: Point = (0.0, 0.0)
    steps_per_turn: Annotated[int, Meta(ge=1)] = 200  # full steps a turn of the eccentric
    reverse: bool = False  # the eccentric turns the other way round
    max_feed_mm_s: Annotated[float, Meta(gt=0)] = 50.0  # along the circle
    homing: Literal["reference", "here"] = "reference"  # reference: the module's own search
    home_angle_deg: float = 0.0  # where the eccentric is at the reference
    velocity_unit: Literal["pps", "internal"] = "pps"  # internal: TMCM-1140 and older


@dataclass(slots=True)
class _Motion:
    """What was last asked, to go on with after a hold: a target, or for ever at a speed."""

    target: int | None
    speed: int


class TmclStage(Stage):
    """See the module. A new motion replaces the one under way, without a stop between them."""

    options_type: ClassVar[type[Options]] = TmclOptions
    options: TmclOptions

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, TmclOptions)
        self.options = options
        self._line = TmclLine(
            SerialPort(name, options.port, options.baud),
            context.clock,
            options.address,
            options.motor,
        )
        self._line.on_lost = self._position_lost
        self._arc = Arc(options.centre_mm, options.radius_mm)
        self._track = Track()
        self._known: Eccentric | None = None  # once the module's resolution is
        self._pps_unit = 1.0  # microsteps a second in one of the module's units of speed
        self._homed = False
        self._homing = False
        self._held = False
        self._motion: _Motion | None = None
        self._position = 0  # microsteps from angle 0, unwrapped beyond 32 bits
        self._raw = 0
        self._at_ns = 0
        self._stands_since_ns = 0

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device; nothing is opened."""
        return attached(CHIPS)

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """Open, identify, read the resolution; a motor that turns is stopped. Safe to try again."""
        self.close()
        self._line.open()
        try:
            identity = self._identify()
            self._line.ask(Command.STOP, phase="connect")
            turn = self.options.steps_per_turn << self._line.get(Axis.MICROSTEPS, "connect")
            self._known = Eccentric(
                self._arc,
                -turn if self.options.reverse else turn,
                math.radians(self.options.home_angle_deg),
            )
            self._pps_unit = 1.0
            if self.options.velocity_unit == "internal":
                divisor = self._line.get(Axis.PULSE_DIVISOR, "connect")
                self._pps_unit = 16e6 / (2**divisor * 2048 * 32)
        except DeviceError:
            self.close()
            raise
        return identity

    def _identify(self) -> Identity:
        value = self._line.ask(Command.GET_VERSION, 1, phase="connect") & 0xFFFFFFFF
        model, version = str(value >> 16), f"{value >> 8 & 0xFF}.{value & 0xFF:02d}"
        if self.options.identity and self.options.identity != model:
            raise DeviceRefused(
                self.name,
                "connect",
                f"the module is a {model}, not a {self.options.identity}",
                "correct `port`, `address` or `identity`",
            )
        usb = self._line.port.identity
        return Identity(f"TMCM-{model}", usb.serial if usb else "", version)

    def check(self) -> None:
        """One read of the position."""
        self._line.begin("check")
        self._read("check")

    def safe(self) -> None:
        """Stopped, held by its current, nothing to resume."""
        if self._line.port.is_open:
            self.stop()

    def halt(self) -> None:
        """See Device: a stop frame; its answer is passed over by whoever reads next."""
        self._line.halt()
        if self._homing:
            self._line.urge(Command.REFERENCE_SEARCH, 1)
        self._line.urge(Command.STOP)
        self._held = True

    def close(self) -> None:
        """See Device. What turns is stopped first: nobody would hear of it."""
        if self._line.port.is_open and self._motion is not None:
            self._line.urge(Command.STOP)
        self._line.port.close()
        self._position_lost()

    def _position_lost(self) -> None:
        self._homed = self._held = False
        self._motion = None
        self._track.forget()

    def facts(self) -> dict[str, Any]:
        """See Device."""
        return {
            "port": self._line.port.path or self.options.port,
            "homed": self._homed,
            "radius_mm": self.options.radius_mm,
            "microsteps_per_turn": abs(self._known.turn) if self._known else 0,
            "damaged_frames": self._line.damaged,
        }

    # ------------------------------------------------------------ state

    def info(self) -> StageInfo:
        """See Stage: the circle's bounding box."""
        self._eccentric()
        (x, y), r = self.options.centre_mm, self.options.radius_mm
        travel = ((x - r, x + r), (y - r, y + r))
        return StageInfo(travel, self.options.max_feed_mm_s, only_circle_mm=((x, y), r))

    def _eccentric(self) -> Eccentric:
        if self._known is None:
            raise DeviceLost(self.name, "info", "it is not connected", "reconnect it")
        return self._known

    def status(self) -> StageStatus:
        """See Stage."""
        self._line.begin("status")
        return self._read("status")

    def _read(self, phase: str) -> StageStatus:
        """Position and motion now. The position is of the middle of its exchange."""
        began = self.clock.now_ns()
        raw = self._line.get(Axis.POSITION, phase)
        at_ns = (began + self.clock.now_ns()) // 2
        moved = (raw - self._raw + 2**31) % 2**32 - 2**31  # the counter wraps after some hours
        seconds = (at_ns - self._at_ns) / NS
        self._raw, self._at_ns = raw, at_ns
        self._position += moved
        rate = moved / seconds if seconds > 0 else 0.0
        speed = self._line.get(Axis.SPEED, phase)
        motion = self._motion
        arrived = (
            motion is not None
            and motion.target is not None
            and speed == 0
            and raw == signed(motion.target)
        )
        if arrived:
            self._motion = None
        self._watch(speed != 0 or motion is None or arrived or self._held, at_ns, phase)
        at_rest = speed == 0 and (self._motion is None or self._held)
        if not self._homed:
            return StageStatus(
                StageState.UNKNOWN, None, at_ns, "its position is not known: home it"
            )
        eccentric = self._eccentric()
        point = eccentric.point(self._position)
        self._track.add(
            at_ns, point, speed=rate * eccentric.step_mm, arc=self._arc, at_rest=at_rest
        )
        if not at_rest:
            state = StageState.MOVING
        else:
            state = StageState.HELD if self._motion is not None else StageState.IDLE
        return StageStatus(state, point, at_ns)

    def _watch(self, well: bool, at_ns: int, phase: str) -> None:
        """A motor that was told to turn, and stands, is not MOVING for ever."""
        if well:
            self._stands_since_ns = 0
        elif not self._stands_since_ns:
            self._stands_since_ns = at_ns
        elif at_ns - self._stands_since_ns > STALL_S * NS:
            self._position_lost()
            raise DeviceRefused(
                self.name,
                phase,
                "it stopped short of its target",
                "a limit switch, or the driver's own protection: check both, then `umbra stage "
                "home`",
            )

    def position_at(self, at_ns: int) -> Point | None:
        """See Stage. Evenly in angle between the reads: error as in drivers/track.py."""
        return self._track.at(at_ns)

    def pump(self) -> StageStatus:
        """See Stage: a reading of 4 frames (5 ms on USB, 40 ms at 9600 baud); nothing is fed."""
        self._line.begin("pump")
        return self._read("pump")

    # ------------------------------------------------------------ homing

    def home(self, timeout_s: float) -> None:
        """See Stage. The module's own reference search, as its axis parameter 193 says."""
        self._line.begin("home")
        self._position_lost()
        if self.options.homing == "here":
            self._line.ask(Command.STOP, phase="home")
            self._until(lambda: self._line.get(Axis.SPEED, "home") == 0, timeout_s, "home")
            self._line.set(Axis.TARGET, 0, "home")
            self._line.set(Axis.POSITION, 0, "home")
        else:
            self._homing = True
            try:
                self._search(timeout_s)
            finally:
                self._homing = False
        self._raw = self._line.get(Axis.POSITION, "home")
        self._position = self._raw
        self._at_ns = self.clock.now_ns()
        self._homed = True
        self._read("home")

    def _search(self, timeout_s: float) -> None:
        self._line.ask(Command.REFERENCE_SEARCH, 0, phase="home")
        try:
            self._until(
                lambda: self._line.ask(Command.REFERENCE_SEARCH, 2, phase="home") == 0,
                timeout_s,
                "home",
            )
        except DeviceTimeout:
            self._line.ask(Command.REFERENCE_SEARCH, 1, phase="home")
            self._line.ask(Command.STOP, phase="home")
            raise DeviceTimeout(
                self.name,
                "home",
                f"the reference was not found within {timeout_s:g} s, and the search was stopped",
                "check the reference switch and axis parameters 193 to 195",
            ) from None

    def _until(self, done: Callable[[], bool], timeout_s: float, phase: str) -> None:
        deadline = self.clock.now_ns() + round(timeout_s * NS)
        while not done():
            if self.clock.now_ns() > deadline:
                raise DeviceTimeout(self.name, phase, f"not done within {timeout_s:g} s")
            self._line.wait(POLL_S)

    def unlock(self) -> None:
        """See Stage: TMCL has no alarm to leave."""
        self._line.begin("unlock")
        self._line.ask(Command.STOP, phase="unlock")
        self._position_lost()

    # ------------------------------------------------------------ motion

    def move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """See Stage: the shorter way round to a point of the circle. Safe to send again."""
        self._line.begin("move")
        speed, eccentric = self._speed("move", feed_mm_s), self._eccentric()
        off = eccentric.off((x_mm, y_mm))
        if not off <= NEAR_MM:
            (x, y), near = self._arc.centre, eccentric.nearest((x_mm, y_mm))
            raise DeviceRefused(
                self.name,
                "move",
                f"({x_mm:g}, {y_mm:g}) is {off:.3f} mm off the eccentric's circle of "
                f"{self._arc.radius:g} mm about ({x:g}, {y:g})",
                f"the nearest point is ({near[0]:.3f}, {near[1]:.3f})",
            )
        self._ready("move")
        self._go(eccentric.to_point((x_mm, y_mm), self._position), speed, "move")

    def circle(self, centre_mm: Point, radius_mm: float, feed_mm_s: float, turns: float) -> None:
        """See Stage: only the eccentric's own circle. Safe to send again. `turns` may be inf."""
        self._line.begin("circle")
        speed = self._speed("circle", feed_mm_s)
        limits = Limits(self.name, self.info())
        limits.check_circle("circle", Arc(centre_mm, radius_mm), turns)
        self._ready("circle")
        if math.isinf(turns):
            self._run(_Motion(None, -speed if self.options.reverse else speed), "circle")
        else:
            self._go(self._eccentric().around(turns, self._position), speed, "circle")

    def _speed(self, phase: str, feed: float) -> int:
        """In the module's units. Raises DeviceRefused."""
        Limits(self.name, self.info()).check_feed(phase, feed)
        return max(1, round(feed / abs(self._eccentric().step_mm) / self._pps_unit))

    def _ready(self, phase: str) -> None:
        if not self._homed:
            raise DeviceRefused(
                self.name, phase, "its position is not known", "`umbra stage home` first"
            )
        if self._held and self._motion is not None:
            raise DeviceRefused(self.name, phase, "it is held", "resume it or stop it first")
        self._held = False
        self._read(phase)

    def _go(self, steps: int, speed: int, phase: str) -> None:
        if abs(steps) >= 2**31:
            raise DeviceRefused(
                self.name, phase, "more turns than the module counts", "ask for endless turns"
            )
        self._run(_Motion(self._raw + steps, speed), phase)

    def _run(self, motion: _Motion, phase: str) -> None:
        self._track.depart(self.clock.now_ns())
        self._motion, self._held = motion, False
        if motion.target is None:
            turn = Command.ROTATE_RIGHT if motion.speed > 0 else Command.ROTATE_LEFT
            self._line.ask(turn, 0, abs(motion.speed), phase=phase)
        else:
            self._line.set(Axis.MAX_SPEED, motion.speed, phase)
            self._line.ask(Command.MOVE_TO, 0, signed(motion.target), phase=phase)

    def hold(self) -> None:
        """See Stage. Safe to send again."""
        self._line.begin("hold")
        self._stand("hold")

    def _stand(self, phase: str) -> None:
        self._held = True
        self._line.ask(Command.STOP, phase=phase)
        self._until(lambda: self._line.get(Axis.SPEED, phase) == 0, 3.0, phase)
        self._read(phase)

    def resume(self) -> None:
        """See Stage: to the same absolute target, so safe to send again."""
        self._line.begin("resume")
        self._held = False
        if self._motion is not None and self._homed:
            self._run(self._motion, "resume")

    def stop(self) -> None:
        """See Stage. The position stays known: a module counts while it decelerates."""
        self._line.begin("stop")
        self._stand("stop")
        self._motion, self._held = None, False
        self._read("stop")
