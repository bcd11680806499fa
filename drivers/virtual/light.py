"""Lamps and a drifting sun over the virtual scene."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from drivers.base.device import Context, Options
from drivers.base.errors import DeviceRefused
from drivers.base.light import Light
from drivers.clock import NS
from drivers.virtual.bench import Carrier, Emission
from drivers.virtual.device import VirtualDevice, VirtualOptions
from drivers.virtual.geometry import F32, Pinhole, Point
from drivers.virtual.occluder import Shade
from drivers.virtual.scene import TARGET
from drivers.virtual.sky import Clouds
from drivers.virtual.timeline import Timeline

PLACES: dict[str, Point] = {
    "left": (-300.0, 620.0, -250.0),
    "right": (330.0, 620.0, -250.0),
    "top": (20.0, 900.0, 60.0),
}
PIXELS = (1024, 768)  # of the plane that an occluder moves in
SUN_DISTANCE = 40_000.0  # mm: far enough for parallel rays
SUN_ANGLE = math.radians(0.53)  # its diameter
STEP_PX = 0.5  # an occluder moves less than this between two samples of an exposure
MOST_SAMPLES = 12


class LightKind(enum.StrEnum):
    """What shines."""

    LAMP = "lamp"
    SUN = "sun"


class LightOptions(VirtualOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of ``[[light]] driver = "virtual"``."""

    kind: LightKind = LightKind.LAMP
    position_mm: tuple[float, float, float] | None = None  # None: by name (left, right, top)
    strength: Annotated[float, Meta(ge=0)] = 1.0  # 1: white is exposed as by the projector
    size_mm: Annotated[float, Meta(ge=0)] = 2.0  # diameter of a lamp: makes the penumbra
    on: bool = False  # from the beginning; a sun always is
    drift_deg_per_hour: float = 15.0  # of a sun
    clouds: tuple[tuple[float, float], ...] = ()  # (second, part of strength), interpolated
    cloudiness: Annotated[float, Meta(ge=0, lt=1)] = 0.0  # depth of random clouds
    cloud_seed: Annotated[int, Meta(ge=0)] = 1


class VirtualLight(VirtualDevice, Light):
    """A source without pixels: a lamp that can be switched, or the sun, that cannot.

    A stage's occluder may stand in its way; a frame integrates the shadow along the way that the
    occluder went during its exposure. The sun's drift moves the shadow, not the shading (a small
    angle). `set`, `safe` and `check` are safe to send again.
    """

    options_type = LightOptions
    main_act = "set"
    main = False

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, LightOptions)
        self._o = options
        self._epoch = self.clock.now_ns()
        self._told = options.on or self._is_sun
        self._lit = Timeline(self._told)
        self._clouds = Clouds(options.clouds, options.cloudiness, options.cloud_seed)
        position = options.position_mm or PLACES.get(name, PLACES["top"])
        half_angle = math.radians(23)
        if self._is_sun:
            reach = math.dist(position, TARGET)
            far = SUN_DISTANCE / reach
            x, y, z = (t + far * (p - t) for p, t in zip(position, TARGET, strict=True))
            position = (x, y, z)
            half_angle = math.atan(math.tan(half_angle) / far)
        self._pinhole = Pinhole(position, TARGET, *PIXELS, half_angle)
        self.bench.add(self)

    @property
    def _is_sun(self) -> bool:
        return self._o.kind is LightKind.SUN

    def facts(self) -> dict[str, Any]:
        """See Device."""
        return {"virtual": True, "source": self._o.kind.value, "strength": self._o.strength}

    def set(self, on: bool) -> None:
        """See Light. Raises DeviceRefused for a sun that should go out."""
        self._begin("set")
        if self._is_sun and not on:
            raise DeviceRefused(
                self.name, "set", "the sun cannot be switched off", "shade the scene"
            )
        self._switch(on)

    def is_on(self) -> bool:
        """See Light."""
        return self._told

    def safe(self) -> None:
        """See Device: off. The sun goes on shining, safely."""
        self._begin("safe")
        self._switch(False)

    def close(self) -> None:
        """See Device."""
        self._connected = False
        self._switch(False)

    def _switch(self, on: bool) -> None:
        self._told = on or self._is_sun
        with self.bench.lock:
            self._lit.change(self.clock.now_ns(), self._told)

    # ------------------------------------------------------------ as a source on the bench

    @property
    def pinhole(self) -> Pinhole:
        """See Source: the emission image lies in the plane of the occluder."""
        return self._pinhole

    @property
    def strength(self) -> float:
        """See Source."""
        return self._o.strength

    def emitted(self, start_ns: int, end_ns: int) -> Sequence[Emission]:
        """See Source."""
        found = []
        for start, end, lit in self._lit.spans(start_ns, end_ns):
            if not lit:
                continue
            seconds = ((start + end) / 2 - self._epoch) / NS
            strength = self._o.strength * self._clouds.strength(seconds)
            shade = self._shade(start, end, seconds)
            weight = strength * (end - start) / (end_ns - start_ns)
            found.append(Emission(weight, shade, partial(self._draw, shade)))
        return found

    def _shade(self, start_ns: int, end_ns: int, seconds: float) -> Shade | None:
        """Where the occluder was in an interval."""
        carrier = self.bench.carrier
        if carrier is None or carrier.shades not in {"", self.name}:
            return None
        distance = math.dist(self._pinhole.position, TARGET)
        plane = distance - carrier.before_scene_mm
        scale = plane / self._pinhole.focal  # mm a pixel
        size = SUN_ANGLE * distance if self._is_sun else self._o.size_mm
        turned = math.radians(self._o.drift_deg_per_hour / 3600 * seconds) if self._is_sun else 0.0
        drift = carrier.before_scene_mm * math.tan(turned)
        samples = self._samples(carrier, start_ns, end_ns, scale)
        return Shade(
            carrier.occluder,
            tuple((round(x + drift, 4), round(y, 4)) for x, y in samples),
            scale,
            size * carrier.before_scene_mm / distance,
        )

    @staticmethod
    def _samples(
        carrier: Carrier, start_ns: int, end_ns: int, scale: float
    ) -> list[tuple[float, float]]:
        """Positions at even times, so close that the shadow moves less than STEP_PX between."""
        probes = [
            carrier.offset_at(round(start_ns + (end_ns - start_ns) * k / 4)) for k in range(5)
        ]
        way = sum(math.dist(a, b) for a, b in pairwise(probes)) / scale
        count = min(MOST_SAMPLES, max(1, math.ceil(way / STEP_PX)))
        return [
            carrier.offset_at(round(start_ns + (end_ns - start_ns) * (k + 0.5) / count))
            for k in range(count)
        ]

    @staticmethod
    def _draw(shade: Shade | None) -> F32:
        if shade is None:
            return np.ones(PIXELS[::-1], np.float32)
        return shade.draw(PIXELS)
