"""What a stage is: a motorised XY occluder that knows where it is, or that it does not."""

from __future__ import annotations

import enum
from abc import abstractmethod
from dataclasses import dataclass

from drivers.base.device import Device


class StageState(enum.StrEnum):
    """What a stage is doing.

    unknown ──home──> homing ──> idle <──> moving | held;  any ──> alarm ──unlock──> unknown
    any ──reconnect──> unknown
    """

    UNKNOWN = "unknown"  # its position is not known: nothing but homing is allowed
    HOMING = "homing"
    IDLE = "idle"
    MOVING = "moving"
    HELD = "held"
    ALARM = "alarm"


@dataclass(frozen=True, slots=True)
class StageInfo:
    """Travel in mm from the origin on each axis, and the fastest feed."""

    travel_mm: tuple[tuple[float, float], tuple[float, float]]  # (x min, x max), (y min, y max)
    max_feed_mm_s: float
    max_acceleration_mm_s2: float = 0.0
    #: centre and radius of the only circle that it can go round (an eccentric); None: any
    only_circle_mm: tuple[tuple[float, float], float] | None = None


@dataclass(frozen=True, slots=True)
class StageStatus:
    """Where a stage was at a moment of the clock; `position_mm` is None while it is unknown."""

    state: StageState
    position_mm: tuple[float, float] | None
    at_ns: int
    detail: str = ""  # in words: which alarm, what holds it, and the remedy


class Stage(Device):
    """A motorised XY occluder. Motion calls return when the motion is accepted, not when it ends;
    soft limits are checked before anything is sent (DeviceRefused)."""

    kind = "stage"

    @abstractmethod
    def info(self) -> StageInfo:
        """Limits; valid after connect; no I/O."""

    @abstractmethod
    def status(self) -> StageStatus:
        """Ask it now. Raises DeviceTimeout, DeviceLost."""

    @abstractmethod
    def home(self, timeout_s: float) -> None:
        """Find the origin; returns when it is found. Raises DeviceRefused naming the switch."""

    @abstractmethod
    def unlock(self) -> None:
        """Leave the alarm without homing; the position stays unknown."""

    @abstractmethod
    def move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """Go straight to a point."""

    @abstractmethod
    def circle(
        self, centre_mm: tuple[float, float], radius_mm: float, feed_mm_s: float, turns: float
    ) -> None:
        """Go round, without a stop between turns, from the circle's first point (angle 0)."""

    @abstractmethod
    def pump(self) -> StageStatus:
        """Keep the planner full and the position fresh; called often while moving. See `status`."""

    @abstractmethod
    def position_at(self, at_ns: int) -> tuple[float, float] | None:
        """Where it was at a moment of the clock, between the positions reported; None: unknown."""

    def stop(self) -> None:
        """End every motion, endless circles too: decelerate, and drop what is queued. Idempotent.

        Unlike after `hold` there is nothing to resume. The position stays known if the device can
        prove it. A device that has no better way goes to its safe state.
        """
        self.safe()

    def jog(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """Go to a point by hand: as `move`, but `hold` ends it for good where the device can."""
        self.move(x_mm, y_mm, feed_mm_s)

    @abstractmethod
    def hold(self) -> None:
        """Decelerate and hold; the position stays known. Idempotent."""

    @abstractmethod
    def resume(self) -> None:
        """Go on after a hold."""
