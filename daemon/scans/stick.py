"""A thin occluder swept over the scene on video (§4.2)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

from daemon.scans.method import Bench, Sweep, Unsuitable
from daemon.scans.occluder import OccluderMethod
from daemon.separation.coverage import Occluder
from daemon.separation.estimator import Components, Estimator
from daemon.separation.steadied import Steadied
from drivers.base.stage import StageInfo
from protocol.patterns import Axis
from protocol.penumbra import beside_a_stick, penumbra_mm
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

    def conclude(self, components: Components) -> Components:
        """See `Method`: with what geometry says of the umbra."""
        components = super().conclude(components)
        umbra, advice = _umbra(self.spec)
        advice = [*components.facts.get("advice", []), *advice]
        return replace(components, facts={**components.facts, **umbra, "advice": advice})


def _umbra(spec: Stick) -> tuple[dict[str, Any], list[str]]:
    """Facts of the darkest shadow that the stick can cast, and advice where it is no umbra."""
    if spec.width_mm is None or spec.scene_mm is None:
        told = "not known: say the stick's width and its distance to the scene"
        return {"leakage_from": f"{told} (--width-mm, --scene-mm)"}, []
    penumbra = penumbra_mm(spec.scene_mm, source_deg=spec.source_deg)
    leak = beside_a_stick(spec.width_mm, penumbra)
    facts = {
        "penumbra_mm": round(penumbra, 3),
        "leakage_at_most": round(leak, 4),
        "leakage_from": "the stick's geometry",
    }
    if leak == 0.0:
        return facts, []
    return facts, [
        f"{leak:.0%} of the source still shines past the stick, which is {spec.width_mm:g} mm wide "
        f"in a penumbra of {penumbra:.2g} mm: that part of direct counts as global; take a wider "
        "stick, or hold it nearer to the scene"
    ]


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
