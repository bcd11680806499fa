"""A scan's patterns as images, for those who project and photograph them by other means."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans import catalog
from daemon.scans.method import Bench, Expose, Unsuitable
from daemon.separation.estimator import Lighting
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.patterns import AnyPattern
from protocol.scans.anyscan import AnyScan
from protocol.scans.projected import PatternScan

_CAMERA = CameraInfo(width=4096, height=4096, pixel_format=PixelFormat("Mono8"))
"""Stands for the one that will look, of which patterns know nothing."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """One of `images`, the black and the white one first; `png`: the bytes of a file."""

    lighting: Lighting
    images: int
    png: NDArray[np.uint8]


def draw(spec: AnyScan, image: int, width: int, height: int, gamma: float = 1.0) -> Drawn:
    """An image of a scan, each pattern once, as a projector of this size and gamma shows it.

    Raises Unsuitable for a scan of no fixed pattern set, a bad spec, an image that there is not.
    """
    if not isinstance(spec, PatternScan):
        raise Unsuitable(f"{spec.__struct_config__.tag} shows no set of patterns", "$.spec")
    spec = msgspec.structs.replace(spec, average=1, bracket=None)
    projector = ProjectorInfo(width=width, height=height, refresh_hz=60.0)
    method = catalog.method_for(spec, Bench(camera=_CAMERA, projector=projector))
    shown: list[tuple[Lighting, AnyPattern]] = []
    while isinstance(step := method.step(len(shown), {}), Expose):
        assert step.pattern is not None, "black and white are patterns"
        shown.append((step.lighting, step.pattern))
    if image >= len(shown):
        raise Unsuitable(f"there are {len(shown)} images, from 0 on", "$.image")
    lighting, pattern = shown[image]
    levels = patterns.predistorted(patterns.render(pattern, width, height), of_gamma(gamma))
    done, encoded = cv2.imencode(".png", levels)
    assert done, "an 8-bit grey image is one that PNG can hold"
    return Drawn(lighting, len(shown), np.asarray(encoded, dtype=np.uint8).reshape(-1))


def of_gamma(gamma: float) -> list[int]:
    """The level for each of 256 wanted lights, of a projector whose light is level to this power:
    what `patterns.predistorted` takes."""
    light = np.arange(patterns.LEVELS + 1) / patterns.LEVELS
    return [round(level) for level in (patterns.LEVELS * light ** (1.0 / gamma)).tolist()]
