"""The gaps that a fast sweep leaves between one frame's umbra and the next one's.

What lies in a gap saw a penumbra at most. Its light fell, but by less than that of the places on
both sides, which were in the umbra: a part of its direct light was there at its darkest moment and
would count as global. How wide gaps may be is told by how far it is from one frame's shadow to the
next one's, by the moments at which places were darkest; in a slow sweep these are a few pixels, and
nothing lies between.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.crossed import CELL, grey_of
from daemon.separation.radiometry import Plane

_SHALLOW = 0.75
"""Of the part of its light that the places around lost: who lost less was not in the umbra."""

_WIDEST = 4.0
"""Gaps may be so many times as wide as from one shadow to the next: a hand goes unevenly."""

_NARROWEST = 3.0
"""Pixels from one shadow to the next: between nearer ones no gap can be seen."""

_BETWEEN = np.ones((CELL + 1, CELL + 1), np.uint8)

_SIGNIFICANT = np.float32(3.0)


class Gaps:
    """Frames as they come -> the pixels that were in penumbra only; memory: two planes."""

    def __init__(self) -> None:
        self._frames = 0
        self._darkest: NDArray[Any] = np.zeros((0, 0), np.uint8)
        self._when = np.zeros((0, 0), np.uint16)

    def add(self, samples: NDArray[Any]) -> None:
        """Take in a frame, (H, W) or (H, W, 3)."""
        light = samples if samples.ndim == 2 else samples[..., 1]  # green has most of it
        if not self._frames:
            self._darkest = light.copy()
            self._when = np.zeros(light.shape, np.uint16)
        else:
            np.copyto(self._when, min(self._frames, 65_535), where=light < self._darkest)
            np.minimum(self._darkest, light, out=self._darkest)
        self._frames += 1

    def within(
        self, bright: Plane, dark: Plane, deviation: Plane, seen: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Pixels (H, W) in gaps. Those that were `seen` to lose light say where these are.

        `bright` and `dark`: light of each pixel at its brightest and darkest; `deviation`: of a
        frame's light (float32, a frame's shape).
        """
        apart = self._apart(seen)
        if apart < _NARROWEST:
            return np.zeros_like(seen)
        full = np.maximum(grey_of(bright), np.float32(1e-6))
        lost = np.where(seen, (full - grey_of(dark)) / full, 0).astype(np.float32)
        lost = np.asarray(cv2.medianBlur(lost, 3), np.float32)
        side = min(round(_WIDEST * apart), 2 * max(seen.shape)) | 1
        kernel = np.ones((side, side), np.uint8)
        around = np.asarray(cv2.morphologyEx(cv2.blur(lost, (3, 3)), cv2.MORPH_CLOSE, kernel))
        sure = _SIGNIFICANT * grey_of(deviation) / full
        gap = seen & (lost + sure < np.float32(_SHALLOW) * around)
        # what lost no light between two penumbras that are nearer than a cell lies in the gap, too
        closed = cv2.morphologyEx(_stripes(gap), cv2.MORPH_CLOSE, _BETWEEN)
        return np.asarray(gap | (~seen & (closed > 0)))

    def _apart(self, seen: NDArray[np.bool_]) -> float:
        """Pixels from the shadow of a frame to the next one's, across them."""
        edges = []
        for when, there in ((self._when, seen), (self._when.T, seen.T)):
            one, other = there[:, 1:], there[:, :-1]
            changes = np.count_nonzero((when[:, 1:] != when[:, :-1]) & one & other)
            rims = np.count_nonzero(one != other)  # two to a gap
            edges.append((changes + rims / 2) / max(int(np.count_nonzero(one | other)), 1))
        return 1.0 / max(math.hypot(*edges), 1e-3)


def _stripes(gap: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Without its specks, which noise makes and no penumbra."""
    _, label, facts, _ = cv2.connectedComponentsWithStats(gap.astype(np.uint8), connectivity=8)
    large = facts[:, cv2.CC_STAT_AREA] >= CELL * CELL
    return np.asarray(gap & large[label], np.uint8)
