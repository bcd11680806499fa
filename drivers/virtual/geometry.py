"""Rays and convex solids: as much ray tracing as one small scene needs. Lengths in mm, y is up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
Point = tuple[float, float, float]
EPSILON = 0.3  # mm: a ray that leaves a surface does not hit it


def vector(values: Point) -> F32:
    """A point or direction as (3,) float32."""
    return np.asarray(values, np.float32)


def unit(v: F32) -> F32:
    """Vectors (..., 3) at length 1."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True), np.float32)


def dot(a: F32, b: F32) -> F32:
    """Inner product over the last axis."""
    return np.einsum("...i,...i->...", *np.broadcast_arrays(a, b))  # type: ignore[no-any-return]


class Solid(Protocol):
    """Convex, so a ray is inside it from `span`'s first to its second distance (first > second:
    the ray misses it)."""

    @property
    def middle(self) -> Point:
        """A point inside."""
        ...

    def span(self, origin: F32, direction: F32) -> tuple[F32, F32]:
        """Where rays (..., 3) enter and leave, in lengths of `direction`."""
        ...

    def normal(self, point: F32) -> F32:
        """Outward unit normals at points (..., 3) of the surface."""
        ...


def _slab(origin: F32, direction: F32, low: float, high: float) -> tuple[F32, F32]:
    """Where a coordinate lies between two values."""
    safe = np.where(np.abs(direction) < 1e-9, np.float32(1e-9), direction)
    a, b = (low - origin) / safe, (high - origin) / safe
    return np.minimum(a, b), np.maximum(a, b)


def _roots(a: F32, half_b: F32, c: F32) -> tuple[F32, F32]:
    """Where a t² + 2 half_b t + c <= 0."""
    inside = half_b * half_b - a * c
    root = np.sqrt(np.maximum(inside, 0))
    a = np.maximum(a, np.float32(1e-9))
    low, high = (-half_b - root) / a, (-half_b + root) / a
    missed = inside <= 0
    return np.where(missed, np.float32(np.inf), low), np.where(missed, np.float32(-np.inf), high)


@dataclass(frozen=True)
class Sphere:
    """A ball."""

    middle: Point
    radius: float

    def span(self, origin: F32, direction: F32) -> tuple[F32, F32]:
        """See Solid."""
        o = origin - vector(self.middle)
        return _roots(dot(direction, direction), dot(o, direction), dot(o, o) - self.radius**2)

    def normal(self, point: F32) -> F32:
        """See Solid."""
        return unit(point - vector(self.middle))


@dataclass(frozen=True)
class Cylinder:
    """Upright, with flat ends; `middle` is its centre."""

    middle: Point
    radius: float
    height: float

    def span(self, origin: F32, direction: F32) -> tuple[F32, F32]:
        """See Solid."""
        o = origin - vector(self.middle)
        flat_o, flat_d = o[..., ::2], direction[..., ::2]
        side = _roots(
            dot(flat_d, flat_d), dot(flat_o, flat_d), dot(flat_o, flat_o) - self.radius**2
        )
        ends = _slab(o[..., 1], direction[..., 1], -self.height / 2, self.height / 2)
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])

    def normal(self, point: F32) -> F32:
        """See Solid."""
        o = point - vector(self.middle)
        end = np.abs(o[..., 1]) / (self.height / 2) > np.hypot(o[..., 0], o[..., 2]) / self.radius
        up = np.stack([np.zeros_like(o[..., 1]), np.sign(o[..., 1]), np.zeros_like(o[..., 1])], -1)
        return np.where(end[..., None], up, unit(o * vector((1, 0, 1)) + np.float32(1e-9)))


@dataclass(frozen=True)
class Block:
    """A box turned about the vertical by `yaw` radians."""

    middle: Point
    half: Point
    yaw: float

    def _local(self, v: F32) -> F32:
        c, s = np.float32(np.cos(self.yaw)), np.float32(np.sin(self.yaw))
        return np.stack(
            [c * v[..., 0] - s * v[..., 2], v[..., 1], s * v[..., 0] + c * v[..., 2]], -1
        )

    def span(self, origin: F32, direction: F32) -> tuple[F32, F32]:
        """See Solid."""
        o, d = self._local(origin - vector(self.middle)), self._local(direction)
        slabs = [_slab(o[..., i], d[..., i], -h, h) for i, h in enumerate(self.half)]
        enter = np.maximum(np.maximum(slabs[0][0], slabs[1][0]), slabs[2][0])
        return enter, np.minimum(np.minimum(slabs[0][1], slabs[1][1]), slabs[2][1])

    def normal(self, point: F32) -> F32:
        """See Solid."""
        o = self._local(point - vector(self.middle)) / vector(self.half)
        face = np.argmax(np.abs(o), axis=-1)[..., None]
        n = np.where(np.arange(3) == face, np.sign(o), 0).astype(np.float32)
        c, s = np.float32(np.cos(self.yaw)), np.float32(np.sin(self.yaw))
        return np.stack(
            [c * n[..., 0] + s * n[..., 2], n[..., 1], -s * n[..., 0] + c * n[..., 2]], -1
        )


def nearest(solids: Sequence[Solid], origin: F32, direction: F32) -> tuple[F32, NDArray[np.intp]]:
    """The first solid that each ray meets: distance (inf: none) and which (-1: none)."""
    best = np.full(np.broadcast_shapes(origin.shape, direction.shape)[:-1], np.inf, np.float32)
    which = np.full(best.shape, -1, np.intp)
    for index, solid in enumerate(solids):
        enter, leave = solid.span(origin, direction)
        closer = (enter < leave) & (enter > EPSILON) & (enter < best)
        best[closer] = np.broadcast_to(enter, best.shape)[closer]
        which[closer] = index
    return best, which


def visible(solids: Sequence[Solid], point: F32, normal: F32, other: F32) -> NDArray[np.bool_]:
    """Whether nothing stands between surface points and others; broadcasts."""
    start = point + EPSILON * normal
    direction = np.asarray(other - start, np.float32)
    clear = np.ones(direction.shape[:-1], np.bool_)
    for solid in solids:
        enter, leave = solid.span(start, direction)
        clear &= ~((enter < leave) & (leave > 1e-5) & (enter < 1 - 1e-4))
    return clear


def chord(solid: Solid, point: F32, other: F32) -> F32:
    """Length in mm of the way from points to others that lies inside a solid."""
    direction = np.asarray(other - point, np.float32)
    enter, leave = solid.span(point, direction)
    inside = np.clip(leave, 0, 1) - np.clip(enter, 0, 1)
    return np.asarray(np.maximum(inside, 0) * np.linalg.norm(direction, axis=-1), np.float32)


@dataclass(frozen=True)
class Pinhole:
    """A camera, or a projector, or a lamp with a plane before it: rays <-> pixels.

    Pixel centres are whole numbers, x to the right and y downwards.
    """

    position: Point
    target: Point
    width: int
    height: int
    half_angle: float  # radians, of the image's height

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return float(self.height / 2 / np.tan(self.half_angle))

    def axes(self) -> tuple[F32, F32, F32]:
        """Unit vectors to the right, downwards and forwards."""
        forward = unit(vector(self.target) - vector(self.position))
        right = unit(np.cross(vector((0, 1, 0)), forward).astype(np.float32))
        return right, np.cross(right, forward).astype(np.float32), forward

    def rays(self) -> F32:
        """Directions (H, W, 3) of unit length through every pixel."""
        right, down, forward = self.axes()
        x = (np.arange(self.width, dtype=np.float32) - (self.width - 1) / 2) / self.focal
        y = (np.arange(self.height, dtype=np.float32) - (self.height - 1) / 2) / self.focal
        return unit(forward + x[None, :, None] * right + y[:, None, None] * down)

    def project(self, point: F32) -> tuple[F32, F32]:
        """Pixel coordinates x, y of points (..., 3) in front of it."""
        right, down, forward = self.axes()
        o = point - vector(self.position)
        depth = np.maximum(o @ forward, np.float32(1e-3))
        x = (o @ right) / depth * self.focal + (self.width - 1) / 2
        y = (o @ down) / depth * self.focal + (self.height - 1) / 2
        return np.asarray(x, np.float32), np.asarray(y, np.float32)
