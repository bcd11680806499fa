"""Where a stage was at a moment, from the positions that its controller reported now and then.

Between two reports a stage is taken to have moved evenly: along the circle's angle if both lie on
the circle that it goes round, along the straight line otherwise. The error is then at most

    a Δt² / 8  +  v τ

with acceleration a (0 in steady motion), Δt between the reports, speed v, and τ the uncertainty of
a report's time. A chord instead of the arc would add r(1 - cos(ω Δt / 2)): most of the radius at
ten reports a second. How many whole turns lie between two reports follows from the reported speed.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

from drivers.clock import NS

Point = tuple[float, float]

ON_ARC_MM = 0.05  # a position this near to the circle is on it (Grbl's chords are within 0.01)
LONGEST_GAP_S = 1.0  # between reports: over a longer one a moving stage is not followed
AHEAD_S = 0.25  # past the last report: evenly on, for no longer than this


@dataclass(frozen=True, slots=True)
class Arc:
    """A circle gone round, counter-clockwise (x towards y) for positive speeds."""

    centre: Point
    radius: float

    def angle(self, point: Point) -> float:
        """The point's direction from the centre, rad."""
        return math.atan2(point[1] - self.centre[1], point[0] - self.centre[0])

    def point(self, angle: float) -> Point:
        """The point of the circle in a direction."""
        return (
            self.centre[0] + self.radius * math.cos(angle),
            self.centre[1] + self.radius * math.sin(angle),
        )

    def holds(self, point: Point) -> bool:
        """Whether a point lies on the circle, within `ON_ARC_MM`."""
        distance = math.hypot(point[0] - self.centre[0], point[1] - self.centre[1])
        return abs(distance - self.radius) <= ON_ARC_MM


@dataclass(frozen=True, slots=True)
class Sample:
    """A reported position, mm; `speed` along the path in mm/s; at rest it stays where it is."""

    at_ns: int
    point: Point
    speed: float
    arc: Arc | None
    at_rest: bool


class Track:
    """The last minutes of reports; thread-safe, constant memory."""

    def __init__(self, length: int = 4096) -> None:
        self._samples: deque[Sample] = deque(maxlen=length)
        self._lock = threading.Lock()

    def forget(self) -> None:
        """The position is unknown from now on, and what was reported means nothing any more."""
        with self._lock:
            self._samples.clear()

    def add(
        self, at_ns: int, point: Point, *, speed: float, arc: Arc | None, at_rest: bool
    ) -> None:
        """A report. One that is older than the last is dropped."""
        on = arc if arc is not None and arc.holds(point) else None
        with self._lock:
            if not self._samples or at_ns > self._samples[-1].at_ns:
                self._samples.append(Sample(at_ns, point, speed, on, at_rest))

    def depart(self, at_ns: int) -> None:
        """A motion begins: until now it stood where it was last reported at rest."""
        with self._lock:
            if self._samples and self._samples[-1].at_rest and at_ns > self._samples[-1].at_ns:
                last = self._samples[-1]
                self._samples.append(Sample(at_ns, last.point, 0.0, last.arc, at_rest=False))

    def at(self, at_ns: int) -> Point | None:
        """The position at a moment; None before the first report and where it can't be told."""
        with self._lock:
            samples = list(self._samples)[-64:]
            if samples and at_ns < samples[0].at_ns:
                samples = list(self._samples)
        later = next((i for i, s in enumerate(samples) if s.at_ns > at_ns), len(samples))
        if later == 0:
            return None
        before = samples[later - 1]
        if before.at_rest or before.at_ns == at_ns:
            return before.point
        if later < len(samples):
            return _between(before, samples[later], at_ns)
        if later >= 2 and at_ns - before.at_ns <= AHEAD_S * NS:
            return _between(samples[later - 2], before, at_ns)
        return None


def _between(a: Sample, b: Sample, at_ns: int) -> Point | None:
    """Evenly from a to b, and on from b at the same pace."""
    seconds = (b.at_ns - a.at_ns) / NS
    if seconds > LONGEST_GAP_S:
        return None
    part = (at_ns - a.at_ns) / NS / seconds
    if a.arc is not None and a.arc == b.arc:
        start = a.arc.angle(a.point)
        turned = math.remainder(a.arc.angle(b.point) - start, math.tau)
        expected = (a.speed + b.speed) / 2 * seconds / a.arc.radius
        turned += math.tau * round((expected - turned) / math.tau)
        return a.arc.point(start + part * turned)
    return (
        a.point[0] + part * (b.point[0] - a.point[0]),
        a.point[1] + part * (b.point[1] - a.point[1]),
    )
