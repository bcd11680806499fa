"""What stands before the virtual camera, and what each of its pixels sees of it.

A corner of two coloured walls and a floor (diffuse interreflection); a candle and a block of marble
(subsurface scattering, broad and strongly local); a painted ball; a glass of cloudy water (a
participating medium); a ball of chrome, whose reflections are not smooth, so that the separation
fails on it (paper, Fig. 8); and the shadows that they cast on one another, where only global light
arrives. Lengths in mm, y is up; the corner's foot is at (0, 0, 1000).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.virtual.geometry import (
    EPSILON,
    F32,
    Block,
    Cylinder,
    Pinhole,
    Point,
    Solid,
    Sphere,
    chord,
    dot,
    nearest,
    unit,
    vector,
    visible,
)

CORNER = vector((0, 0, 1000))
LEFT = vector((-1, 0, -1)) / np.float32(np.sqrt(2))  # along the left wall, from the corner
RIGHT = vector((1, 0, -1)) / np.float32(np.sqrt(2))
UP = vector((0, 1, 0))
ROOM_NORMALS = np.stack([RIGHT, LEFT, UP])  # the left wall faces right
SPREAD = 800.0  # mm of each wall that has patches
ROOM = 3  # surfaces before the solids: left wall, right wall, floor
TARGET: Point = (0.0, 120.0, 790.0)
OUTSIDE = np.float32(3000.0)  # mm from the eye there is nothing but the dark
CELLS = 12  # patches a surface in each direction
FINE = 4  # points a patch in each direction where light is caught


@dataclass(frozen=True)
class Scatter:
    """Light that leaves elsewhere than it entered: a blur of `radius_mm`, tinted."""

    radius_mm: float
    colour: Point


@dataclass(frozen=True)
class Thing:
    """A solid and what it is made of."""

    name: str
    solid: Solid
    colour: Point
    gloss: float = 0.0  # of white highlight
    mirror: float = 0.0  # of what it sees in mirror direction
    scatter: tuple[Scatter, ...] = ()


THINGS = (
    Thing(
        "candle",
        Cylinder((-205.0, 95.0, 610.0), 50.0, 190.0),
        (0.20, 0.18, 0.14),
        gloss=0.05,
        scatter=(Scatter(45.0, (0.42, 0.25, 0.11)), Scatter(14.0, (0.16, 0.13, 0.08))),
    ),
    Thing("ball", Sphere((-62.0, 62.0, 455.0), 62.0), (0.48, 0.36, 0.07), gloss=0.5),
    Thing(
        "marble",
        Block((28.0, 85.0, 745.0), (58.0, 85.0, 50.0), 0.5),
        (0.46, 0.47, 0.50),
        gloss=0.06,
        scatter=(Scatter(7.0, (0.12, 0.12, 0.12)), Scatter(20.0, (0.20, 0.21, 0.23))),
    ),
    Thing("chrome", Sphere((118.0, 55.0, 490.0), 55.0), (0.02, 0.02, 0.02), mirror=0.75),
)
WATER = Cylinder((258.0, 75.0, 610.0), 50.0, 150.0)
WATER_COLOUR = (0.80, 0.92, 1.00)
EXTINCTION = 0.011  # a mm
SCATTERING = 0.009  # a mm
SOLIDS: tuple[Solid, ...] = tuple(thing.solid for thing in THINGS)
SURFACES = ROOM + len(THINGS)


def _noise(u: F32, v: F32, cells: int, seed: int) -> F32:
    """Smooth noise in -1..1 at coordinates in 0..1, the same at every resolution."""
    grid = np.random.default_rng(seed).uniform(-1, 1, (cells + 2, cells + 2)).astype(np.float32)
    table = cv2.resize(grid, (256, 256), interpolation=cv2.INTER_CUBIC)
    x, y = (np.mod(c, 1).astype(np.float32).reshape(-1, u.shape[-1]) * 255 for c in (u, v))
    return np.asarray(cv2.remap(table, x, y, cv2.INTER_LINEAR), np.float32).reshape(u.shape)


def room_hit(origin: F32, direction: F32) -> tuple[F32, NDArray[np.intp]]:
    """Where rays from inside meet the walls and floor: distance, and which of the three."""
    distances = []
    for normal in ROOM_NORMALS:
        away = dot(direction, normal)
        foot = dot(CORNER - origin, normal)
        t = foot / np.where(np.abs(away) < 1e-6, np.float32(1e-6), away)
        distances.append(np.where(t > 0.1, t, np.float32(np.inf)))
    stack = np.stack(distances, -1)
    return stack.min(-1), stack.argmin(-1)


def surface_uv(surface: NDArray[np.intp], point: F32) -> tuple[F32, F32]:
    """Each surface's own coordinates, 0..1: along the walls; longitude and sine of latitude."""
    o = point - CORNER
    a, b, up = dot(o, LEFT) / SPREAD, dot(o, RIGHT) / SPREAD, point[..., 1] / SPREAD
    u = np.where(surface == 1, b, a)
    v = np.where(surface == 2, b, up)
    for index, thing in enumerate(THINGS):
        d = unit(point - vector(thing.solid.middle))
        mine = surface == ROOM + index
        u = np.where(mine, np.arctan2(d[..., 0], -d[..., 2]) / np.float32(2 * np.pi) + 0.5, u)
        v = np.where(mine, d[..., 1] * 0.5 + 0.5, v)
    return np.asarray(u, np.float32), np.asarray(v, np.float32)


def normals(surface: NDArray[np.intp], point: F32) -> F32:
    """Unit normals that point into the room."""
    n = ROOM_NORMALS[np.minimum(surface, ROOM - 1)]
    for index, solid in enumerate(SOLIDS):
        mine = surface == ROOM + index
        if mine.any():
            n[mine] = solid.normal(point[mine])
    return n


def albedo(surface: NDArray[np.intp], point: F32) -> F32:
    """Diffuse reflectance (..., 3) RGB, textured."""
    u, v = surface_uv(surface, point)
    mottle = 1 + 0.05 * _noise(u, v, 24, 1) + 0.04 * _noise(u, v, 90, 2)
    colour = np.asarray(
        [(0.78, 0.20, 0.12), (0.14, 0.42, 0.66), (0.66, 0.63, 0.57)]
        + [thing.colour for thing in THINGS],
        np.float32,
    )[surface]
    tile = (np.floor(u * 12) + np.floor(v * 12)) % 2
    edge = np.minimum(np.abs(u * 12 - np.rint(u * 12)), np.abs(v * 12 - np.rint(v * 12)))
    floor = np.where(edge < 0.04, 0.6, 1 - 0.16 * tile)
    poster = (np.abs(u - 0.42) < 0.13) & (np.abs(v - 0.34) < 0.10) & (surface == 1)
    stripe = 0.5 + 0.5 * np.sin(u * 160 + 6 * _noise(u, v, 6, 7)) > 0.5
    colour = np.where(
        poster[..., None],
        np.where(stripe[..., None], vector((0.85, 0.80, 0.62)), vector((0.12, 0.16, 0.22))),
        colour,
    )
    band = np.sin(18 * v + 5 * _noise(u, v, 5, 3)) > 0
    ball = surface == ROOM + 1
    colour = np.where((ball & band)[..., None], vector((0.45, 0.06, 0.035)), colour)
    x, y, z = (np.asarray(point[..., k] / 220, np.float32) for k in range(3))
    vein = np.abs(_noise(x + z, y - x * np.float32(0.5), 9, 5))
    marble = np.where(surface == ROOM + 2, np.clip(0.45 + 3.5 * vein, 0.45, 1), 1)
    factor = mottle * np.where(surface == 2, floor, 1) * marble
    return np.asarray(colour * factor[..., None], np.float32)


# ---------------------------------------------------------------- patches


@dataclass(frozen=True)
class Patches:
    """The surfaces cut into SURFACES x CELLS x CELLS patches, and how they light one another."""

    points: F32  # (S, n, n, 3) with n = CELLS * FINE, where light is caught
    normals: F32
    bounce: F32  # (3, N, N): irradiance by way of other patches, all bounces, from direct one
    room_light: F32  # (3, N): irradiance of each patch under a uniform sky of 1


def _grid(n: int) -> tuple[F32, F32, F32]:
    """Points, normals (S, n, n, 3) and areas (S, n, n) in mm² of surface samples."""
    c = np.asarray((np.arange(n) + 0.5) / n, np.float32)
    v, u = np.meshgrid(c, c, indexing="ij")
    p: F32 = np.asarray(SPREAD * u[..., None], np.float32)
    q: F32 = np.asarray(SPREAD * v[..., None], np.float32)
    points: list[F32] = [
        CORNER + p * LEFT + q * UP,
        CORNER + p * RIGHT + q * UP,
        CORNER + p * LEFT + q * RIGHT,
    ]
    faces: list[F32] = [np.broadcast_to(x, (n, n, 3)) for x in ROOM_NORMALS]
    areas = [np.full((n, n), (SPREAD / n) ** 2, np.float32)] * ROOM
    longitude, sine = (u - 0.5) * 2 * np.pi, 2 * v - 1
    cosine = np.sqrt(1 - sine**2)
    outward = np.stack([np.sin(longitude) * cosine, sine, -np.cos(longitude) * cosine], -1).astype(
        np.float32
    )
    for solid in SOLIDS:
        _, leave = solid.span(vector(solid.middle), outward)
        point = vector(solid.middle) + leave[..., None] * outward
        face = solid.normal(point)
        points.append(point)
        faces.append(face)
        slant = np.maximum(dot(outward, face), 0.2)
        areas.append(np.asarray(4 * np.pi / n**2 * leave**2 / slant, np.float32))
    return np.stack(points).astype(np.float32), np.stack(faces), np.stack(areas)


@lru_cache(maxsize=1)
def patches() -> Patches:
    """The patches; built once (about a second)."""
    points, faces, areas = _grid(CELLS)
    surface = np.broadcast_to(np.arange(SURFACES)[:, None, None], areas.shape)
    x, n, area = points.reshape(-1, 3), faces.reshape(-1, 3), areas.ravel()
    reflect = albedo(surface, points).reshape(-1, 3)
    for index, thing in enumerate(THINGS):
        whole = np.sum([s.colour for s in thing.scatter], axis=0) if thing.scatter else 0
        reflect[surface.ravel() == ROOM + index] += np.asarray(whole, np.float32)
    towards = x[None] - x[:, None]
    square = np.maximum(dot(towards, towards), np.float32(1))
    leaving = np.maximum(dot(towards, n[:, None]), 0) / np.sqrt(square)
    arriving = np.maximum(-dot(towards, n[None]), 0) / np.sqrt(square)
    form = leaving * arriving * area[None] / (np.pi * square + area[None])
    lit = form > 1e-7
    i, j = np.nonzero(lit)
    form[i, j] *= visible(SOLIDS, x[i], n[i], x[j] + EPSILON * n[j])
    form /= np.maximum(form.sum(1, keepdims=True), 1)
    eye = np.eye(len(x), dtype=np.float32)
    bounce = []
    for c in range(3):
        gathered = form * reflect[None, :, c]  # irradiance of i from irradiance of j
        bounce.append(np.linalg.solve(eye - gathered, gathered))
    matrix = np.asarray(np.stack(bounce), np.float32)
    sky = 1 - form.sum(1)
    fine = _grid(CELLS * FINE)
    return Patches(fine[0], fine[1], matrix, np.asarray(sky + matrix @ sky, np.float32))


# ---------------------------------------------------------------- what a camera sees


@dataclass(frozen=True)
class Surface:
    """Surface points seen by rays: all arrays share their leading shape."""

    index: NDArray[np.intp]
    point: F32
    normal: F32
    albedo: F32
    away: F32  # unit vectors towards the eye
    clear: F32  # fraction of light that the water lets through to the eye


def look(origin: F32, direction: F32, skip: int = -1) -> Surface:
    """What unit rays meet first; `skip` is a thing that they pass (the mirror that they leave)."""
    solids = [s for k, s in enumerate(SOLIDS) if k != skip]
    names = [k for k in range(len(SOLIDS)) if k != skip]
    far, wall = room_hit(origin, direction)
    dark = far > OUTSIDE  # the room is open behind the eye
    far = np.minimum(far, OUTSIDE)
    near, which = nearest(solids, origin, direction)
    hit = near < far
    index = np.where(hit, ROOM + np.asarray(names)[which], wall)
    point = np.asarray(origin + np.where(hit, near, far)[..., None] * direction, np.float32)
    clear = np.exp(-EXTINCTION * chord(WATER, np.broadcast_to(origin, point.shape), point))
    colour = albedo(index, point) * ~(dark & ~hit)[..., None]
    return Surface(
        index, point, normals(index, point), colour, -direction, clear.astype(np.float32)
    )


def eye(width: int, height: int) -> Pinhole:
    """The camera's place in the world; the field of view does not depend on the size."""
    return Pinhole((0.0, 330.0, -250.0), TARGET, width, height, np.radians(17.0))
