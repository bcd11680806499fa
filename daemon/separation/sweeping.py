"""Whether frames look like a stick's shadow that passes: small, and much of a picture as it was."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane

_BOX = 4  # pixels a side whose mean is looked at, so that noise is little of it
_TELLS = 0.2  # of a box's light, that comes and goes
_BRIGHT = 0.1  # of the brightest boxes' light
_ENOUGH = 64  # boxes
_LIT = 0.75  # of the time that a stick leaves a place lit, at least
_MOSTLY = 0.5  # ... however wide it is, or slow
_STEP = 0.15  # of what a place ever changes by, from frame to frame; a stick's is far less


class Sweeping:
    """Frames as they come -> how long places are lit, and how much they change from one frame to
    the next; memory: a few planes of a sixteenth of a picture."""

    def __init__(self) -> None:
        self._frames = 0
        self._last = self._low = self._high = self._sum = self._steps = np.zeros((0, 0), np.float32)

    def add(self, pixels: NDArray[Any]) -> None:
        """Take in a frame, (H, W) or (H, W, 3)."""
        size = (max(1, pixels.shape[1] // _BOX), max(1, pixels.shape[0] // _BOX))
        small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.float32)
        grey: Plane = small if small.ndim == 2 else small.mean(axis=2, dtype=np.float32)
        if not self._frames:
            self._low, self._high, self._sum = grey.copy(), grey.copy(), grey.copy()
            self._steps = np.zeros_like(grey)
        else:
            np.minimum(self._low, grey, out=self._low)
            np.maximum(self._high, grey, out=self._high)
            self._sum += grey
            self._steps += np.abs(grey - self._last)
        self._last = grey
        self._frames += 1

    def told(self) -> tuple[dict[str, Any], list[str]]:
        """Facts (medians over the places that light comes and goes at), and lines of advice."""
        if self._frames < 2:
            return {}, []
        span = self._high - self._low
        tells = span > np.float32(_TELLS) * self._high
        tells &= self._high > np.float32(_BRIGHT) * np.quantile(self._high, 0.99)
        if np.count_nonzero(tells) < _ENOUGH:
            return {}, []
        lit = float(np.median(((self._sum / self._frames - self._low)[tells]) / span[tells]))
        step = float(np.median(self._steps[tells] / span[tells])) / (self._frames - 1)
        facts = {"lit_of_the_time": round(lit, 4), "change_per_frame": round(step, 4)}
        if lit > _LIT or (lit > _MOSTLY and step < _STEP):
            return facts, []
        return facts, [
            f"these frames do not look like a stick's: {1 - lit:.0%} of the light is missing at a "
            f"time, and {step:.0%} of it moves from one frame to the next, as behind a mesh or "
            "under projected patterns; a stick's shadow is small and moves little: name the method "
            "that the scene was lit for (--method), or sweep a thinner stick slowly"
        ]
