"""Scans on video while an occluder moves before a source without pixels (§4.2)."""

from __future__ import annotations

import enum
from typing import Annotated, Literal

from msgspec import Meta

from protocol.patterns import Axis
from protocol.scans.spec import ESTIMATOR, Count, LitFraction, Positive, Scan

SUN_DEG = 0.53  # angular diameter


class Grid(enum.StrEnum):
    """How a mesh's holes lie."""

    SQUARE = "square"
    HEXAGONAL = "hexagonal"


class OccluderScan(Scan, frozen=True, kw_only=True):
    """A scan on video while an occluder moves between the scene and a source that has no pixels.

    It ends at the coverage wanted or at the time limit, whichever comes first.
    """

    frames: Annotated[Count, Meta(description="frames to take at most")] | None = None
    coverage: Annotated[
        float,
        Meta(gt=0.0, le=1.0, description="share of the lit pixels that ends the scan when covered"),
    ] = 0.995
    time_limit_s: Annotated[Positive, Meta(description="seconds after which it ends anyway")] = (
        600.0
    )
    sun: Annotated[
        bool, Meta(description="the source drifts and clouds pass: follow its strength")
    ] = False
    align: Annotated[
        bool, Meta(description="find the camera's shake, and align or reject what it moved")
    ] = True
    drift_deg: Annotated[
        Positive,
        Meta(description="how far the sun may have gone when an interrupted scan is resumed"),
    ] = 1.0
    #: None: all of the rig
    lights: Annotated[tuple[str, ...], Meta(description="sources to switch on, by name")] | None = (
        None
    )
    frame_rate_hz: Annotated[Positive, Meta(description="of the camera")] | None = None
    feed_mm_s: Annotated[Positive, Meta(description="speed of the stage")] | None = None
    scene_mm: (
        Annotated[
            float, Meta(ge=0.0, description="from the occluder to the scene, for the penumbra")
        ]
        | None
    ) = None
    source_deg: Annotated[
        float, Meta(ge=0.0, lt=90.0, description="angular diameter of the source; sun 0.53")
    ] = SUN_DEG


class Stick(OccluderScan, frozen=True, kw_only=True, tag="stick"):
    """A thin occluder swept over the scene on video (§4.2): α is close to 1, b = 0 in the umbra.

    Swept by the rig's stage if it has one, else by hand.
    """

    lit_fraction: LitFraction = 1.0
    estimator: Annotated[Literal["auto", "maxmin"], Meta(description=ESTIMATOR)] = "auto"
    axis: Annotated[Axis, Meta(description="axis of the stage along which the stick moves")] = (
        Axis.X
    )
    sweeps: Annotated[int, Meta(ge=1, le=1000, description="sweeps of the stage, to and fro")] = 2
    #: None: the stage's whole travel
    sweep_mm: (
        Annotated[tuple[float, float], Meta(description="from where to where on that axis, mm")]
        | None
    ) = None
    width_mm: Annotated[Positive, Meta(description="of the stick, for the penumbra")] | None = None


class Mesh(OccluderScan, frozen=True, kw_only=True, tag="mesh"):
    """A grid of holes on a small circle, on video (§4.2): α is the hole fraction β, b = 0 in the
    umbra. β is told, or follows from the mesh's holes and pitch, or is measured by how much of the
    time places are lit.
    """

    hole_fraction: (
        Annotated[float, Meta(gt=0.0, lt=1.0, description="β, the part of the mesh that is hole")]
        | None
    ) = None
    hole_mm: Annotated[Positive, Meta(description="diameter of a hole")] | None = None
    pitch_mm: Annotated[Positive, Meta(description="from hole to hole")] | None = None
    grid: Annotated[Grid, Meta(description="how the holes lie")] = Grid.SQUARE
    radius_mm: Annotated[Positive, Meta(description="of the circle")] | None = None  # None: best
    centre_mm: (
        Annotated[tuple[float, float], Meta(description="of the circle on the stage")] | None
    ) = None  # None: the middle of the travel
    estimator: Annotated[Literal["auto", "maxmin"], Meta(description=ESTIMATOR)] = "auto"
