"""The virtual rig's scene without its devices: a method's frames straight from the light transport,
for what takes many scans."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.method import Bench, Expose
from daemon.separation.estimator import Components
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from drivers.virtual.geometry import Pinhole
from drivers.virtual.scene import TARGET
from drivers.virtual.transport import Transport, transport
from drivers.virtual.view import View, view
from protocol.patterns import AnyPattern
from protocol.scans.anyscan import AnyScan
from tests.daemon.scanning import scanned

FULL = 4095
BLACK = 64
OWN_US = 10_000.0


@dataclass
class VirtualScene:
    """A 12-bit Bayer camera and a projector of as many pixels: see the virtual rig's options."""

    width: int = 320
    height: int = 240
    leakage: float = 0.02
    defocus: float = 0.6
    gamma: float = 1.0
    level: float = 0.8  # of the scale, for radiance 1
    read: float = 1.2  # counts
    electrons: float = 10_500.0  # at full scale
    _lit: dict[AnyPattern, NDArray[np.float32]] = field(default_factory=dict, init=False)

    @cached_property
    def operator(self) -> Transport:
        """T."""
        at = Pinhole((230.0, 420.0, -230.0), TARGET, self.width, self.height, math.radians(21.0))
        return transport(self.width, self.height, at)

    @property
    def view(self) -> View:
        """What the camera sees: where the mirror is, for one."""
        return view(self.width, self.height)

    def mirrored(self) -> NDArray[np.bool_]:
        """Where light by way of the mirror is a third of the light and more: (H, W)."""
        lit = self.operator.light(np.ones((self.height, self.width), np.float32))
        whole = np.add(*self.operator.render(lit, "RG"))
        seen = self.view.mirrored
        albedo = np.asarray(seen.surface.albedo).mean(axis=2)
        share = np.zeros_like(whole)
        seen.region.cut(share)[...] = lit.mirrored * seen.weight.mean(axis=2) * albedo
        unit = float(self.operator._unit)
        return np.asarray(~self.view.smooth & (share / unit > 0.3 * whole))

    def bench(self) -> Bench:
        """The rig's facts."""
        return Bench(
            CameraInfo(self.width, self.height, PixelFormat.BAYER_RG12, black_level=BLACK),
            ProjectorInfo(self.width, self.height, refresh_hz=60),
            exposure_us=OWN_US,
        )

    def frame(self, step: Expose, rng: np.random.Generator) -> NDArray[np.uint16]:
        """What the camera counts under a step's pattern."""
        light: NDArray[Any] = np.zeros((self.height, self.width), np.float32)
        if step.pattern is not None:
            light = self._light(step.pattern)
        counts = light * self.level * (FULL - BLACK) * ((step.exposure_us or OWN_US) / OWN_US)
        shot = np.sqrt(np.maximum(counts, 0) * FULL / self.electrons)
        noisy = counts + rng.standard_normal(counts.shape) * np.hypot(shot, self.read) + BLACK
        return np.asarray(np.rint(np.clip(noisy, 0, FULL)), np.uint16)

    def _light(self, pattern: AnyPattern) -> NDArray[np.float32]:
        """Without noise, for radiance 1; kept for the next scan."""
        if pattern not in self._lit:
            shown = patterns.render(pattern, self.width, self.height) / np.float32(255)
            lit = self.leakage + (1 - self.leakage) * shown**self.gamma
            emitted = np.asarray(lit, np.float32)
            if self.defocus:
                blurred = cv2.GaussianBlur(
                    emitted, (0, 0), self.defocus, borderType=cv2.BORDER_REPLICATE
                )
                emitted = np.asarray(blurred, np.float32)
            self._lit[pattern] = np.add(*self.operator.render(self.operator.light(emitted), "RG"))
        return self._lit[pattern]

    def scan(self, spec: AnyScan, seed: int = 1) -> Components:
        """The whole of a scan, as the daemon does it."""
        rng = np.random.default_rng(seed)
        return scanned(spec, self.bench(), lambda step: self.frame(step, rng))
