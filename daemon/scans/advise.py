"""Advice on pattern, images and exposure from a short sweep of checker sizes (Appendix A)."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Unsuitable
from daemon.scans.parameters import exposure_of, leakage_of
from daemon.scans.planned import exposures, source_references
from daemon.separation.advice import Advice, Situation
from daemon.separation.exposure import Settings
from protocol.patterns import Checker
from protocol.scans.measuring import Advise
from protocol.scans.spec import Radiometry


class AdviseMethod(MeasuringMethod[Advise]):
    """Source off, black, white; then checkers of each size at half-checker shifts, and their
    complements."""

    name: ClassVar[str] = "advise"
    looked_at: ClassVar[bool] = False  # the finest checkers look alike, by design

    def __init__(self, spec: Advise, bench: Bench) -> None:
        super().__init__(spec, bench)
        projector = self.projector()
        self._sizes = tuple(sorted(set(spec.sizes)))
        if len(self._sizes) < 2 or 2 * self._sizes[-1] > min(projector.width, projector.height):
            raise Unsuitable(
                "two sizes at least are needed, and the largest at most half of the projector's "
                f"{projector.width} x {projector.height}",
                "$.sizes",
            )
        patterns = [pattern for size in self._sizes for pattern in _sweep(size)]
        self._images = tuple(len(_sweep(size)) for size in self._sizes)
        self._plan = [*source_references(4 * spec.average), *exposures(patterns, spec.average)]

    def estimator(self) -> Advice:
        """See `Method`."""
        projector, camera = self.projector(), self.bench.camera
        return Advice(
            self.response,
            self._sizes,
            self._images,
            Situation(
                error=self.spec.error,
                settings=Settings(
                    exposure_us=exposure_of(self.spec.exposure_us, self.bench),
                    exposure_range_us=camera.exposure_range_us,
                    refresh_hz=projector.refresh_hz,
                    gain=self.bench.gain if self.spec.gain is None else self.spec.gain,
                    gain_range=camera.gain_range,
                    gain_unit=camera.gain_unit,
                ),
                leakage=leakage_of(Radiometry(), self.bench),
                known=frozenset(self.bench.calibration or {}),
            ),
        )


def _sweep(size: int) -> list[Checker]:
    return [
        Checker(size=size, shift_x=x, shift_y=y, inverted=inverted)
        for y in sorted({0, size // 2})
        for x in sorted({0, size // 2})
        for inverted in (False, True)
    ]
