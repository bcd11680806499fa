"""The noise of a camera, measured in pictures of the scan itself."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

_DIFFERENCE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_DIFFERENCE_NORM = 6.0  # a unit deviation of independent samples becomes 6 (Immerkær 1996)
_MAD = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
_BLOCK = 16


@dataclass(frozen=True, slots=True)
class Noise:
    """Variance of one frame's linear counts: `read`² + `gain` x light (photon noise)."""

    read: float
    gain: float = 0.0

    def deviation(self, light: Plane) -> Plane:
        """Standard deviation of one frame at a level of light (linear counts), float32."""
        variance = np.float32(self.read**2) + np.float32(self.gain) * np.maximum(light, 0)
        deviation: Plane = np.sqrt(variance, dtype=np.float32)
        return deviation


def from_picture(light: Plane, quantum: float = 1.0, step: int = 1) -> Noise:
    """Noise of a single picture (H, W): what a second difference leaves where the scene is smooth.

    Textured blocks say too much, so that the quietest fifth of the blocks speaks. `step` is the
    distance of samples of one colour (2 in a mosaic). Never less than the rounding of counts,
    `quantum`/√12. An upper bound for textured scenes.
    """
    floor = quantum / np.sqrt(12.0)
    plane = light[::step, ::step]
    if min(plane.shape) < _BLOCK:
        return Noise(float(floor))
    second = np.abs(cv2.filter2D(plane, -1, _DIFFERENCE, borderType=cv2.BORDER_REFLECT_101))
    height, width = (n // _BLOCK * _BLOCK for n in second.shape)
    blocks = second[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    spread = np.median(blocks.transpose(0, 2, 1, 3).reshape(-1, _BLOCK * _BLOCK), axis=1)
    spread = spread[np.isfinite(spread)]
    if spread.size == 0:
        return Noise(float(floor))
    quiet = float(np.quantile(spread, 0.2)) * _MAD / _DIFFERENCE_NORM
    return Noise(float(np.hypot(quiet, floor)) if quiet < floor else quiet)


def bits(mask: NDArray[np.bool_], flag: int) -> NDArray[np.uint16]:
    """A mask as a plane of one quality bit (uint16)."""
    return mask.astype(np.uint16) * np.uint16(flag)
