"""What all runs that measure share: a live camera, a plan, frames used as they come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

from daemon.scans.method import Bench, Expose, Method, Step, Taken, Unsuitable
from daemon.separation.estimator import Observation
from drivers.base.projector import ProjectorInfo
from protocol.scans.measuring import Measuring

M = TypeVar("M", bound=Measuring)


class MeasuringMethod(Method[M]):
    """A fixed plan; a subclass calls `_go` with it. An incomplete frame is not used."""

    def __init__(self, spec: M, bench: Bench) -> None:
        super().__init__(spec, bench)
        if bench.camera.recorded:
            raise Unsuitable(f"{self.name} measures a rig: a recorded camera has none")
        self._plan: Sequence[Step] = ()

    def _projector(self) -> ProjectorInfo:
        """The projector. Raises Unsuitable where there is none."""
        if self.bench.projector is None:
            raise Unsuitable(
                f"{self.name} needs a projector, and this rig has none: name one under "
                "[projector] in rig.toml"
            )
        return self.bench.projector

    def planned(self) -> int | None:
        """Frames of the whole plan."""
        return sum(step.frames for step in self._plan if isinstance(step, Expose))

    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """See `Method`."""
        del summary  # the plan is fixed
        return self._plan[index] if index < len(self._plan) else None

    def observe(self, step: Step, taken: Taken) -> Observation:
        """See `Method`."""
        if not isinstance(step, Expose):
            raise TypeError(f"{self.name} plans no step {step!r}")
        return Observation(
            lighting=step.lighting,
            pattern=step.index,
            last=taken.sub == step.frames - 1,
            used=not taken.incomplete,
            reason="incomplete frame" if taken.incomplete else "",
            delay_us=taken.delay_us,
            exposure_us=taken.exposure_us,
        )
