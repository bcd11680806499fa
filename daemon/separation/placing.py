"""Where a camera stood, to a few hundredths of a pixel, though a shadow moves over its picture.

Of each place two levels are known: in light and in shadow, from frames that lie alike. In another
frame every place is near one of them or between, and what is between, the shadow's edges, has no
say. The rest is the scene alone: its differences from the level that it is near, and from what the
light is around, are explained by a small rigid motion, in least squares that outliers hardly move
(Lucas and Kanade; Baker and Matthews, 2004, inverse compositional).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane

Motion = NDArray[np.float64]
"""3 x 3: where a place of the reference lies in a frame."""

STILL: Motion = np.eye(3)

_KEPT = 12  # of the frames, one in so many is a level's: its mean
_NEAR = 0.1  # of the way from one level to the other: a place that is at one
_ASTRAY = 0.3  # px: edges of the scene that lie off by less are near, too
_LEAST_SPAN = 0.25  # of the light: a shadow takes as much at least
_FLOOR = 0.03  # of the bright places' light, whose noise dark places have at least
_AROUND = 15  # pixels: light that changes over more of them is not the scene's motion
_EDGE = 2  # pixels along the picture's rim that are left out: they come and go
_MOST = 5_000  # places that are looked at
_LEAST = 150  # places that tell anything
_ROUNDS = 10
_ENOUGH = 0.005  # px of a round's step
_TRUSTED = 2.0  # deviations beyond which a difference counts less and less
_MEDIAN = 0.455  # of the square of a Gaussian of deviation 1
_UNSHARP = 0.2  # px: an edge that is drawn between pixels may be off by it
_NINTH = np.full((3, 3), 1 / 9, np.float32)
_GRADIENT = np.array([[-0.5, 0.0, 0.5]], np.float32)


class Levels:
    """What a scene looks like in light and in shadow; linear light, small and grey."""

    def __init__(self, pictures: Sequence[Plane], motions: Sequence[Motion]) -> None:
        """From frames that have moved so."""
        height, width = pictures[0].shape
        self.middle = ((width - 1) / 2.0, (height - 1) / 2.0)
        placed = [back(p, m) for p, m in zip(pictures, motions, strict=True)]
        ranked = np.sort(np.stack(placed), axis=0)
        few = max(1, len(placed) // _KEPT)
        self._levels = [np.asarray(x.mean(0), np.float32) for x in (ranked[-few:], ranked[:few])]
        self._around = [_mean(x) for x in self._levels]
        self._slopes = [_slopes(x, self.middle) for x in self._levels]
        lit, unlit = self._around
        least = np.float32(_LEAST_SPAN) * np.abs(lit)
        self._shaded = lit - unlit > least
        span = np.maximum(lit - unlit, least)
        self._near = [
            np.float32(_NEAR) * span + np.float32(_ASTRAY) * np.hypot(*_slopes(x, self.middle)[:2])
            for x in self._around
        ]
        seen = self._levels[0][np.isfinite(self._levels[0])]
        bright = float(np.quantile(seen, 0.95)) if seen.size else 0.0
        self._noisy = np.float32(_FLOOR * max(bright, 1e-3))
        self._inner = np.zeros((height, width), np.bool_)
        self._inner[_EDGE:-_EDGE, _EDGE:-_EDGE] = True

    def place(
        self, picture: Plane, motion: Motion, only: NDArray[np.bool_] | None = None
    ) -> tuple[Motion, NDArray[np.float64]] | None:
        """The motion of a frame, found from one nearby, and its variance (3 x 3: px, px, radians);
        None where too few places tell. `only`: where to look."""
        inner = self._inner if only is None else self._inner & only
        variance = np.full((3, 3), np.inf)
        for _ in range(_ROUNDS):
            found = self._step(back(picture, motion), inner)
            if found is None:
                return None
            step, variance = found
            motion = motion @ self._turned(*step)
            if self._reach(step) < _ENOUGH:
                break
        return motion, variance

    def _step(
        self, picture: Plane, inner: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """By what x, y and turn a frame lies off, and their variance."""
        around = _mean(picture)
        lit, unlit = (
            inner & (np.abs(around - level) < near)
            for level, near in zip(self._around, self._near, strict=True)
        )
        unlit &= self._shaded & ~lit
        parts = []
        for where, light, slopes in zip((lit, unlit), self._levels, self._slopes, strict=True):
            at = np.flatnonzero(where)
            at = at[:: 1 + at.size // _MOST]
            if at.size < _LEAST:
                continue
            level = (light * _gain(picture, light, where)).ravel()[at]
            parts.append((level, picture.ravel()[at] - level, slopes.reshape(3, -1)[:, at]))
        if not parts:
            return None
        light, off, design = (np.concatenate([p[k] for p in parts], axis=-1) for k in range(3))
        design = design.T
        steep = np.square(design[:, 0]) + np.square(design[:, 1])
        shot = np.abs(light) + self._noisy
        flat = steep <= np.median(steep)
        noise = np.float32(max(np.median(np.square(off[flat]) / shot[flat]) / _MEDIAN, 1e-12))
        weight = 1.0 / (noise * shot + np.float32(_UNSHARP**2) * steep)
        trust = np.ones_like(weight)
        try:
            for _ in range(2):
                weighted = design * (weight * trust)[:, None]
                normal = (weighted.T @ design).astype(np.float64)
                answer = np.linalg.solve(normal, (weighted.T @ off).astype(np.float64))
                left = (off - design @ answer.astype(np.float32)) * np.sqrt(weight)
                trust = 1.0 / (1.0 + np.square(left / np.float32(_TRUSTED)))
            variance = np.asarray(np.linalg.inv(normal), np.float64)
        except np.linalg.LinAlgError:
            return None  # nothing there tells of x, of y or of a turn
        return answer, variance

    def _turned(self, x: float, y: float, turn: float) -> Motion:
        """The motion that undoes a step."""
        cos, sin = math.cos(turn), math.sin(turn)
        middle = np.array(self.middle)
        rotation = np.array([[cos, sin], [-sin, cos]])
        undone = np.eye(3)
        undone[:2, :2] = rotation
        undone[:2, 2] = middle - rotation @ middle - np.array([x, y])
        return undone

    def _reach(self, step: NDArray[np.float64]) -> float:
        return float(np.hypot(step[0], step[1]) + abs(step[2]) * math.hypot(*self.middle))


def shifted(x: float, y: float) -> Motion:
    """A motion without a turn."""
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def back(picture: Plane, motion: Motion) -> Plane:
    """A frame as it looks from where the reference was taken; NaN: it did not see that."""
    if np.array_equal(motion, STILL):
        return picture
    return np.asarray(
        cv2.warpAffine(
            picture,
            motion[:2],
            picture.shape[::-1],
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=math.nan,
        )
    )


def _mean(picture: Plane) -> Plane:
    """Over 3 x 3 pixels; `cv2.blur` keeps running sums, which a NaN would spoil for good."""
    return np.asarray(cv2.filter2D(picture, -1, _NINTH))


def _gain(picture: Plane, light: Plane, where: NDArray[np.bool_]) -> Plane:
    """By how much a frame is brighter around each place: a shadow nearby takes light, too."""
    size = (_AROUND, _AROUND)
    of, to = (cv2.blur(np.where(where, x, np.float32(0)), size) for x in (picture, light))
    return np.divide(of, to, out=np.ones_like(to), where=to > 0)


def _slopes(light: Plane, middle: tuple[float, float]) -> NDArray[np.float32]:
    """What a step in x, in y, and a turn make of each place (3, H, W)."""
    x = np.arange(light.shape[1], dtype=np.float32)[None, :] - np.float32(middle[0])
    y = np.arange(light.shape[0], dtype=np.float32)[:, None] - np.float32(middle[1])
    along, across = (cv2.filter2D(light, -1, kernel) for kernel in (_GRADIENT, _GRADIENT.T))
    return np.stack([along, across, across * x - along * y])
