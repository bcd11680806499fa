"""A mesh that goes round in small circles between the source and the scene (§4.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

from daemon.scans.method import Bench, Circle, Unsuitable
from daemon.scans.occluder import OccluderMethod
from daemon.separation.estimator import Components, Estimator
from daemon.separation.mesh import MeshOccluder
from daemon.separation.steadied import Steadied
from protocol import mesh as geometry
from protocol.penumbra import penumbra_mm
from protocol.scans.occluded import Mesh
from protocol.scans.spec import Reference

_RATE_HZ = 30.0  # where neither the scan nor the camera says
_EXPOSURE_S = 0.01


class MeshMethod(OccluderMethod[Mesh]):
    """Circles until every lit pixel was in full light and in the umbra.

    Where the mesh's geometry is known, radius and feed are planned from it, and a request that
    does worse is done all the same, with `warnings`; `least` is the part of a turn that the circle
    has every point, at least, in full light, and in the umbra (None: not known, or none).
    """

    name: ClassVar[str] = "mesh"
    allowed: Mapping[Reference, str] = {
        Reference.AMBIENT: "the source off",
        Reference.OPEN: "no mesh before the source",
    }

    def __init__(self, spec: Mesh, bench: Bench) -> None:
        self.warnings: tuple[str, ...] = ()
        self._umbra: dict[str, Any] = {
            "leakage_from": "not known: say the mesh's holes and pitch and its distance to the "
            "scene (--hole-mm, --pitch-mm, --scene-mm)"
        }
        self._mesh = _mesh_of(spec)
        self.least: float | None = None
        wanted = spec.references or ()
        live = not bench.camera.recorded
        if live and Reference.OPEN in wanted:
            raise Unsuitable(
                "a rig cannot take the mesh away: an open frame goes with recordings "
                "(umbra separate --open-frame)",
                "$.references",
            )
        self.hole_fraction = spec.hole_fraction
        if self.hole_fraction is None and self._mesh is not None:
            self.hole_fraction = self._mesh.hole_fraction
        if self._mesh is not None and spec.radius_mm is not None:
            self._serve(geometry.circle(self._mesh, spec.radius_mm, _penumbra(spec)))
        super().__init__(spec, bench, self._circle(spec, bench) if live else None)

    def _serve(self, circle: geometry.Circle) -> None:
        self.least = min(circle.lit, circle.unlit) or None

    def _circle(self, spec: Mesh, bench: Bench) -> Circle:
        """The motion: as asked for, else as planned."""
        stage = bench.stage
        if stage is None:
            raise Unsuitable(
                "mesh needs a stage to move it, and this rig has none: name one under [stage] in "
                "rig.toml"
            )
        (x0, x1), (y0, y1) = stage.travel_mm
        centre = spec.centre_mm or ((x0 + x1) / 2.0, (y0 + y1) / 2.0)
        radius, feed = spec.radius_mm, spec.feed_mm_s
        if stage.only_circle_mm is not None:
            own, turned = stage.only_circle_mm
            centre, radius = spec.centre_mm or own, radius or turned
        if self._mesh is not None:
            radius, feed = self._planned(self._mesh, spec, bench, radius)
        if radius is None:
            raise Unsuitable(
                "say the circle's radius (--radius-mm), or the mesh's holes and pitch (--hole-mm, "
                "--pitch-mm) to have it planned",
                "$.radius_mm",
            )
        feed = feed or math.tau * radius / 4.0  # a turn in four seconds
        for axis, low, high, at in (("x", x0, x1, centre[0]), ("y", y0, y1, centre[1])):
            if not low <= at - radius <= at + radius <= high:
                raise Unsuitable(
                    f"a circle of {radius:.3g} mm round {axis} = {at:g} leaves the stage's travel "
                    f"of {low:g} to {high:g} mm (--centre-mm, --radius-mm)",
                    "$.centre_mm",
                )
        return Circle(centre, radius, min(feed, stage.max_feed_mm_s))

    def _planned(
        self, mesh: geometry.Mesh, spec: Mesh, bench: Bench, wanted_mm: float | None
    ) -> tuple[float, float]:
        """Radius and feed: the spec's with warnings where the geometry says worse, else the best.

        Raises Unsuitable where no circle covers every point.
        """
        assert bench.stage is not None
        penumbra = _penumbra(spec)
        rate = spec.frame_rate_hz or min(bench.camera.max_rate_hz or _RATE_HZ, _RATE_HZ)
        exposure_us = spec.exposure_us or bench.exposure_us
        exposure = exposure_us * 1e-6 if exposure_us else min(_EXPOSURE_S, 1.0 / rate)
        try:
            best = geometry.plan(
                mesh,
                penumbra=penumbra,
                exposure_s=exposure,
                frame_rate_hz=rate,
                max_feed_mm_s=bench.stage.max_feed_mm_s,
            )
        except ValueError as error:
            raise Unsuitable(str(error), "$.pitch_mm") from error
        radius = wanted_mm or best.circle.radius_mm
        asked = geometry.circle(mesh, radius, penumbra)
        self._serve(asked)
        warnings = []
        for part, what in ((asked.lit, "in full light"), (asked.unlit, "in the umbra")):
            if part == 0.0:
                warnings.append(
                    f"a circle of {radius:.3g} mm leaves points that are never {what}; "
                    f"{best.circle.radius_mm:.3g} mm leaves none"
                )
        if asked.leak > 0.0:
            warnings.append(f"up to {asked.leak:.0%} of the source still reaches the umbra")
        if spec.scene_mm is not None:
            self._umbra = {
                "penumbra_mm": round(penumbra, 3),
                "leakage_at_most": round(asked.leak, 4),
                "leakage_from": "the mesh's geometry",
            }
        feed = spec.feed_mm_s or best.feed_mm_s * radius / best.circle.radius_mm
        if feed > 2.0 * best.feed_mm_s * radius / best.circle.radius_mm:
            warnings.append(
                f"at {feed:.3g} mm/s the mesh goes {feed * exposure:.2g} mm in an exposure, or too "
                f"few frames see a point in light; {best.feed_mm_s:.3g} mm/s is planned"
            )
        self.warnings = tuple(warnings)
        return radius, feed

    def estimator(self) -> Estimator:
        """See `Method`."""
        return Steadied(
            self.response,
            lambda: MeshOccluder(
                self.response,
                hole_fraction=self.hole_fraction,
                averaged=self.spec.estimator == "auto",
                least=self.least,
            ),
        )

    def uncovered(self) -> str:
        """See `OccluderMethod`."""
        if self.least is None:
            return super().uncovered()
        return (
            "by the mesh's geometry this circle lights and shades every point for "
            f"{self.least:.0%} of a turn at least: what is left changes little by little, as "
            "mirrors and translucent things do, or the mesh's shadow does not reach it"
        )

    def conclude(self, components: Components) -> Components:
        """See `Method`: with what geometry says of the umbra, and the warnings, among the facts."""
        components = super().conclude(components)
        facts = {**components.facts, **self._umbra}
        if self.warnings:
            facts["warnings"] = list(self.warnings)
        return replace(components, facts=facts)


def _penumbra(spec: Mesh) -> float:
    return penumbra_mm(spec.scene_mm or 0.0, source_deg=spec.source_deg)


def _mesh_of(spec: Mesh) -> geometry.Mesh | None:
    """The mesh, where its geometry is told. Raises Unsuitable."""
    if spec.hole_mm is None and spec.pitch_mm is None:
        return None
    if spec.hole_mm is None or spec.pitch_mm is None:
        raise Unsuitable("holes and pitch go together (--hole-mm, --pitch-mm)", "$.pitch_mm")
    try:
        return geometry.Mesh(spec.hole_mm, spec.pitch_mm, spec.grid)
    except ValueError as error:
        raise Unsuitable(str(error), "$.pitch_mm") from error
