"""What a camera of a given size sees of the scene, whatever the source."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.virtual import scene
from drivers.virtual.geometry import F32, dot, unit, vector

TILE = 48  # cells of a surface's irradiance, enlarged from scene.CELLS
STEPS = 12  # samples along a ray in the water
COARSE = 2  # camera pixels a sample of the water, in each direction


@dataclass(frozen=True)
class Region:
    """A part of the image with a light path of its own."""

    rows: slice
    columns: slice

    def cut(self, image: NDArray[Any]) -> NDArray[Any]:
        """The region of an image."""
        return image[self.rows, self.columns]


def around(mask: NDArray[np.bool_]) -> Region:
    """The smallest region that holds a mask."""
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    if not len(rows):
        return Region(slice(0, 0), slice(0, 0))
    return Region(
        slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    )


def blur(image: F32, sigma: float) -> F32:
    """A Gaussian blur, dark outside; a broad one at lower resolution, where it costs little."""
    height, width = image.shape
    factor = max(1, min(int(sigma / 3), height // 4, width // 4))
    size = (-(-width // factor), -(-height // factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1 else image
    small = cv2.GaussianBlur(small, (0, 0), sigma / factor, borderType=cv2.BORDER_CONSTANT)
    if factor > 1:
        small = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(small, np.float32)


def tile(surface: NDArray[np.intp], point: F32) -> tuple[F32, F32]:
    """Where points lie in the tiles of irradiance, that stand side by side."""
    u, v = scene.surface_uv(surface, point)
    x = np.clip(u * TILE - 0.5, 0, TILE - 1.001) + surface * TILE
    y = np.clip(v * TILE - 0.5, 0, TILE - 1.001)
    return x.astype(np.float32), y.astype(np.float32)


@dataclass(frozen=True)
class Below:
    """Scattering below one surface at one scale."""

    region: Region
    mask: F32
    sigma: float  # pixels
    weight: F32  # (h, w, 3)


@dataclass(frozen=True)
class Mirrored:
    """What is seen by way of the mirror."""

    region: Region
    surface: scene.Surface
    tile_x: F32
    tile_y: F32
    weight: F32  # (h, w, 3)


@dataclass(frozen=True)
class Water:
    """The participating medium, sampled along every COARSE-th pixel's ray."""

    region: Region
    point: F32  # (STEPS, h, w, 3)
    weight: F32  # (STEPS, h, w): light scattered towards the eye, a unit of light there


@dataclass(frozen=True, eq=False)
class View:
    """The camera's picture, path by path. `diffuse` (H, W, 3) is the radiance for direct
    irradiance, `reflect` for irradiance from other patches (all that scatters, gathered)."""

    seen: scene.Surface
    diffuse: F32
    reflect: F32
    gloss: F32  # (H, W)
    tile_x: F32
    tile_y: F32
    below: tuple[Below, ...]
    mirrored: Mirrored
    water: Water
    smooth: NDArray[np.bool_]  # (H, W): global light is smooth here, as the method assumes


@lru_cache(maxsize=4)
def view(width: int, height: int) -> View:
    """The view at a size; built once (a second at 640 x 480)."""
    eye = scene.eye(width, height)
    origin = vector(eye.position)
    seen = scene.look(origin, eye.rays())
    diffuse = seen.albedo * seen.clear[..., None]
    reflect, gloss = diffuse.copy(), np.zeros((height, width), np.float32)
    below: list[Below] = []
    for index, thing in enumerate(scene.THINGS):
        mask = seen.index == scene.ROOM + index
        gloss[mask] = thing.gloss * seen.clear[mask]
        region = around(mask)
        soft = region.cut(mask).astype(np.float32)
        distance = float(np.linalg.norm(vector(thing.solid.middle) - origin))
        for layer in thing.scatter if mask.any() else ():
            sigma = max(layer.radius_mm * eye.focal / distance, 0.3)
            tone = np.minimum(seen.albedo / vector(thing.colour), 1.2)
            share = (seen.clear * mask)[..., None]
            weight = np.asarray(vector(layer.colour) * tone * share, np.float32)
            reflect += weight
            reach = np.maximum(blur(soft, sigma), 1e-2)
            spread = np.asarray(region.cut(weight) / reach[..., None], np.float32)
            below.append(Below(region, soft, sigma, spread))
    x, y = tile(seen.index, seen.point)
    mirrored, shiny = _mirrored(seen)
    return View(
        seen, diffuse, reflect, gloss, x, y, tuple(below), mirrored, _water(seen, origin), ~shiny
    )


def _mirrored(seen: scene.Surface) -> tuple[Mirrored, NDArray[np.bool_]]:
    index, thing = next((k, t) for k, t in enumerate(scene.THINGS) if t.mirror)
    shiny = seen.index == scene.ROOM + index
    region = around(shiny)
    face, back = region.cut(seen.normal), region.cut(seen.away)
    bounced = unit(2 * dot(back, face)[..., None] * face - back)
    other = scene.look(region.cut(seen.point), bounced, skip=index)
    x, y = tile(other.index, other.point)
    fresnel = thing.mirror + (1 - thing.mirror) * (1 - np.maximum(dot(back, face), 0)) ** 5
    share = region.cut(shiny) * fresnel * region.cut(seen.clear)
    weight = share[..., None] * other.clear[..., None] * vector((1.0, 0.97, 0.93))
    return Mirrored(region, other, x, y, weight.astype(np.float32)), shiny


def _water(seen: scene.Surface, origin: F32) -> Water:
    direction = np.asarray(seen.point - origin, np.float32)  # the whole way is 1
    enter, leave = scene.WATER.span(origin, direction)
    leave = np.minimum(leave, 1)
    wet = (enter < leave) & (enter > 0)
    region = around(wet)
    way = region.cut(direction)[::COARSE, ::COARSE]
    first = np.where(wet, enter, 1)
    first = region.cut(first)[::COARSE, ::COARSE]
    last = region.cut(np.where(wet, leave, 1))[::COARSE, ::COARSE]
    step = (np.arange(STEPS, dtype=np.float32)[:, None, None] + 0.5) / STEPS
    point = origin + (first + step * (last - first))[..., None] * way
    length = (last - first) * np.linalg.norm(way, axis=-1)
    scattered = scene.SCATTERING * length / STEPS * np.exp(-scene.EXTINCTION * length * step)
    return Water(region, point.astype(np.float32), scattered.astype(np.float32))
