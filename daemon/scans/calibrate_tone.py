"""The projector's response to its levels."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Expose
from daemon.scans.pattern_scan import response_of
from daemon.separation.estimator import Lighting
from daemon.separation.tone_curve import ToneCurve
from protocol.patterns import BLACK, WHITE, Solid
from protocol.scans.calibrations import CalibrateTone
from protocol.scans.spec import Radiometry


class ToneMethod(MeasuringMethod[CalibrateTone]):
    """White and black, the levels between them, and white again."""

    name: ClassVar[str] = "calibrate-tone"
    looked_at: ClassVar[bool] = False

    def __init__(self, spec: CalibrateTone, bench: Bench) -> None:
        super().__init__(spec, bench)
        self._projector()
        steps = spec.levels - 1
        # As they are shown: rounded to the projector's 256 levels.
        inner = {round(255 * k / steps) / 255 for k in range(1, steps)}
        self._levels = (*sorted(inner), 1.0)
        self._plan = [
            Expose(WHITE, Lighting.WHITE, frames=2 * spec.average),
            Expose(BLACK, Lighting.BLACK, frames=2 * spec.average),
            *(
                Expose(Solid(level=level), Lighting.PATTERN, index, spec.average)
                for index, level in enumerate(self._levels)
            ),
        ]

    def estimator(self) -> ToneCurve:
        """See `Method`."""
        return ToneCurve(response_of(Radiometry(), self.bench), self._levels)
