"""A thin occluder swept over the scene on video (§4.2)."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.method import Bench, Sweep, Unsuitable
from daemon.scans.occluder import OccluderMethod
from daemon.separation.coverage import Occluder
from daemon.separation.estimator import Estimator
from daemon.separation.steadied import Steadied
from drivers.base.stage import StageInfo
from protocol.patterns import Axis
from protocol.scans.occluded import Stick

_SWEEP_S = 10.0  # of a sweep, where no feed is told


class StickMethod(OccluderMethod[Stick]):
    """Watch the scene while a stick's shadow is swept over it: by the stage if the rig has one,
    else by hand; then no device but the camera is needed."""

    name: ClassVar[str] = "stick"

    def __init__(self, spec: Stick, bench: Bench) -> None:
        live = not bench.camera.recorded
        motion = _sweep(spec, bench.stage) if live and bench.stage is not None else None
        super().__init__(spec, bench, motion)
        if live and motion is None and spec.frames is None:
            raise Unsuitable(
                "a live camera has no end: say how many frames to watch (--frames)", "$.frames"
            )

    def estimator(self) -> Estimator:
        """See `Method`."""
        return Steadied(
            self.response,
            lambda: Occluder(
                self.response,
                lit_fraction=self.spec.lit_fraction,
                averaged=self.spec.estimator == "auto",
            ),
            few=True,
        )


def _sweep(spec: Stick, stage: StageInfo) -> Sweep:
    """To and fro along one axis, in the middle of the other. Raises Unsuitable."""
    along = 0 if spec.axis is Axis.X else 1
    travel, across = stage.travel_mm[along], stage.travel_mm[1 - along]
    start, end = spec.sweep_mm or travel
    if not (travel[0] <= min(start, end) < max(start, end) <= travel[1]):
        raise Unsuitable(
            f"a sweep from {start:g} to {end:g} mm leaves the stage's travel of {travel[0]:g} to "
            f"{travel[1]:g} mm (--sweep-mm)",
            "$.sweep_mm",
        )
    middle = (across[0] + across[1]) / 2.0
    ends = [(start, middle), (end, middle)]
    if along == 1:
        ends = [(y, x) for x, y in ends]
    points = tuple(ends[n % 2] for n in range(spec.sweeps + 1))
    feed = spec.feed_mm_s or abs(end - start) / _SWEEP_S
    return Sweep(points, min(feed, stage.max_feed_mm_s))
