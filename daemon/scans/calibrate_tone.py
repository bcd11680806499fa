"""The projector's response to its levels."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Expose
from daemon.scans.planned import exposures
from daemon.separation.estimator import Lighting
from daemon.separation.tone_curve import ToneCurve
from protocol.patterns import BLACK, WHITE, Solid
from protocol.scans.calibrations import CalibrateTone


class ToneMethod(MeasuringMethod[CalibrateTone]):
    """White and black, the levels between them, and white again."""

    name: ClassVar[str] = "calibrate-tone"
    looked_at: ClassVar[bool] = False

    def __init__(self, spec: CalibrateTone, bench: Bench) -> None:
        super().__init__(spec, bench)
        self.projector()
        steps = spec.levels - 1
        # As they are shown: rounded to the projector's 256 levels.
        inner = {round(255 * k / steps) / 255 for k in range(1, steps)}
        self._levels = (*sorted(inner), 1.0)
        self._plan = [
            Expose(WHITE, Lighting.WHITE, frames=2 * spec.average),
            Expose(BLACK, Lighting.BLACK, frames=2 * spec.average),
            *exposures((Solid(level=level) for level in self._levels), spec.average),
        ]

    def estimator(self) -> ToneCurve:
        """See `Method`."""
        return ToneCurve(self.response, self._levels)
