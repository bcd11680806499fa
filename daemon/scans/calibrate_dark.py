"""Black level, read noise, hot pixels."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Expose, Unsuitable
from daemon.scans.parameters import exposure_of
from daemon.separation.dark import Dark
from daemon.separation.estimator import Lighting
from protocol.scans.calibrations import CalibrateDark


class DarkMethod(MeasuringMethod[CalibrateDark]):
    """All sources off, the exposure doubled from step to step up to the run's own."""

    name: ClassVar[str] = "calibrate-dark"
    looked_at: ClassVar[bool] = False

    def __init__(self, spec: CalibrateDark, bench: Bench) -> None:
        super().__init__(spec, bench)
        longest = exposure_of(spec.exposure_us, bench)
        shortest = bench.camera.exposure_range_us[0]
        times = [longest / 2**n for n in reversed(range(spec.exposures))]
        times = [time for time in times if time >= shortest]
        if len(times) < 2:
            raise Unsuitable(
                f"an exposure of {longest:g} µs leaves no shorter ones (the camera's shortest is "
                f"{shortest:g} µs): expose longer (--exposure)",
                "$.exposure_us",
            )
        self._plan = [
            Expose(None, Lighting.AMBIENT, index, spec.frames, exposure_us=time)
            for index, time in enumerate(times)
        ]

    def estimator(self) -> Dark:
        """See `Method`."""
        pixel_format = self.bench.camera.pixel_format
        return Dark(pixel_format.full_scale, len(self._plan), pixel_format.bayer)
