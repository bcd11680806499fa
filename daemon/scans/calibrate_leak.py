"""The projector's leakage, over the whole picture and of patches of several sizes (§3.5)."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Unsuitable
from daemon.scans.planned import exposures, source_references
from daemon.separation.leak import Leak
from protocol.patterns import Checker
from protocol.scans.calibrations import CalibrateLeak


class LeakMethod(MeasuringMethod[CalibrateLeak]):
    """Source off, black, white; then checkers, the largest first, so shifted that each camera
    pixel comes near the middle of a lit and of an unlit one."""

    name: ClassVar[str] = "calibrate-leak"
    looked_at: ClassVar[bool] = False  # the finest checkers look alike, by design

    def __init__(self, spec: CalibrateLeak, bench: Bench) -> None:
        super().__init__(spec, bench)
        projector = self.projector()
        self._sizes = tuple(sorted(set(spec.sizes), reverse=True))
        if len(self._sizes) < 2:
            raise Unsuitable("two sizes are needed, the larger is the reference", "$.sizes")
        if 2 * self._sizes[0] > min(projector.width, projector.height):
            raise Unsuitable(
                f"patches of {self._sizes[0]} px are too large for the projector's "
                f"{projector.width} x {projector.height}",
                "$.sizes",
            )
        self._sets = [checkers(size) for size in self._sizes]
        patterns = [pattern for one in self._sets for pattern in one]
        self._plan = [*source_references(4 * spec.average), *exposures(patterns, spec.average)]

    def estimator(self) -> Leak:
        """See `Method`."""
        images = tuple(len(one) for one in self._sets)
        return Leak(self.response, self._sizes, images)


def checkers(size: int) -> list[Checker]:
    """Checkers of a size and their complements, at shifts of a quarter of a checker each way."""
    shifts = range(0, size, max(1, size // 4))
    return [
        Checker(size=size, shift_x=x, shift_y=y, inverted=inverted)
        for y in shifts
        for x in shifts
        for inverted in (False, True)
    ]
