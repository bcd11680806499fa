"""Motion along a path with limited acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from drivers.clock import NS

XY = tuple[float, float]


class Path(Protocol):
    """A line in the plane, by arc length in mm."""

    @property
    def length(self) -> float:
        """Of the whole path, mm."""
        ...

    @property
    def top_speed(self) -> float:
        """That its curvature allows for an acceleration of 1 mm/s²; inf: straight."""
        ...

    def at(self, s: float) -> XY:
        """The point at arc length s."""
        ...


@dataclass(frozen=True)
class Line:
    """Straight from a to b."""

    a: XY
    b: XY
    top_speed = math.inf

    @property
    def length(self) -> float:
        """See Path."""
        return math.dist(self.a, self.b)

    def at(self, s: float) -> XY:
        """See Path."""
        t = s / self.length if self.length else 0.0
        return self.a[0] + t * (self.b[0] - self.a[0]), self.a[1] + t * (self.b[1] - self.a[1])


@dataclass(frozen=True)
class Circle:
    """Round a centre from angle 0."""

    centre: XY
    radius: float
    turns: float

    @property
    def length(self) -> float:
        """See Path."""
        return 2 * math.pi * self.radius * self.turns

    @property
    def top_speed(self) -> float:
        """See Path."""
        return math.sqrt(self.radius)

    def at(self, s: float) -> XY:
        """See Path."""
        angle = s / self.radius
        return (
            self.centre[0] + self.radius * math.cos(angle),
            self.centre[1] + self.radius * math.sin(angle),
        )


@dataclass(frozen=True)
class Motion:
    """From rest at arc length `first` to rest at `last`: a trapezoid of speed.

    With `brake` it begins at `speed` instead and only slows down.
    """

    path: Path
    start_ns: int
    first: float
    last: float
    speed: float  # mm/s, top
    acceleration: float  # mm/s²
    brake: bool = False

    @property
    def _ramp_s(self) -> float:
        way = self.last - self.first
        if self.brake:
            return self.speed / self.acceleration
        return min(self.speed / self.acceleration, math.sqrt(way / self.acceleration))

    @property
    def duration_s(self) -> float:
        """From rest to rest."""
        if self.brake:
            return self._ramp_s
        if self.last <= self.first:
            return 0.0
        top = self._ramp_s * self.acceleration
        return self._ramp_s + (self.last - self.first) / top

    @property
    def end_ns(self) -> int:
        """When it is at rest again."""
        return self.start_ns + round(self.duration_s * NS)

    def along(self, at_ns: int) -> tuple[float, float]:
        """Arc length and speed at a moment."""
        t = (at_ns - self.start_ns) / NS
        if t <= 0:
            return self.first, self.speed if self.brake else 0.0
        if t >= self.duration_s:
            return self.last, 0.0
        a, left = self.acceleration, self.duration_s - t
        if self.brake or left < self._ramp_s:
            return self.last - a * left * left / 2, a * left
        if t < self._ramp_s:
            return self.first + a * t * t / 2, a * t
        top = a * self._ramp_s
        return self.first + top * (t - self._ramp_s / 2), top

    def at(self, at_ns: int) -> XY:
        """The point at a moment."""
        return self.path.at(self.along(at_ns)[0])

    def braked(self, at_ns: int) -> Motion:
        """The same path, coming to rest as soon as it can."""
        s, speed = self.along(at_ns)
        stop = s + speed * speed / (2 * self.acceleration)
        return Motion(self.path, at_ns, s, stop, speed, self.acceleration, brake=True)
