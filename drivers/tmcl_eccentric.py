"""The geometry of an eccentric: a motor's microsteps, its shaft's angle, the place of the pin.

The pin sits at the arc's radius from the shaft, on a parallel guide, so that angle θ puts the
occluder at centre + r (cos θ, sin θ).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.limits import NEAR_MM
from drivers.track import Arc, Point


@dataclass(frozen=True, slots=True)
class Eccentric:
    """`turn`: microsteps a turn, below 0 for a motor that turns the other way round; `home_rad`:
    the shaft's angle at microstep 0."""

    arc: Arc
    turn: int
    home_rad: float

    @property
    def step_mm(self) -> float:
        """Path of one microstep, mm; counter-clockwise is above 0."""
        return math.tau * self.arc.radius / self.turn

    def angle(self, position: int) -> float:
        """rad; unwrapped."""
        return position / self.turn * math.tau + self.home_rad

    def point(self, position: int) -> Point:
        """Where the occluder is."""
        return self.arc.point(self.angle(position))

    def off(self, point: Point) -> float:
        """How far a point is from the circle, mm."""
        return abs(math.dist(point, self.arc.centre) - self.arc.radius)

    def nearest(self, point: Point) -> Point:
        """The circle's point that is nearest."""
        return self.arc.point(self.arc.angle(point))

    def to_point(self, point: Point, position: int) -> int:
        """Microsteps to a point of the circle, the shorter way round."""
        return self._steps(math.remainder(self.arc.angle(point) - self.angle(position), math.tau))

    def around(self, turns: float, position: int) -> int:
        """Microsteps to the circle's first point (angle 0), and on for so many turns."""
        to_start = -self.angle(position) % math.tau
        if math.tau - to_start < NEAR_MM / self.arc.radius:  # it is there
            to_start = 0.0
        return self._steps(to_start + turns * math.tau)

    def _steps(self, way_rad: float) -> int:
        return round(way_rad / math.tau * self.turn)
