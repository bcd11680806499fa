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
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane

Motion = NDArray[np.float64]
"""3 x 3: where a place of the reference lies in a frame."""

STILL: Motion = np.eye(3)

_KEPT = 12  # of the frames, one in so many makes a first guess at a level
_FEWEST = 4  # frames that a level rests on: fewer are aligned with themselves
_NEAR = 0.1  # of the way from one level to the other: a place that is at one
_ASTRAY = 0.3  # px: edges of the scene that lie off by less are near, too
_LEAST_SPAN = 0.25  # of the light: a shadow takes as much at least
_FLOOR = 0.03  # of the bright places' light, whose noise dark places have at least
_AROUND = 15  # pixels: light that changes over more of them is not the scene's motion
_EDGE = 2  # pixels along the picture's rim that are left out: they come and go
_MOST = 5_000  # places that are looked at
_LEAST = 150  # places that tell anything
_ROUNDS = 10
_ENOUGH = 0.02  # px of a round's step
_PART = 1 / 32  # px: pictures are moved by multiples of it
_ANOTHER_LOOK = 0.1  # px of a step, after which other places may be near
_TRUSTED = 2.0  # deviations beyond which a difference counts less and less
_MEDIAN = 0.455  # of the square of a Gaussian of deviation 1
_UNSHARP = 0.2  # px: an edge that is drawn between pixels may be off by it
_NINTH = np.full((3, 3), 1 / 9, np.float32)
_GRADIENT = np.array([[-0.5, 0.0, 0.5]], np.float32)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Places of a picture that are near a level: where, the light that is expected there, and what
    a step in x, in y and a turn make of it (n, 3)."""

    at: NDArray[np.intp]
    light: NDArray[np.float32]
    slopes: NDArray[np.float32]


class Levels:
    """What a scene looks like in light and in shadow; linear light, small and grey; NaN where that
    is not known."""

    def __init__(self, lit: Plane, unlit: Plane) -> None:
        height, width = lit.shape
        self.middle = ((width - 1) / 2.0, (height - 1) / 2.0)
        self._levels = (lit, unlit)
        self._around = [_mean(x) for x in self._levels]
        self._slopes = [_slopes(x, self.middle) for x in self._levels]
        least = np.float32(_LEAST_SPAN) * np.abs(self._around[0])
        apart = self._around[0] - self._around[1]
        self._shaded = apart > least
        span = np.fmax(apart, least)
        self._near = [
            np.float32(_NEAR) * span + np.float32(_ASTRAY) * np.hypot(*_slopes(x, self.middle)[:2])
            for x in self._around
        ]
        seen = lit[np.isfinite(lit)]
        bright = float(np.quantile(seen, 0.95)) if seen.size else 0.0
        self._noisy = np.float32(_FLOOR * max(bright, 1e-3))
        self._inner = np.zeros((height, width), np.bool_)
        self._inner[_EDGE:-_EDGE, _EDGE:-_EDGE] = True

    @classmethod
    def guessed(cls, pictures: Sequence[Plane], motions: Sequence[Motion]) -> Levels:
        """From the brightest and the darkest of frames that have moved so."""
        placed = np.stack([back(p, m) for p, m in zip(pictures, motions, strict=True)])
        few = max(1, len(placed) // _KEPT)
        ends = []
        for sign in (-1.0, 1.0):
            first = np.where(np.isnan(placed), np.float32(np.inf), np.float32(sign) * placed)
            first = np.partition(first, few - 1, axis=0)[:few].mean(0) * np.float32(sign)
            ends.append(np.where(np.isfinite(first), first, np.float32(np.nan)))
        return cls(*ends)

    def gathered(self, pictures: Sequence[Plane], motions: Sequence[Motion]) -> Levels:
        """The means of what is near each level in frames that have moved so: it is neither noise
        nor an edge astray that makes them. Where `_FEWEST` frames are not, the level is not known.
        """
        sums = [np.zeros_like(x) for x in self._levels]
        counts = [np.zeros_like(x) for x in self._levels]
        for picture, motion in zip(pictures, motions, strict=True):
            placed = back(picture, motion)
            for k, near in enumerate(self._where(placed)):
                where = near & np.isfinite(placed)
                np.add(sums[k], placed, out=sums[k], where=where)
                counts[k] += where
        return Levels(
            *(
                np.divide(s, n, out=x.copy(), where=n >= _FEWEST)
                for s, n, x in zip(sums, counts, self._levels, strict=True)
            )
        )

    def _where(self, placed: Plane) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The places of a frame that are in light, and in shadow."""
        around = _mean(placed)
        lit, unlit = (
            np.abs(around - level) < near
            for level, near in zip(self._around, self._near, strict=True)
        )
        return lit, unlit & self._shaded & ~lit

    def place(
        self, picture: Plane, motion: Motion, only: NDArray[np.bool_] | None = None
    ) -> tuple[Motion, NDArray[np.float64]] | None:
        """The motion of a frame, found from one nearby, and its variance (3 x 3: px, px, radians);
        None where too few places tell. `only`: where to look."""
        inner = self._inner if only is None else self._inner & only
        variance = np.full((3, 3), np.inf)
        seen: _Seen | None = None
        for _ in range(_ROUNDS):
            motion = self._snapped(motion)
            placed = back(picture, motion)
            seen = seen or self._look(placed, inner)
            found = None if seen is None else self._step(placed, seen)
            if found is None:
                return None
            step, variance = found
            motion = motion @ inverse(rigid(step[0], step[1], step[2], self.middle))
            reach = self._reach(step)
            if reach < _ENOUGH:
                break
            if reach > _ANOTHER_LOOK:
                seen = None
        return motion, variance

    def _look(self, placed: Plane, inner: NDArray[np.bool_]) -> _Seen | None:
        """What is near its level in a frame."""
        parts = []
        for near, light, slopes in zip(
            self._where(placed), self._levels, self._slopes, strict=True
        ):
            where = near & inner & np.isfinite(light)
            at = np.flatnonzero(where)
            at = at[:: 1 + at.size // _MOST]
            if at.size < _LEAST:
                continue
            gain = _gain(placed, light, where)
            parts.append((at, (light * gain).ravel()[at], slopes.reshape(3, -1)[:, at].T))
        if not parts:
            return None
        return _Seen(*(np.concatenate([p[k] for p in parts]) for k in range(3)))

    def _step(
        self, placed: Plane, seen: _Seen
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """By what x, y and turn a frame lies off, and their variance."""
        off = placed.ravel()[seen.at] - seen.light
        known = np.isfinite(off) & np.isfinite(seen.slopes).all(1)
        off, light, design = off[known], seen.light[known], seen.slopes[known]
        if off.size < _LEAST:
            return None
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

    def _snapped(self, motion: Motion) -> Motion:
        """The motion by which OpenCV moves a picture when it is told to move it by another: where
        there is no turn to speak of, by whole parts of a pixel."""
        turn = abs(motion[1, 0]) * math.hypot(*self.middle)
        if turn > 0.5 * _PART:
            return motion
        moved = motion[:2] @ np.array([*self.middle, 1.0]) - self.middle
        x, y = np.round(moved / _PART) * _PART
        return shifted(float(x), float(y))

    def apart(self, one: Motion, other: Motion) -> float:
        """How far apart two motions bring the corner that they part most, px."""
        right, below = 2.0 * self.middle[0], 2.0 * self.middle[1]
        corners = np.array([[0, right, 0, right], [0, 0, below, below], [1, 1, 1, 1]])
        return float(np.hypot(*((one - other)[:2] @ corners)).max())

    def _reach(self, step: NDArray[np.float64]) -> float:
        return float(np.hypot(step[0], step[1]) + abs(step[2]) * math.hypot(*self.middle))


def shifted(x: float, y: float) -> Motion:
    """A motion without a turn."""
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def inverse(motion: Motion) -> Motion:
    """The motion back."""
    return np.asarray(np.linalg.inv(motion), np.float64)


def rigid(x: float, y: float, turn: float, middle: tuple[float, float]) -> Motion:
    """A shift and a turn about the middle of a picture, px and radians."""
    cos, sin = math.cos(turn), math.sin(turn)
    motion = np.eye(3)
    motion[:2, :2] = rotation = np.array([[cos, -sin], [sin, cos]])
    motion[:2, 2] = middle - rotation @ middle + np.array([x, y])
    return motion


def back(picture: Plane, motion: Motion) -> Plane:
    """A frame as it looks from where the reference was taken; NaN: it did not see that."""
    if np.array_equal(motion, STILL):
        return picture
    return np.asarray(
        cv2.warpAffine(
            picture,
            motion[:2],
            picture.shape[::-1],
            flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP,
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
