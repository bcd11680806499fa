"""How much later than the driver says the projector's light changes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Digest, Expose, Step
from daemon.scans.parameters import exposure_of
from daemon.separation.estimator import Lighting
from daemon.separation.latency import Latency
from protocol.patterns import BLACK, WHITE
from protocol.scans.calibrations import CalibrateLatency

_GOLDEN = 0.6180339887


class LatencyMethod(MeasuringMethod[CalibrateLatency]):
    """Settled black and white; then flashes from black to white with triggers at many delays.

    The first half of the flashes is spread over all delays; the second, when it is known roughly
    where the light changes, over the exposures that see the change.
    """

    name: ClassVar[str] = "calibrate-latency"
    looked_at: ClassVar[bool] = False

    def __init__(self, spec: CalibrateLatency, bench: Bench) -> None:
        super().__init__(spec, bench)
        self.projector()
        self._exposure_s = exposure_of(spec.exposure_us, bench) / 1e6
        self._longest_s = spec.longest_ms / 1e3
        self._coarse = spec.flashes // 2
        # 0 black, 1 white, then a flash is two steps; one Digest between the two halves.
        self._digest = 2 + 2 * self._coarse
        self._end = self._digest + 1 + 2 * (spec.flashes - self._coarse)

    def planned(self) -> int:
        """Two frames a flash, and the references."""
        return 2 + 2 * self.spec.flashes

    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """See `Method`."""
        settle = self._longest_s
        if index >= self._end:
            return None
        if index < 2:
            shown = ((BLACK, Lighting.BLACK), (WHITE, Lighting.WHITE))[index]
            return Expose(shown[0], shown[1], delay_s=settle)
        if index == self._digest:
            return Digest()
        flash, lit = divmod(index - 2 - (index > self._digest), 2)
        if not lit:
            return Expose(BLACK, index=2 * flash, delay_s=settle)
        return Expose(WHITE, index=2 * flash + 1, delay_s=self._delay(flash, summary))

    def _delay(self, flash: int, summary: Mapping[str, float]) -> float:
        if flash < self._coarse:
            return self._longest_s * flash / self._coarse
        known = summary.get("latency_us", math.nan) / 1e6
        # Spread without a step in common with a refresh: by the golden section.
        part = (flash * _GOLDEN) % 1.0
        if math.isnan(known):
            return self._longest_s * part
        return max(0.0, known - 0.95 * self._exposure_s + 0.9 * self._exposure_s * part)

    def estimator(self) -> Latency:
        """See `Method`."""
        return Latency(self.response, self.spec.longest_ms * 1e3)
