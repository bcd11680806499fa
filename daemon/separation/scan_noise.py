"""Noise of a pattern scan's averaged frames, from repeats of a pattern or from its first picture.

Repeats of one pattern differ by noise alone and are compared on every fourth row and column. With
one frame a pattern the first picture gives an upper bound; nothing is looked at after it, so that
comparing frames stays as fast as memory is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.noise import Noise, TemporalNoise, from_frame
from daemon.separation.radiometry import Plane, Response

_SAMPLE = 4


class ScanNoise:
    """What a scan's frames tell of the camera's noise; constant memory."""

    def __init__(self, response: Response, average: int = 1) -> None:
        self._response = response
        self._average = average
        self._repeats = TemporalNoise(response.full_scale)
        self._picture: Noise | None = None
        self._last: tuple[int, NDArray[Any]] | None = None

    def add(self, pixels: NDArray[Any], pattern: int) -> None:
        """Take in a frame of a pattern."""
        if self._picture is None:
            self._picture = from_frame(pixels, self._response.full_scale, self._response.bayer)
        if self._average == 1:
            return
        sample = np.ascontiguousarray(pixels[::_SAMPLE, ::_SAMPLE])
        if self._last is not None and self._last[0] == pattern:
            self._repeats.add(self._last[1], sample)
        self._last = pattern, sample

    @property
    def source(self) -> str:
        """From what the noise is known."""
        return "repeated frames" if self._repeats.pairs else "one picture"

    def deviation(self, light: Plane) -> Plane:
        """Standard deviation of a pattern's averaged linear light at a level of it (float32)."""
        noise = self._repeats.noise() or self._picture
        one = self._response.deviation(noise, self._response.counts(light))
        return one * np.float32(self._average**-0.5)
