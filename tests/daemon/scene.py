"""A small scene under any pattern, for the methods' tests: light is added up, not formulas.

A camera pixel sees one projector pixel; global light is a wide blur of what was emitted, times an
albedo, so that α is nowhere used. Noise is Gaussian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
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
from protocol.patterns import BLACK, AnyPattern
from protocol.scans.anyscan import AnyScan
from tests.daemon.scanning import scanned

FULL = 65535
OWN_US = 10_000.0


@lru_cache(maxsize=128)
def _sent(
    pattern: AnyPattern,
    size: tuple[int, int],
    leakage: float,
    gamma: float,
    blur: float,
    reach: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What the projector sends under a pattern, and what of it is all around: for many scans."""
    shown = patterns.render(pattern, *size) / 255.0
    emitted: Any = leakage + (1 - leakage) * shown**gamma
    if blur:
        emitted = cv2.GaussianBlur(emitted, (0, 0), blur)
    around = cv2.blur(emitted, (65, 65), borderType=cv2.BORDER_REFLECT)
    around = cv2.GaussianBlur(around, (0, 0), reach, borderType=cv2.BORDER_REFLECT)
    return emitted, np.asarray(around)


@dataclass
class Scene:
    """Counts of a 16-bit camera; every number is a fraction of full scale."""

    width: int = 128
    height: int = 96
    leakage: float = 0.0
    ambient: float = 0.0
    sigma: float = 0.0
    blur: float = 0.0  # of the projector, px
    reach: float = 40.0  # of global light, px
    gamma: float = 1.0  # of the projector
    pixel_format: PixelFormat = PixelFormat.MONO16
    calibration: dict[str, Any] = field(default_factory=dict)  # of the rig
    change: Callable[[NDArray[Any], Expose], NDArray[Any]] = field(default=lambda light, _: light)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(11)
        smooth = cv2.GaussianBlur(rng.standard_normal((self.height, self.width)), (0, 0), 6)
        smooth = smooth / np.abs(smooth).max()
        self.albedo_direct = 0.4 + 0.15 * smooth
        self.albedo_global = 0.15 - 0.08 * smooth[::-1]

    @property
    def direct(self) -> NDArray[np.float64]:
        """Direct light under white, in counts."""
        return np.asarray(self.albedo_direct * FULL)

    @property
    def indirect(self) -> NDArray[np.float64]:
        """Global light under white, in counts."""
        return np.asarray(self.albedo_global * FULL)

    def frame(self, step: Expose, rng: np.random.Generator) -> NDArray[np.uint16]:
        """What the camera counts under a step's pattern."""
        light: NDArray[Any] = np.full((self.height, self.width), self.ambient * FULL)
        if step.pattern is not None:
            emitted, around = _sent(
                step.pattern, (self.width, self.height), self.leakage, self.gamma, self.blur,
                self.reach,
            )  # fmt: skip
            light = light + emitted * self.direct + around * self.indirect
        light = self.change(light, step) * ((step.exposure_us or OWN_US) / OWN_US)
        light = light + rng.normal(0, 1, light.shape) * self.sigma * FULL
        counts = np.asarray(np.rint(np.clip(light, 0, FULL)), dtype=np.uint16)
        # a colour camera sees the same grey scene in each of its channels
        channels = self.pixel_format.channels
        return counts if channels == 1 else np.repeat(counts[..., None], channels, axis=2)

    def bench(self) -> Bench:
        """A live bench that sees it."""
        return Bench(
            CameraInfo(self.width, self.height, self.pixel_format),
            ProjectorInfo(self.width, self.height, refresh_hz=60),
            calibration=self.calibration,
            exposure_us=OWN_US,
        )

    def scan(self, spec: AnyScan, seed: int = 1) -> Components:
        """The whole of a scan, as the daemon does it."""
        rng = np.random.default_rng(seed)
        return scanned(spec, self.bench(), lambda step: self.frame(step, rng))


DARK = Expose(BLACK)
