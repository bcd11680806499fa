"""The virtual camera's sensor: from the light of the bench during an exposure to counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.base.pixelformat import PixelFormat
from drivers.clock import NS
from drivers.virtual.bench import Bench
from drivers.virtual.cameraoptions import CORRECT_LEVEL, CORRECT_US, CameraOptions
from drivers.virtual.geometry import F32
from drivers.virtual.sky import Sway
from drivers.virtual.timeline import Forgotten
from drivers.virtual.transport import mosaic, pick, room
from drivers.virtual.view import view

ROLLING_BANDS = 16  # rows of a rolling shutter are exposed in so many groups
LUMINANCE = np.asarray((0.30, 0.59, 0.11), np.float32)  # a mono sensor's response


@dataclass(frozen=True, slots=True)
class Settings:
    """What the camera is set to."""

    exposure_us: float
    gain: float  # dB
    pixel_format: PixelFormat
    frame_rate_hz: float
    roi: tuple[int, int, int, int]  # x, y, width, height

    @property
    def amplified(self) -> float:
        """The gain as a factor."""
        return float(10 ** (self.gain / 20))

    @property
    def layouts(self) -> tuple[str, ...]:
        """The planes of light that a frame is made of: a mosaic, or three colours."""
        bayer = self.pixel_format.bayer
        return (bayer,) if bayer else ("R", "G", "B")


class Sensor:
    """Integrates the bench's radiance over exposures: black level + electrons x gain, with shot
    noise (its variance the electrons themselves) and read noise.

    Noise is from a generator seeded with `seed` and the number of the frame since it was made. The
    picture sways and shakes frame by frame; where the shutter rolls, later rows see later light.
    """

    def __init__(self, options: CameraOptions, bench: Bench, epoch_ns: int) -> None:
        """`epoch_ns`: when gusts begin to count."""
        self._o = options
        self._bench = bench
        self._epoch = epoch_ns
        self._frames = 0  # since it was made: seeds the noise
        self._sway = Sway(options.gusts, options.sway_hz, options.seed)

    def prepare(self, layouts: Sequence[str]) -> None:
        """Build the scene now, where no frame's deadline waits for it."""
        self._bench.prepare(self._o.width, self._o.height)
        for layout in layouts:
            _room(self._o.width, self._o.height, layout)

    def black(self, settings: Settings) -> float:
        """Counts in the dark."""
        level = self._o.black_level
        return settings.pixel_format.full_scale // 64 if level is None else level

    def expose(self, start_ns: int, end_ns: int, settings: Settings, out: NDArray[Any]) -> bool:
        """Fill `out` with the counts of an exposure that is over; False: its light is forgotten."""
        rng = np.random.Generator(np.random.SFC64([self._o.seed, self._frames]))
        self._frames += 1
        try:
            planes = self._light(start_ns, end_ns, settings, rng)
        except Forgotten:
            out[...] = 0
            return False
        full_scale, black = settings.pixel_format.full_scale, self.black(settings)
        counts = self._framed(planes, settings) * np.float32(self._counts(settings))
        if self._o.noise:
            per_electron = (full_scale - black) / self._o.full_well_e * settings.amplified
            variance = counts * np.float32(per_electron)
            variance += np.float32((self._o.read_noise_e * per_electron) ** 2)
            noise = rng.standard_normal(counts.shape, np.float32)
            noise *= np.sqrt(variance, out=variance)
            counts += noise
        counts += np.float32(black + 0.5)
        np.clip(counts, 0, full_scale + 0.5, out=counts)
        out[...] = counts  # truncated: the half above makes it rounding
        return True

    def truth(self, sources: tuple[str, ...], settings: Settings) -> dict[str, F32]:
        """See Camera."""
        names = self._bench.shaded(sources) or self._bench.main_sources()
        if not names:
            return {}
        direct, others = self._bench.components(names, self._size, ("R", "G", "B"))
        mosaicked = bool(settings.pixel_format.bayer)
        x, y, width, height = settings.roi
        counts = np.float32(self._counts(settings))
        parts = {}
        for name, planes in (("direct", direct), ("global", others)):
            picture = np.stack(planes, -1)
            if settings.pixel_format.channels == 1 and not mosaicked:
                picture = np.asarray(picture @ LUMINANCE, np.float32)
            parts[name] = picture[y : y + height, x : x + width] * counts
        return parts

    @property
    def _size(self) -> tuple[int, int]:
        return self._o.width, self._o.height

    def _counts(self, settings: Settings) -> float:
        """Counts above black for radiance 1."""
        scale = settings.pixel_format.full_scale - self.black(settings)
        exposed = settings.exposure_us / CORRECT_US * settings.amplified
        return CORRECT_LEVEL * exposed * scale

    @staticmethod
    def _framed(planes: Sequence[F32], settings: Settings) -> F32:
        """Planes of its layouts as the pixels of this format, within the ROI."""
        if settings.pixel_format.bayer:
            picture = planes[0]
        else:
            picture = np.stack(planes, -1)
            if settings.pixel_format.channels == 1:
                picture = np.asarray(picture @ LUMINANCE, np.float32)
        x, y, width, height = settings.roi
        return picture[y : y + height, x : x + width]

    def _radiance(self, start_ns: int, end_ns: int, layouts: tuple[str, ...]) -> list[F32]:
        """The bench's, each band of rows at its own time where the shutter rolls."""
        rolling = round(self._o.rolling_ms * 1e6)
        if not rolling:
            return self._bench.radiance(start_ns, end_ns, self._size, layouts)
        edges = np.linspace(0, self._o.height, ROLLING_BANDS + 1).astype(int)
        bands = []
        for k, (top, below) in enumerate(pairwise(edges)):
            later = round(rolling * k / (ROLLING_BANDS - 1))
            planes = self._bench.radiance(start_ns + later, end_ns + later, self._size, layouts)
            bands.append([plane[top:below] for plane in planes])
        return [np.concatenate(of_layout) for of_layout in zip(*bands, strict=True)]

    def _light(
        self, start_ns: int, end_ns: int, settings: Settings, rng: np.random.Generator
    ) -> list[F32]:
        """Mean radiance, one plane a layout. Raises Forgotten."""
        dx, dy = rng.normal(0, self._o.shake_px, 2) if self._o.shake_px else (0.0, 0.0)
        if self._o.gusts:
            sway = self._sway.at(((start_ns + end_ns) / 2 - self._epoch) / NS)
            dx, dy = dx + sway[0], dy + sway[1]
        still = not (dx or dy)
        layouts = settings.layouts if still else ("R", "G", "B")
        planes = self._radiance(start_ns, end_ns, layouts)
        if self._o.ambient:
            for k, layout in enumerate(layouts):
                planes[k] += np.float32(self._o.ambient) * _room(*self._size, layout)
        if still:
            return planes
        shift = np.array([[1, 0, dx], [0, 1, dy]], np.float32)
        moved = [
            np.asarray(
                cv2.warpAffine(p, shift, self._size, borderMode=cv2.BORDER_REPLICATE), np.float32
            )
            for p in planes
        ]
        bayer = settings.pixel_format.bayer
        return [pick(np.stack(moved, -1), mosaic(bayer, moved[0].shape))] if bayer else moved


@lru_cache(maxsize=8)
def _room(width: int, height: int, layout: str) -> F32:
    return room(view(width, height), layout)
