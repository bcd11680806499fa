"""Meshes and sticks, and the shade that they make in their plane between a source and the scene."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from drivers.virtual.geometry import F32


class OccluderKind(enum.StrEnum):
    """Shapes of occluders."""

    SQUARE = "mesh-square"  # round holes on a square grid
    HEX = "mesh-hex"  # round holes on a hexagonal grid
    STICK = "stick"  # an upright bar


@dataclass(frozen=True)
class Occluder:
    """A mesh without end, or a stick; its origin is in the middle of a hole, or of the stick."""

    kind: OccluderKind
    hole_mm: float = 6.25  # diameter
    pitch_mm: float = 10.0  # from hole to hole
    width_mm: float = 18.0  # of a stick

    @property
    def cell_mm(self) -> tuple[float, float]:
        """The rectangle that repeats."""
        tall = math.sqrt(3) if self.kind is OccluderKind.HEX else 1.0
        return self.pitch_mm, self.pitch_mm * tall

    @property
    def hole_fraction(self) -> float:
        """The part of a mesh that is hole (the paper's β); 1 for a stick."""
        if self.kind is OccluderKind.STICK:
            return 1.0
        holes = 2 if self.kind is OccluderKind.HEX else 1
        width, height = self.cell_mm
        return holes * math.pi * (self.hole_mm / 2) ** 2 / (width * height)

    def clearance(self, x: F32, y: F32) -> F32:
        """Signed distance in mm to the nearest rim, positive where light passes."""
        if self.kind is OccluderKind.STICK:
            return np.abs(x) - np.float32(self.width_mm / 2)
        width, height = self.cell_mm
        shifts = [(0.0, 0.0)]
        if self.kind is OccluderKind.HEX:
            shifts.append((width / 2, height / 2))
        nearest = [
            np.hypot(
                (x - dx + width / 2) % width - width / 2,
                (y - dy + height / 2) % height - height / 2,
            )
            for dx, dy in shifts
        ]
        return np.asarray(self.hole_mm / 2 - np.minimum.reduce(nearest), np.float32)


@dataclass(frozen=True)
class Shade:
    """The shade of an occluder that was at several places for equal times."""

    occluder: Occluder
    places: tuple[tuple[float, float], ...]  # mm from the middle of the plane, y downwards
    scale: float  # mm a pixel
    penumbra_mm: float  # diameter of the source as seen through a pin-hole in the plane

    def draw(self, pixels: tuple[int, int]) -> F32:
        """Transmission (h, w) float32, 0..1, of the plane; its middle is the image's."""
        if self.occluder.kind is OccluderKind.STICK:
            return self._stick(pixels)
        width, height = self.occluder.cell_mm
        sheet = _sheet(self.occluder, self.scale, self.penumbra_mm, pixels)
        total = np.zeros(pixels[::-1], np.float32)
        for x, y in self.places:
            # The mesh repeats, so any place is a shift by less than a cell.
            move = np.array(
                [[1, 0, -((-x) % width) / self.scale], [0, 1, -((-y) % height) / self.scale]],
                np.float32,
            )
            total += np.asarray(cv2.warpAffine(sheet, move, pixels, flags=cv2.INTER_LINEAR))
        total *= np.float32(1 / len(self.places))
        return total

    def _stick(self, pixels: tuple[int, int]) -> F32:
        x = ((np.arange(pixels[0]) - (pixels[0] - 1) / 2) * self.scale).astype(np.float32)
        soft = max(self.penumbra_mm, self.scale)
        rows = [
            np.clip(self.occluder.clearance(x - np.float32(p), x) / soft + 0.5, 0, 1)
            for p, _ in self.places
        ]
        mean = np.mean(rows, axis=0).astype(np.float32)
        return np.ascontiguousarray(np.broadcast_to(mean, pixels[::-1]))


@lru_cache(maxsize=8)
def _sheet(occluder: Occluder, scale: float, penumbra_mm: float, pixels: tuple[int, int]) -> F32:
    """A mesh at rest with its penumbra, one cell larger than the plane."""
    margin = [math.ceil(c / scale) + 2 for c in occluder.cell_mm]
    x, y = (
        ((np.arange(n + m) - (n - 1) / 2) * scale).astype(np.float32)
        for n, m in zip(pixels, margin, strict=True)
    )
    clear = np.clip(occluder.clearance(x[None, :], y[:, None]) / scale + 0.5, 0, 1)
    radius = penumbra_mm / scale / 2
    if radius > 0.3:
        reach = math.ceil(radius + 0.5)
        i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        disc = np.clip(radius + 0.5 - np.hypot(i, j), 0, 1)
        clear = cv2.filter2D(clear, -1, disc / disc.sum(), borderType=cv2.BORDER_REFLECT)
    return np.asarray(clear, np.float32)
