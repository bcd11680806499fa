"""How strong the source is in each frame of a video in which a shadow moves.

Each place is compared with the brightest that was seen of it; the places that are in full light
now have the largest ratios, and their share is much the same in every frame, so a high quantile of
the ratios follows the source and not the shadow. What the quantile is under a steady source is
learned while the brightest is still growing; meanwhile only a cloud is told from none. Ambient
light makes the source's change look smaller than it is: strength is that of all the light.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane, Response

_CELLS = 160  # along the longer side of the picture
_QUANTILE = 0.95  # less of the picture is in full light
_FLOOR = 0.05  # of the brightest place: darker ones are left out
_GROWN = 1.05  # a place that has become brighter by more was not in full light before
_STILL = 0.01  # share of the places that may still do so when the brightest is known
_LEARN = 15  # frames that the steady quantile is learned from


class SourceStrength:
    """Follows one source. Deterministic; memory: two small planes."""

    def __init__(self, response: Response) -> None:
        self._response = response
        self._now: Plane | None = None
        self._brightest: Plane | None = None
        self._learned: deque[float] = deque(maxlen=_LEARN)
        self._grown: deque[float] = deque(maxlen=_LEARN)
        self._steady: float | None = None

    def of(self, pixels: NDArray[Any]) -> float:
        """The source's strength in the next frame, the first ones' being 1."""
        now = self._now = self._small(pixels)
        if self._brightest is None:
            return 1.0
        ratio = self._quantile(now)
        if self._steady is not None:
            return ratio / self._steady
        usual = float(np.median(self._learned)) if len(self._learned) == _LEARN else 1.0
        return min(1.0, ratio / usual)

    def accept(self, strength: float) -> None:
        """The frame last asked about is used, scaled by `strength`: it may be the brightest."""
        assert self._now is not None
        now = self._now / np.float32(strength)
        if self._brightest is None:
            self._brightest = now
            return
        if self._steady is None:
            self._learned.append(self._quantile(now))
            self._grown.append(float(np.mean(now > _GROWN * self._brightest)))
        self._brightest = np.maximum(self._brightest, now)
        full = len(self._grown) == _LEARN
        if self._steady is None and full and max(self._grown) < _STILL:
            self._steady = float(np.median(self._learned))

    @property
    def learned(self) -> bool:
        """Whether small changes can be told."""
        return self._steady is not None

    def _quantile(self, now: Plane) -> float:
        """Of the ratios to the brightest, this frame included where it is not known yet."""
        assert self._brightest is not None
        known = self._brightest
        if self._steady is None:
            known = np.maximum(known, now)
        tells = known > _FLOOR * known.max()
        return float(np.quantile(now[tells] / known[tells], _QUANTILE))

    def _small(self, pixels: NDArray[Any]) -> Plane:
        """Means of cells of the linear light, in one plane."""
        light = self._response.linear(pixels)
        grey = light if light.ndim == 2 else light.mean(axis=2)
        factor = max(1, max(grey.shape) // _CELLS)
        size = (max(1, grey.shape[1] // factor), max(1, grey.shape[0] // factor))
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.float32)
