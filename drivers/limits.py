"""What a stage is asked to do against what it can do, before anything is sent."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.base.errors import OutOfRange
from drivers.base.stage import StageInfo
from drivers.track import Arc

Range = tuple[float, float]

NEAR_MM = 0.05
"""A circle or a point this near to the only circle that a stage goes round is on it."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Each check raises OutOfRange, which names what was asked, the limit, and the remedy."""

    device: str
    info: StageInfo

    def check_feed(self, phase: str, feed: float) -> None:
        """`feed` in mm/s."""
        most = self.info.max_feed_mm_s
        if not 0 < feed <= most * (1 + 1e-9):
            raise OutOfRange(
                self.device, phase, f"a feed of {feed:g} mm/s", f"it takes up to {most:g} mm/s"
            )

    def check_box(self, phase: str, x: Range, y: Range) -> None:
        """That all of it is within the travel; names the axis, the value and the limit."""
        for axis, box, travel in zip("xy", (x, y), self.info.travel_mm, strict=True):
            for value in box:
                if not travel[0] <= value <= travel[1]:  # false for nan too
                    raise OutOfRange(
                        self.device,
                        phase,
                        f"{axis} = {value:g} mm is outside {travel[0]:g} to {travel[1]:g} mm, its "
                        "travel",
                        "nothing was sent; aim within the travel",
                    )

    def check_circle(self, phase: str, arc: Arc, turns: float) -> None:
        """The whole circle, however little of it is gone round."""
        (x, y), r = arc.centre, arc.radius
        if not (math.isfinite(r) and r > 0):
            raise OutOfRange(self.device, phase, f"its radius is {r} mm", "above 0")
        if not turns > 0:
            raise OutOfRange(self.device, phase, f"{turns} turns were asked", "above 0")
        if self.info.only_circle_mm is None:
            self.check_box(phase, (x - r, x + r), (y - r, y + r))
            return
        own, turned = self.info.only_circle_mm
        if not (abs(r - turned) <= NEAR_MM and math.dist(arc.centre, own) <= NEAR_MM):
            raise OutOfRange(
                self.device,
                phase,
                f"a circle of {r:g} mm about ({x:g}, {y:g})",
                f"it goes round {turned:g} mm about ({own[0]:g}, {own[1]:g}) only",
            )
