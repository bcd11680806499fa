"""What the verification experiments (§3.5) share: points are found on the projector by a Gray code
in the same run, then patterns are shown in which they stay unlit."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from string import ascii_uppercase
from typing import Any, TypeVar

from daemon.scans.gray_code import bits_for, code, code_patterns
from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Digest, Expose, Step, Unsuitable
from daemon.scans.parameters import leakage_of
from daemon.scans.planned import exposures, source_references
from daemon.separation.estimator import Measurement
from daemon.separation.verification import REACH, Anchors, Reading, Source, Spot
from daemon.separation.verification import Verification as PointReadings
from protocol.patterns import AnyPattern, Axis
from protocol.scans.spec import Radiometry
from protocol.scans.verifications import Verification

V = TypeVar("V", bound=Verification)


class VerificationMethod(MeasuringMethod[V]):
    """Source off, black, white, the code; then (when the points are found) the experiment's
    patterns. A subclass says how many there are, which, and what they come to."""

    def __init__(self, spec: V, bench: Bench) -> None:
        super().__init__(spec, bench)
        projector = self.projector()
        self._spots = _spots(spec, bench)
        self._images = code({Axis.X: bits_for(projector.width), Axis.Y: bits_for(projector.height)})
        shown = exposures(code_patterns(self._images), 1)
        self._plan = [*source_references(2 * spec.average), *shown, Digest()]

    @abstractmethod
    def count(self) -> int:
        """How many patterns the experiment has."""

    @abstractmethod
    def pattern(self, number: int, points: Anchors) -> AnyPattern:
        """One of them, for these projector pixels."""

    @abstractmethod
    def conclude_readings(
        self, rows: list[list[Reading]], points: list[dict[str, Any]]
    ) -> Measurement:
        """What the readings at the points come to."""

    def planned(self) -> int:
        """Frames of the plan."""
        return super().planned() + self.count() * self.spec.average

    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """See `Method`. Raises Unsuitable for a point that the projector's code does not reach."""
        if index < len(self._plan):
            return self._plan[index]
        number = index - len(self._plan)
        if number >= self.count():
            return None
        lost = [spot for spot in self._spots if f"lost {spot.name}" in summary]
        if lost or "x0" not in summary:
            named = ", ".join(f"{s.name} ({s.x}, {s.y})" for s in lost or self._spots)
            raise Unsuitable(
                f"the projector's pixel at {named} cannot be told: the point lies in shadow, on a "
                "mirror or at an edge; choose another one nearby (--point)",
                "$.points",
            )
        points = tuple(
            (round(summary[f"x{k}"]), round(summary[f"y{k}"])) for k in range(len(self._spots))
        )
        return Expose(
            self.pattern(number, points), index=len(self._images) + number, frames=self.spec.average
        )

    def estimator(self) -> PointReadings:
        """See `Method`."""
        projector = self.projector()
        calibration = self.bench.calibration or {}
        leakage = self.spec.leakage
        if leakage is None and "leakage" in calibration:
            leakage = leakage_of(Radiometry(), self.bench)
        return PointReadings(
            self.response,
            self._spots,
            self._images,
            Source(
                projector.width,
                projector.height,
                leakage,
                float(calibration.get("blur_px", 0.0)),
            ),
            self.count(),
            self.pattern,
            self.conclude_readings,
        )


def _spots(spec: Verification, bench: Bench) -> list[Spot]:
    """The points of interest. Raises Unsuitable."""
    if not spec.points:
        raise Unsuitable(
            "name at least one point of interest in camera pixels (--point 320,240; "
            "`umbra preview` shows the picture)",
            "$.points",
        )
    spots = []
    for letter, point in zip(ascii_uppercase, spec.points, strict=False):
        name, x, y = point.name or letter, round(point.x), round(point.y)
        inside = (
            REACH <= x < bench.camera.width - REACH and REACH <= y < bench.camera.height - REACH
        )
        if not inside:
            raise Unsuitable(
                f"the point {name} ({x}, {y}) must be {REACH} pixels within the camera's "
                f"{bench.camera.width} x {bench.camera.height}",
                "$.points",
            )
        spots.append(Spot(name, x, y))
    if len({spot.name for spot in spots}) < len(spots):
        raise Unsuitable("each point needs a name of its own", "$.points")
    return spots
