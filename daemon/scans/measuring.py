"""What all runs that measure share: a live camera, a plan, frames used as they come."""

from __future__ import annotations

from typing import TypeVar

from daemon.scans.method import INCOMPLETE, Bench, Expose, Step, Taken, Unsuitable
from daemon.scans.parameters import response_of
from daemon.scans.planned import PlannedMethod
from daemon.separation.estimator import Observation
from daemon.separation.radiometry import Response
from protocol.scans.measuring import Measuring
from protocol.scans.spec import Radiometry

M = TypeVar("M", bound=Measuring)


class MeasuringMethod(PlannedMethod[M]):
    """A fixed plan on a live camera. An incomplete frame is not used."""

    def __init__(self, spec: M, bench: Bench) -> None:
        super().__init__(spec, bench)
        if bench.camera.recorded:
            raise Unsuitable(f"{self.name} measures a rig: a recorded camera has none")

    @property
    def response(self) -> Response:
        """How the camera's counts follow from light, as calibrated. Raises Unsuitable."""
        return response_of(Radiometry(), self.bench)

    def observe(self, step: Step, taken: Taken) -> Observation:
        """See `Method`."""
        if not isinstance(step, Expose):
            raise TypeError(f"{self.name} plans no step {step!r}")
        return Observation(
            lighting=step.lighting,
            pattern=step.index,
            last=taken.sub == step.frames - 1,
            used=not taken.incomplete,
            reason=INCOMPLETE if taken.incomplete else "",
            delay_us=taken.delay_us,
            exposure_us=taken.exposure_us,
        )
