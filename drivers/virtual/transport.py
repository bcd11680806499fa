"""The light transport from one source to the camera: a linear operator, applied, never stored.

`T E = D E + G E`: an emission image E (what each element of the source emits; 1 is all that it
has) gives the radiance at the camera's pixels by the direct path (the source's light leaves the
first surface that it meets towards the eye) and by all others: between the scene's patches, below
surfaces, in the water, by way of the mirror. Radiance is in units of the brightest diffuse part
under full light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.virtual import scene
from drivers.virtual.geometry import F32, Pinhole, chord, dot, unit, vector, visible
from drivers.virtual.view import COARSE, TILE, View, blur, view

Channel = NDArray[np.intp]  # (H, W): which of R, G, B each pixel sees (a mosaic, or one colour)


@dataclass(frozen=True)
class Light:
    """Direct light on points: which emission pixel it comes from, and how much arrives."""

    x: F32
    y: F32
    strength: F32


@dataclass(frozen=True)
class Lit:
    """The light that one emission image sends, before the eye has a colour."""

    arriving: F32  # (H, W): irradiance of the seen points by the direct path
    tiles: F32  # (3 TILE, S TILE): irradiance from other patches; R above G above B
    below: tuple[F32, ...]
    mirrored: F32  # (h, w): irradiance of the points seen in the mirror
    water: F32  # (h, w)


@dataclass(frozen=True)
class Weights:
    """A view's weights at each pixel's own colour."""

    tile_y: F32
    diffuse: F32
    reflect: F32
    below: tuple[F32, ...]
    mirror: F32
    mirror_tile_y: F32
    water: F32


class Transport:
    """T for one source and one camera size. Applying it takes a few ms at 640 x 480."""

    def __init__(self, seen: View, source: Pinhole) -> None:
        self.view = seen
        self.source = source
        patches = scene.patches()
        flat = patches.points.shape[0] * patches.points.shape[1]
        self._bounce = patches.bounce.reshape(-1, patches.bounce.shape[-1])
        self._pixels = _catch(source, seen.seen.point, seen.seen.normal)
        self._mirror = _catch(source, seen.mirrored.surface.point, seen.mirrored.surface.normal)
        self._patches = _catch(
            source,
            patches.points.reshape(flat, -1, 3),
            patches.normals.reshape(flat, -1, 3),
        )
        self._water = _catch(source, seen.water.point, None)
        self._highlight = self._gloss()
        self._unit = 1.0
        full = np.ones((source.height, source.width), np.float32)
        planes = [sum(self.render(self.light(full), k)) for k in "RGB"]
        brightest = np.max(np.stack([np.asarray(p) for p in planes]), axis=0)
        self._unit = float(np.percentile(brightest[seen.smooth], 99.5))

    @property
    def correspondence(self) -> tuple[F32, F32]:
        """Source pixel x, y (H, W) that each camera pixel's surface point lies on."""
        return self._pixels.x, self._pixels.y

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(H, W): the direct path is open."""
        x, y, inside = self._pixels.x, self._pixels.y, self._pixels.strength > 0
        return (
            inside
            & (x >= 0)
            & (x <= self.source.width - 1)
            & ((y >= 0) & (y <= self.source.height - 1))
        )

    def light(self, emission: F32) -> Lit:
        """Send an emission image (h, w) through the scene."""
        v = self.view
        arriving = _gather(emission, self._pixels) * self._pixels.strength
        # Patches and water are sampled more coarsely than the source's pixels.
        factor = max(1, emission.shape[0] // 96)
        size = (emission.shape[1] // factor, emission.shape[0] // factor)
        small = cv2.resize(emission, size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), 2.5, borderType=cv2.BORDER_REPLICATE)
        soft = np.asarray(small, np.float32)
        caught = _gather(soft, self._patches, factor) * self._patches.strength
        n, fine = scene.CELLS, scene.FINE
        direct = caught.reshape(-1, n, fine, n, fine).mean((2, 4)).ravel()
        # On one core: a threaded product would fight with the rig's own threads for so little.
        bounced = np.einsum("ij,j->i", self._bounce, direct).reshape(3, -1, n, n)
        return Lit(
            arriving,
            _tiles(bounced),
            tuple(blur(b.region.cut(arriving) * b.mask, b.sigma) for b in v.below),
            _gather(emission, self._mirror) * self._mirror.strength,
            self._scatter(soft, factor),
        )

    def _scatter(self, soft: F32, factor: int) -> F32:
        w, at = self.view.water, self._water
        steps, height, width = w.weight.shape
        flat = Light(*(a.reshape(steps * height, width) for a in (at.x, at.y, at.strength)))
        if not height:
            return np.zeros((0, 0), np.float32)
        light = _gather(soft, flat, factor).reshape(w.weight.shape) * at.strength
        summed = np.einsum("shw,shw->hw", light, w.weight)
        rows = w.region.rows.stop - w.region.rows.start
        columns = w.region.columns.stop - w.region.columns.start
        large = cv2.resize(
            summed, (width * COARSE, height * COARSE), interpolation=cv2.INTER_LINEAR
        )
        return np.asarray(large[:rows, :columns], np.float32)

    def render(self, lit: Lit, layout: str) -> tuple[F32, F32]:
        """Direct and global radiance (H, W) at pixels whose colours are laid out as "R", "G", "B"
        (all of one) or a mosaic's first two, "RG" ...."""
        w, v = weights(self.view, layout), self.view
        direct = lit.arriving * (w.diffuse + self._highlight)
        others = _sample(lit.tiles, v.tile_x, w.tile_y) * w.reflect
        for scatter, light, weight in zip(v.below, lit.below, w.below, strict=True):
            scatter.region.cut(others)[...] += light * weight
        mirror = v.mirrored
        irradiance = _sample(lit.tiles, mirror.tile_x, w.mirror_tile_y)
        mirror.region.cut(others)[...] += (lit.mirrored + irradiance) * w.mirror
        v.water.region.cut(others)[...] += lit.water * w.water
        direct *= np.float32(1 / self._unit)
        others *= np.float32(1 / self._unit)
        return direct, others

    def _gloss(self) -> F32:
        """(H, W): highlights, a unit of direct irradiance."""
        seen = self.view.seen
        towards = unit(vector(self.source.position) - seen.point)
        halfway = np.maximum(dot(unit(towards + seen.away), seen.normal), 0)
        return np.asarray(self.view.gloss * 0.3 * halfway**90, np.float32)


def room(seen: View, layout: str) -> F32:
    """Radiance (H, W) under a uniform sky that lights a free, white surface with 1."""
    w = weights(seen, layout)
    n = scene.CELLS
    tiles = _tiles(scene.patches().room_light.reshape(3, -1, n, n))
    sky = _sample(tiles, seen.tile_x, w.tile_y) * w.reflect
    m = seen.mirrored
    other = _sample(tiles, m.tile_x, w.mirror_tile_y)
    m.region.cut(sky)[...] += other * w.mirror
    scattered = seen.water.weight.sum(0)
    if scattered.size:
        rows, columns = w.water.shape
        large = np.kron(scattered, np.ones((COARSE, COARSE), np.float32))[:rows, :columns]
        seen.water.region.cut(sky)[...] += large * w.water
    return np.asarray(sky, np.float32)


@lru_cache(maxsize=8)
def weights(seen: View, layout: str) -> Weights:
    """A view's weights for a layout of colours: see `Transport.render`."""
    channel = mosaic(layout, seen.gloss.shape)
    m = seen.mirrored
    here = m.region.cut(channel)
    tint = np.asarray(scene.WATER_COLOUR, np.float32)
    return Weights(
        seen.tile_y + (channel * TILE).astype(np.float32),
        pick(seen.diffuse, channel),
        pick(seen.reflect, channel),
        tuple(pick(b.weight, b.region.cut(channel)) for b in seen.below),
        pick(m.weight * m.surface.albedo, here),
        m.tile_y + (here * TILE).astype(np.float32),
        tint[seen.water.region.cut(channel)],
    )


def mosaic(layout: str, shape: tuple[int, ...]) -> Channel:
    """Which of R, G, B (0, 1, 2) each pixel sees: see `Transport.render`."""
    if len(layout) == 1:
        return np.full(shape, "RGB".index(layout), np.intp)
    cell = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}[layout]
    colours = np.array(["RGB".index(c) for c in cell], np.intp).reshape(2, 2)
    return np.tile(colours, (shape[0] // 2 + 1, shape[1] // 2 + 1))[: shape[0], : shape[1]]


def pick(colours: F32, channel: Channel) -> F32:
    """Of (h, w, 3) each pixel's own colour (h, w)."""
    return np.take_along_axis(colours, channel[..., None], -1)[..., 0]


def _catch(source: Pinhole, point: F32, normal: F32 | None) -> Light:
    """Direct light on points: cosine, inverse square, shadows, and the water on the way."""
    position = vector(source.position)
    towards = position - point
    square = dot(towards, towards)
    reference = vector(source.target) - position
    face = np.zeros_like(point) if normal is None else normal
    strength = dot(reference, reference) / square
    if normal is not None:
        strength = strength * np.maximum(dot(towards, normal) / np.sqrt(square), 0)
    strength = strength * visible(scene.SOLIDS, point, face, position)
    strength = strength * np.exp(-scene.EXTINCTION * chord(scene.WATER, point, position))
    x, y = source.project(point)
    return Light(x, y, np.asarray(strength, np.float32))


def _gather(emission: F32, at: Light, factor: int = 1) -> F32:
    """The emission towards points (2-D arrays), from an image `factor` times smaller; there is
    none outside the source's image."""
    x, y = at.x, at.y
    if factor > 1:
        x, y = (np.asarray((c + 0.5) / factor - 0.5, np.float32) for c in (x, y))
    return np.asarray(
        cv2.remap(emission, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.float32
    )


def _sample(image: F32, x: F32, y: F32) -> F32:
    """An image at coordinates (h, w); an empty region gives an empty one."""
    if not x.size:
        return np.zeros(x.shape, np.float32)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR), np.float32)


def _tiles(patches: F32) -> F32:
    """Patch values (3, S, n, n) as smooth tiles (3 TILE, S TILE)."""
    colours, surfaces, n, _ = patches.shape
    stack = patches.reshape(colours * surfaces, n, n).transpose(1, 2, 0)
    large = cv2.resize(np.ascontiguousarray(stack), (TILE, TILE), interpolation=cv2.INTER_CUBIC)
    tiles = (
        np.asarray(large, np.float32).reshape(TILE, TILE, colours, surfaces).transpose(2, 0, 3, 1)
    )
    return np.ascontiguousarray(tiles).reshape(colours * TILE, surfaces * TILE)


@lru_cache(maxsize=4)
def transport(width: int, height: int, source: Pinhole) -> Transport:
    """T from a source to a camera of a size; built once, shared by the benches of a process."""
    return Transport(view(width, height), source)
