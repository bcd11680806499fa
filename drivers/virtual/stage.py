"""A stage that moves an occluder through the light."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any

from msgspec import Meta

from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceRefused, DeviceTimeout, OutOfRange
from drivers.base.stage import Stage, StageInfo, StageState, StageStatus
from drivers.clock import NS
from drivers.virtual.device import VirtualDevice, VirtualOptions
from drivers.virtual.faults import Fault
from drivers.virtual.motion import XY, Circle, Line, Motion, Path
from drivers.virtual.occluder import Occluder, OccluderKind
from drivers.virtual.timeline import Timeline

Positive = Annotated[float, Meta(gt=0)]
Travel = tuple[float, float]
ROUNDING_MM = 1e-9
ENDLESS_TURNS = 1e6


class StageOptions(VirtualOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of ``[stage] driver = "virtual"``."""

    travel_x_mm: Travel = (0.0, 500.0)
    travel_y_mm: Travel = (0.0, 300.0)
    max_feed_mm_s: Positive = 200.0
    acceleration_mm_s2: Positive = 1000.0
    homing_feed_mm_s: Positive = 50.0
    parked_mm: tuple[float, float] = (60.0, 40.0)  # where it really stands when it is switched on
    occluder: OccluderKind = OccluderKind.SQUARE
    hole_mm: Positive = 6.25
    pitch_mm: Positive = 10.0
    stick_mm: Positive = 18.0  # width
    light: str = ""  # the light that it stands under; "": all
    before_scene_mm: Positive = 400.0  # from the middle of the scene to the occluder


class VirtualStage(VirtualDevice, Stage):
    """An XY stage with trapezoids of speed, homing, soft limits, hold and resume.

    The occluder is somewhere from the beginning and casts its shadow there, also while its
    position is unknown to everybody but the bench. Motions queue behind one another. `halt` slows
    down as hard as `hold`, and forgets what was to come; homing that is halted leaves the position
    unknown. `status`, `pump`, `home`, `hold`, `unlock`, `safe` and `check` are safe to send again;
    `move` to the same point too; `circle` and `resume` are not.
    """

    options_type = StageOptions
    main_act = "status"

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, StageOptions)
        self._o = options
        self.occluder = Occluder(
            options.occluder, options.hole_mm, options.pitch_mm, options.stick_mm
        )
        self.shades = options.light
        self.before_scene_mm = options.before_scene_mm
        rest = Line(options.parked_mm, options.parked_mm)
        self._motions = Timeline(Motion(rest, 0, 0, 0, 1, 1))
        self._latest = self._motions.spans(0, 1)[0][2]
        self._planned: list[Motion] = []  # in order; the first may be under way
        self._kept: list[Motion] = []  # what a hold interrupted
        self._state = StageState.UNKNOWN  # IDLE stands for MOVING, too: that is a matter of time
        self._known_ns: int | None = None  # since when
        self.bench.carrier = self

    # ------------------------------------------------------------ as the bench sees it

    def offset_at(self, at_ns: int) -> XY:
        """See Carrier. Raises Forgotten."""
        x, y = self._true(at_ns)
        (x0, x1), (y0, y1) = self._o.travel_x_mm, self._o.travel_y_mm
        return x - (x0 + x1) / 2, y - (y0 + y1) / 2

    def _true(self, at_ns: int) -> XY:
        return self._motions.spans(at_ns, at_ns + 1)[0][2].at(at_ns)

    # ------------------------------------------------------------ Device

    def connect(self) -> Identity:
        """See Device; the position is unknown after it."""
        identity = super().connect()
        with self.bench.lock:
            self._brake()
            self._forget()
        return identity

    def facts(self) -> dict[str, Any]:
        """See Device."""
        return {
            "virtual": True,
            "homed": self._state in {StageState.IDLE, StageState.HELD},
            "occluder": self._o.occluder.value,
            "hole_fraction": self.occluder.hole_fraction,
            "light": self.shades,
        }

    def safe(self) -> None:
        """See Device: held."""
        self._begin("safe")
        self._hold()

    def halt(self) -> None:
        """See Device."""
        super().halt()
        with self.bench.lock:
            self._brake()
            self._kept.clear()
            if self._state is StageState.HOMING:
                self._forget()
            elif self._state is StageState.HELD:
                self._state = StageState.IDLE

    def close(self) -> None:
        """See Device."""
        self._connected = False
        with self.bench.lock:
            self._brake()
            self._forget()

    def _forget(self) -> None:
        self._state, self._known_ns = StageState.UNKNOWN, None
        self._kept.clear()

    # ------------------------------------------------------------ Stage

    def info(self) -> StageInfo:
        """See Stage."""
        o = self._o
        return StageInfo((o.travel_x_mm, o.travel_y_mm), o.max_feed_mm_s, o.acceleration_mm_s2)

    def status(self) -> StageStatus:
        """See Stage."""
        self._begin("status")
        with self.bench.lock:
            now = self.clock.now_ns()
            state = self._state
            if state is StageState.IDLE and now < self._latest.end_ns:
                state = StageState.MOVING
            return StageStatus(state, self._position(now), now)

    def pump(self) -> StageStatus:
        """See Stage; the planner of this one is never empty."""
        return self.status()

    def position_at(self, at_ns: int) -> XY | None:
        """See Stage."""
        with self.bench.lock:
            return self._position(at_ns)

    def _position(self, at_ns: int) -> XY | None:
        if self._known_ns is None or at_ns < self._known_ns:
            return None
        return self._true(at_ns)

    def home(self, timeout_s: float) -> None:
        """See Stage: to the lower ends of the travel."""
        kinds = self._begin("home", timeout_s)
        o = self._o
        with self.bench.lock:
            self._brake()
            self._forget()
            self._state = StageState.HOMING
            if Fault.NO_SWITCH in kinds:
                self._state = StageState.ALARM
                raise DeviceRefused(
                    self.name, "home", "limit switch X was not found", "check the switch; unlock"
                )
            origin = (o.travel_x_mm[0], o.travel_y_mm[0])
            self._plan(Line(self._latest.path.at(self._latest.last), origin), o.homing_feed_mm_s)
            end = self._latest.end_ns
        deadline = self.clock.now_ns() + round(timeout_s * NS)
        halted = self.clock.wait_until(min(end, deadline), self._halted)
        with self.bench.lock:
            if halted or end > deadline:
                self._brake()
                self._forget()
                problem = "halted" if halted else f"no switch within {timeout_s:g} s"
                raise DeviceTimeout(self.name, "home", problem, "home it again")
            self._state, self._known_ns = StageState.IDLE, end

    def unlock(self) -> None:
        """See Stage."""
        self._begin("unlock")
        if self._state is StageState.ALARM:
            self._forget()

    def move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """See Stage."""
        self._begin("move")
        self._allow("move", (x_mm, x_mm), (y_mm, y_mm), feed_mm_s)
        with self.bench.lock:
            here = self._latest.path.at(self._latest.last)
            self._plan(Line(here, (x_mm, y_mm)), feed_mm_s)

    def circle(self, centre_mm: XY, radius_mm: float, feed_mm_s: float, turns: float) -> None:
        """See Stage. It goes straight to the first point, if it is not there; `turns` may be inf:
        a million, then."""
        self._begin("circle")
        turns = min(turns, ENDLESS_TURNS)
        if not (radius_mm > 0 and turns > 0):
            raise OutOfRange(
                self.name, "circle", f"radius {radius_mm:g}, {turns:g} turns", "both are above 0"
            )
        x, y = centre_mm
        self._allow(
            "circle", (x - radius_mm, x + radius_mm), (y - radius_mm, y + radius_mm), feed_mm_s
        )
        with self.bench.lock:
            here = self._latest.path.at(self._latest.last)
            first = (x + radius_mm, y)
            if math.dist(here, first) > ROUNDING_MM:
                self._plan(Line(here, first), feed_mm_s)
            self._plan(Circle(centre_mm, radius_mm, turns), feed_mm_s)

    def hold(self) -> None:
        """See Stage."""
        self._begin("hold")
        self._hold()

    def stop(self) -> None:
        """See Stage. The position stays known."""
        self._begin("stop")
        self._hold()
        with self.bench.lock:
            self._kept.clear()
            if self._state is StageState.HELD:
                self._state = StageState.IDLE

    def resume(self) -> None:
        """See Stage."""
        self._begin("resume")
        with self.bench.lock:
            if self._state is not StageState.HELD:
                return
            kept, self._kept = self._kept, []
            self._state = StageState.IDLE
            for motion in kept:
                self._plan(motion.path, motion.speed, motion.first)

    # ------------------------------------------------------------ planning (bench locked)

    def _allow(self, phase: str, x: Travel, y: Travel, feed_mm_s: float) -> None:
        """Soft limits. Raises DeviceRefused."""
        o = self._o
        if self._state is not StageState.IDLE:
            remedy = "resume it" if self._state is StageState.HELD else "home it"
            unknown = self._state is StageState.UNKNOWN
            problem = "its position is not known" if unknown else f"it is {self._state}"
            raise DeviceRefused(self.name, phase, problem, remedy)
        for axis, (low, high), (least, most) in (
            ("x", x, o.travel_x_mm),
            ("y", y, o.travel_y_mm),
        ):
            if not (least <= low and high <= most):
                raise OutOfRange(
                    self.name,
                    phase,
                    f"{axis} from {low:g} to {high:g} mm is past the soft limit",
                    f"stay within {least:g} to {most:g} mm",
                )
        if not 0 < feed_mm_s <= o.max_feed_mm_s:
            raise OutOfRange(
                self.name,
                phase,
                f"a feed of {feed_mm_s:g} mm/s",
                f"choose one up to {o.max_feed_mm_s:g} mm/s",
            )

    def _plan(self, path: Path, feed_mm_s: float, first: float = 0.0) -> None:
        """Move along a path as soon as the motions before it are over."""
        a = self._o.acceleration_mm_s2
        speed = min(feed_mm_s, path.top_speed * math.sqrt(a))
        start = max(self.clock.now_ns(), self._latest.end_ns)
        self._planned = [m for m in self._planned if m.end_ns > self.clock.now_ns()]
        self._latest = Motion(path, start, first, path.length, speed, a)
        self._planned.append(self._latest)
        self._motions.change(start, self._latest)

    def _brake(self) -> list[Motion]:
        """Come to rest; gives what is left undone, from where it rests."""
        now = self.clock.now_ns()
        undone = [m for m in self._planned if m.end_ns > now]
        self._planned = []
        if not undone:
            return []
        current = undone[0]
        stopping = current.braked(now)
        self._latest = stopping
        self._motions.change(now, stopping)
        return [replace(current, first=stopping.last), *undone[1:]]

    def _hold(self) -> None:
        with self.bench.lock:
            if self._state is StageState.IDLE:
                self._kept = self._brake()
                if self._kept:  # at rest there is nothing to hold
                    self._state = StageState.HELD
