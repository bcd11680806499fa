"""The geometry of a mesh that goes round in a circle: which radius lights and shades every point.

Lengths are in mm in the mesh's own plane. A source of a size makes a penumbra: within half its
width of a hole's rim a point is neither in full light nor in the umbra.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from protocol.scans.occluded import Grid

_POINTS = 20  # of a unit cell, along the pitch
_ANGLES = 240
_RADII = np.arange(0.05, 1.5001, 0.025)  # of the pitch
_NEAR_BEST = 0.75
_BLUR = 0.05  # of a hole's diameter that the mesh may go in an exposure
_SAMPLES = 3  # frames that each point shall have in full light, and in the umbra
_FEWEST = 24  # frames of a turn


@dataclass(frozen=True)
class Mesh:
    """Round holes of a diameter, at a pitch from hole to hole."""

    hole_mm: float
    pitch_mm: float
    grid: Grid = Grid.SQUARE

    def __post_init__(self) -> None:
        if not 0.0 < self.hole_mm < self.pitch_mm:
            raise ValueError(
                f"holes of {self.hole_mm:g} mm at a pitch of {self.pitch_mm:g} mm run into each "
                "other: the pitch is from the middle of a hole to the next one's"
            )

    @property
    def cell_mm(self) -> tuple[float, float]:
        """Width and height of the rectangle that repeats."""
        tall = math.sqrt(3.0) if self.grid is Grid.HEXAGONAL else 1.0
        return self.pitch_mm, self.pitch_mm * tall

    @property
    def hole_fraction(self) -> float:
        """β, the part of the mesh that is hole (§4.2)."""
        holes = 2 if self.grid is Grid.HEXAGONAL else 1
        width, height = self.cell_mm
        return holes * math.pi * (self.hole_mm / 2.0) ** 2 / (width * height)

    def clearance(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance in mm to the nearest rim: positive within a hole."""
        width, height = self.cell_mm
        middles = [(0.0, 0.0)]
        if self.grid is Grid.HEXAGONAL:
            middles.append((width / 2.0, height / 2.0))
        away = [
            np.hypot(
                (x - u + width / 2.0) % width - width / 2.0,
                (y - v + height / 2.0) % height - height / 2.0,
            )
            for u, v in middles
        ]
        nearest: NDArray[np.float64] = np.minimum.reduce(away)
        return self.hole_mm / 2.0 - nearest


@dataclass(frozen=True)
class Circle:
    """What a circle does for the point that it serves worst.

    `lit` and `unlit`: parts of a turn in full light and in the umbra, of the point with least.
    `leak`: the part of the source that the darkest place still sees, of the point where it is most
    (a bound on b; 0 where every point reaches the umbra).
    """

    radius_mm: float
    lit: float
    unlit: float
    leak: float

    @property
    def covers(self) -> bool:
        """Whether each point is in full light at some time, and in the umbra at another."""
        return self.lit > 0.0 and self.unlit > 0.0


@dataclass(frozen=True)
class Plan:
    """A scan that covers every point, and what it costs."""

    mesh: Mesh
    circle: Circle
    penumbra_mm: float
    feed_mm_s: float
    frame_rate_hz: float
    frames_a_turn: int
    turn_s: float
    blur_mm: float  # way of the mesh in an exposure


@lru_cache(maxsize=512)
def circle(mesh: Mesh, radius_mm: float, penumbra: float = 0.0) -> Circle:
    """What a circle of a radius does for the worst of all points of a unit cell."""
    width, height = mesh.cell_mm
    rows = round(_POINTS * height / width)
    x, y = np.meshgrid(
        (np.arange(_POINTS) + 0.5) / _POINTS * width, (np.arange(rows) + 0.5) / rows * height
    )
    angle = np.arange(_ANGLES) / _ANGLES * math.tau
    clear = mesh.clearance(
        x[..., None] + radius_mm * np.cos(angle), y[..., None] + radius_mm * np.sin(angle)
    )
    half = penumbra / 2.0
    deepest = -clear.min(axis=-1)
    leak = np.clip(0.5 - deepest / max(penumbra, 1e-9), 0.0, 1.0) if penumbra > 0 else deepest < 0
    return Circle(
        radius_mm,
        float((clear >= half).mean(axis=-1).min()),
        float((clear <= -half).mean(axis=-1).min()),
        float(np.max(leak)),
    )


def best_circle(mesh: Mesh, penumbra: float = 0.0) -> Circle:
    """The smallest circle that serves its worst point nearly as well as any.

    Raises ValueError where none covers every point: the penumbra is too wide for the mesh.
    """
    tried = [circle(mesh, float(r) * mesh.pitch_mm, penumbra) for r in _RADII]
    most = max(min(c.lit, c.unlit) for c in tried)
    if most <= 0.0:
        raise ValueError(
            f"no circle lights and shades every point: a penumbra of {penumbra:.2g} mm is too wide "
            f"for holes of {mesh.hole_mm:g} mm at a pitch of {mesh.pitch_mm:g} mm: bring the mesh "
            "nearer to the scene, take a coarser one, or say the source's angle, if it is smaller "
            "than the sun's (--source-deg)"
        )
    return next(c for c in tried if min(c.lit, c.unlit) >= _NEAR_BEST * most)


def plan(
    mesh: Mesh,
    *,
    penumbra: float = 0.0,
    exposure_s: float = 0.01,
    frame_rate_hz: float = 30.0,
    max_feed_mm_s: float = math.inf,
    radius_mm: float | None = None,
) -> Plan:
    """Radius, feed and frames of a mesh scan. Raises ValueError for what no circle can do."""
    best = best_circle(mesh, penumbra) if radius_mm is None else circle(mesh, radius_mm, penumbra)
    if not best.covers:
        raise ValueError(
            f"a circle of {best.radius_mm:g} mm leaves points "
            f"{'never lit' if best.lit <= 0 else 'never in the umbra'}"
        )
    frames = max(_FEWEST, math.ceil(_SAMPLES / min(best.lit, best.unlit)))
    way = math.tau * best.radius_mm
    feed = min(way / frames * frame_rate_hz, _BLUR * mesh.hole_mm / exposure_s, max_feed_mm_s)
    turn = way / feed
    return Plan(
        mesh,
        best,
        penumbra,
        feed,
        frame_rate_hz,
        round(turn * frame_rate_hz),
        turn,
        feed * exposure_s,
    )
