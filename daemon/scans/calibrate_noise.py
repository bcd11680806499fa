"""Gain and noise of the camera by photon transfer."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.measuring import MeasuringMethod
from daemon.scans.method import Bench, Expose
from daemon.scans.parameters import exposure_of
from daemon.separation.estimator import Lighting
from daemon.separation.transfer import PhotonTransfer
from protocol.patterns import WHITE
from protocol.scans.calibrations import CalibrateNoise


class NoiseMethod(MeasuringMethod[CalibrateNoise]):
    """At several exposures a frame to sort by and pairs, under white or what light there is."""

    name: ClassVar[str] = "calibrate-noise"
    looked_at: ClassVar[bool] = False

    def __init__(self, spec: CalibrateNoise, bench: Bench) -> None:
        super().__init__(spec, bench)
        longest = exposure_of(spec.exposure_us, bench)
        shortest = bench.camera.exposure_range_us[0]
        times = [longest * (n + 1) / spec.exposures for n in range(spec.exposures)]
        self._plan = [
            Expose(
                WHITE, Lighting.PATTERN, index, 1 + 2 * spec.pairs, exposure_us=max(time, shortest)
            )
            for index, time in enumerate(times)
        ]

    def estimator(self) -> PhotonTransfer:
        """See `Method`."""
        return PhotonTransfer(self.response)
