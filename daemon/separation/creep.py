"""Whether the camera, or the scene as a whole, moved while a fixed set of patterns was shown.

Under a white frame a scene shows its texture, and so it does in the sum of patterns that light
every place alike. A few patterns in a row, summed, are that texture and what is left of theirs,
which knows nothing of it: what it adds to the motion that the texture tells is noise, as large as
the small blocks of the picture differ about that motion.

The motion is a shift and a turn, by Lucas and Kanade's least squares over small blocks all over the
picture, of which each has its own brightness and offset: light that changes moves nothing, and a
pattern that is even over a block has no say. Blocks that agree badly (a person walked by) count
less and less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.deviation import NOISE
from daemon.separation.estimator import Components, Lighting, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, bits, count
from daemon.separation.radiometry import Plane, Response

Double = NDArray[np.float64]

_WINDOW = 48  # pixels across that are looked at ...
_ACROSS = 8  # ... at so many places each way
_BLOCK = 16  # pixels across that have a brightness of their own
_MARGIN = 8  # of a window, which a motion or a blur takes from elsewhere
_SMOOTH = 1.0  # pixels: slopes of single pixels are noise
_GROUPS = 6
_FEWEST = 2  # patterns whose sum tells texture from pattern
_BLOCKS = 24  # at least, to tell how much they differ
_WHITE = -1
_ROUNDS, _WEIGHED = 6, 8
_ENOUGH = 0.02  # px of a round's step
_TOLD = 5.0  # deviations by which a motion is told from none
_LEAST_PX = 0.1  # less spoils nothing
_PART = 0.1  # of the light: a difference of as much, and more than noise, is marked
_UNSURE_PX = 0.5  # a motion that is known no better (standard deviation) is not known


@dataclass(frozen=True, slots=True)
class Crept:
    """How far the corner of the picture that moved most did, in pixels: `within` the patterns, and
    `before`, from the white frame to the patterns' mean; 0: not told from none."""

    within: float
    before: float


class Creep:
    """Sums of windows of the picture over patterns in a row; constant memory."""

    def __init__(self, response: Response, patterns: int, *, balanced: bool) -> None:
        """`balanced`: the patterns together light every place alike, and are no shifts of one: what
        is left of a pattern that shifts, moves. Of others only a white frame shows the scene."""
        self._response = response
        self._balanced = balanced
        self._each = max(_FEWEST, -(-patterns // _GROUPS))  # patterns in a row that are summed
        self._sums: dict[int, Double] = {}  # of each group; _WHITE: of white
        self._frames: dict[int, int] = {}
        self._patterns: dict[int, set[int]] = {}  # the patterns of each group
        self._shape: tuple[int, ...] = ()
        self._texture: _Texture | None = None  # of white, when patterns have begun
        self._moved: dict[int, _Motion | None] = {}  # of groups that are whole, against it

    def add(self, pixels: NDArray[Any], observation: Observation) -> None:
        """Take in a frame that is used."""
        if observation.lighting is Lighting.PATTERN:
            group = observation.pattern // self._each
        elif observation.lighting is Lighting.WHITE:
            group = _WHITE
        else:
            return
        self._shape = pixels.shape[:2]
        windows = self._cut(pixels)
        if group == _WHITE:
            self._texture = None
            self._moved.clear()
        if group not in self._sums:
            self._sums[group] = np.zeros(windows.shape)
            self._frames[group] = 0
            self._patterns[group] = set()
        self._moved.pop(group, None)
        self._sums[group] += windows
        self._frames[group] += 1
        self._patterns[group].add(observation.pattern)
        if observation.last and len(self._patterns[group]) == self._each:
            self._look(group)

    def _look(self, group: int) -> None:
        """What a whole group tells, before the last frame: a result must not wait for it."""
        if _WHITE not in self._sums or group == _WHITE:
            return
        if self._texture is None:
            self._texture = _Texture.of(self._mean(_WHITE), self._arms())
        if self._texture is not None:
            self._moved[group] = self._texture.motion_of(self._mean(group))

    @property
    def _step(self) -> int:
        return 2 if self._response.bayer else 1  # a mosaic's four pixels are one

    def _corners(self) -> tuple[list[tuple[int, int]], int]:
        """Where windows begin, and their side, in pixels of the frame."""
        step = self._step
        side = _WINDOW * step
        places = []
        for length in self._shape:
            count = min(_ACROSS, length // side)
            first = np.linspace(0, length - side, count).tolist() if count > 0 else []
            places.append([int(n) // step * step for n in first])
        return [(y, x) for y in places[0] for x in places[1]], side

    def _cut(self, pixels: NDArray[Any]) -> Plane:
        corners, side = self._corners()
        found = np.empty((len(corners), _WINDOW, _WINDOW), dtype=np.float32)
        for n, (y, x) in enumerate(corners):
            light = self._response.linear(np.ascontiguousarray(pixels[y : y + side, x : x + side]))
            grey = light if light.ndim == 2 else light.mean(axis=2)
            if self._step == 2:
                grey = cv2.resize(grey, (_WINDOW, _WINDOW), interpolation=cv2.INTER_AREA)
            found[n] = grey
        return found

    def told(self) -> Crept | None:
        """How far the picture moved; None: too little of it tells."""
        groups = sorted(self._sums.keys() - {_WHITE})
        if not groups or not (self._balanced or _WHITE in self._sums):
            return None
        mean = self._mean(*groups)
        texture = self._texture
        if texture is None:
            shown = self._mean(_WHITE) if _WHITE in self._sums else mean
            texture = _Texture.of(shown, self._arms())
        if texture is None:
            return None
        before = self._corner_px(texture.motion_of(mean)) if _WHITE in self._sums else 0.0
        of_groups = (
            self._moved[group] if group in self._moved else texture.motion_of(self._mean(group))
            for group in groups
            if len(self._patterns[group]) >= _FEWEST
        )
        found = [motion for motion in of_groups if motion is not None]
        within = [
            self._corner_px(_Motion(one.step - other.step, one.variance + other.variance))
            for n, one in enumerate(found)
            for other in found[:n]
        ]
        return Crept(max(within, default=0.0), before)

    def _mean(self, *groups: int) -> Plane:
        total = np.sum([self._sums[group] for group in groups], axis=0)
        return _smooth(total / sum(self._frames[group] for group in groups))

    def _arms(self) -> Double:
        """What a step in x, in y, and a turn (px at the corner) move each window by (n, 2, 3)."""
        corners, side = self._corners()
        height, width = self._shape
        reach = math.hypot(height, width) / 2.0
        arms = np.zeros((len(corners), 2, 3))
        arms[:, 0, 0] = arms[:, 1, 1] = 1.0
        for arm, (y, x) in zip(arms, corners, strict=True):
            arm[0, 2] = -(y + side / 2.0 - height / 2.0) / reach
            arm[1, 2] = (x + side / 2.0 - width / 2.0) / reach
        return arms

    def _corner_px(self, motion: _Motion | None) -> float:
        if motion is None or not motion.told:
            return 0.0
        px = self._step * (math.hypot(*motion.step[:2]) + abs(float(motion.step[2])))
        return px if px > _LEAST_PX else 0.0


@dataclass(frozen=True, slots=True)
class _Motion:
    """x, y, turn (px), and their variance (3 x 3)."""

    step: Double
    variance: Double

    @property
    def told(self) -> bool:
        """Whether it is told from none."""
        if float(np.sqrt(np.max(np.diag(self.variance)))) > _UNSURE_PX:
            return False
        try:
            off = float(self.step @ np.linalg.solve(self.variance, self.step))
        except np.linalg.LinAlgError:  # frames that are all the same
            return False
        return off > 3.0 * _TOLD**2  # of three figures


@dataclass(frozen=True, slots=True)
class _Texture:
    """The scene's windows, and by blocks (n, pixels, 3) what a motion makes of them, that which a
    block's brightness and offset (`flat`, orthonormal) explain taken out."""

    windows: Plane
    arms: Double
    blocks: Double
    design: Double
    flat: Double
    normal: Double

    @classmethod
    def of(cls, windows: Plane, arms: Double) -> _Texture | None:
        """None: too few blocks."""
        blocks = _blocks(windows)
        each = len(blocks) // max(len(windows), 1)
        if len(blocks) < _BLOCKS:
            return None
        along, across = (np.zeros_like(windows) for _ in range(2))
        along[:, :, 1:-1] = (windows[:, :, 2:] - windows[:, :, :-2]) * np.float32(0.5)
        across[:, 1:-1] = (windows[:, 2:] - windows[:, :-2]) * np.float32(0.5)
        slopes = np.stack([-_blocks(along), -_blocks(across)], axis=-1)
        flat, _ = np.linalg.qr(np.stack([np.ones_like(blocks), blocks], axis=-1))
        design = slopes @ np.repeat(arms, each, axis=0)
        design -= flat @ (flat.transpose(0, 2, 1) @ design)
        return cls(windows, arms, blocks, design, flat, design.transpose(0, 2, 1) @ design)

    def motion_of(self, windows: Plane) -> _Motion | None:
        """Of other windows against these; None where nothing tells of it."""
        first = self._step(windows)
        if first is None or not first.told:
            return first
        at, found = first.step, first
        for _ in range(_ROUNDS):
            step = self._step(self._moved(windows, at))
            if step is None:
                return None
            at = at + step.step
            found = _Motion(at, step.variance)
            if float(np.abs(step.step).max()) < _ENOUGH:
                break
        return found

    def _step(self, windows: Plane) -> _Motion | None:
        off = (_blocks(windows) - self.blocks)[..., None]
        off -= self.flat @ (self.flat.transpose(0, 2, 1) @ off)
        wanted = (self.design.transpose(0, 2, 1) @ off)[..., 0]
        squares = np.square(off[..., 0]).sum(axis=1)
        weight = np.ones(len(wanted))
        try:
            for _ in range(_WEIGHED):
                normal = np.einsum("t,tij->ij", weight, self.normal)
                step = np.linalg.solve(normal, weight @ wanted)
                left = squares - 2.0 * wanted @ step + (self.normal @ step) @ step
                left = np.maximum(left, 0.0)
                weight = 1.0 / (left + 0.5 * np.median(left) + 1e-12)
            # as the blocks themselves differ, whatever makes them
            error = (wanted - self.normal @ step) * weight[:, None]
            inverse = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return None
        return _Motion(step, inverse @ (error.T @ error) @ inverse)

    def _moved(self, windows: Plane, by: Double) -> Plane:
        placed = [
            cv2.warpAffine(
                window,
                np.array([[1.0, 0.0, x], [0.0, 1.0, y]]),
                window.shape[::-1],
                flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REFLECT,
            )
            for window, (x, y) in zip(windows, self.arms @ by, strict=True)
        ]
        return np.asarray(np.stack(placed), dtype=np.float32)


def marked(components: Components, crept: Crept | None) -> tuple[Components, list[str]]:
    """Components of a picture that moved: MOVED where its light changes over so many pixels by
    more than noise, which the deviations hold as well; facts `moved_px`; and lines of advice."""
    if crept is None:
        return components, []
    facts = {
        **components.facts,
        "moved_px": {"patterns": round(crept.within, 2), "references": round(crept.before, 2)},
    }
    lines = []
    if crept.before > crept.within:
        lines.append(
            f"the picture moved by {crept.before:.1f} px between the white frame and the middle of "
            "the patterns: what follows from both is wrong at edges: keep camera and scene still, "
            "and scan again"
        )
    quality, planes = components.quality, components.planes
    if crept.within:
        apart = _apart(components, crept.within)
        noise = planes.get("direct_std")
        limit = np.float32(_PART) * np.abs(components.direct + components.global_)
        if noise is not None:
            limit = np.maximum(limit, np.float32(SIGNIFICANT) * noise)
        off = apart > limit
        # of colours most: a weak one is noisy
        off = off if off.ndim == 2 else np.count_nonzero(off, axis=2) * 2 > off.shape[2]
        quality = quality | bits(off, Quality.MOVED)
        facts["quality"] = count(quality)
        planes = {
            name: np.hypot(plane, apart * np.float32(0.5)) if name in NOISE else plane
            for name, plane in planes.items()
        }
        lines.append(
            f"the picture moved by {crept.within:.1f} px while the patterns were shown: at edges "
            f"({float(off.mean()):.1%} of the pixels, marked as moved) components are mixed of "
            "what lies beside: keep camera and scene still, and scan again"
        )
    return replace(components, quality=quality, planes=planes, facts=facts), lines


def _apart(components: Components, px: float) -> Plane:
    """By how much light differs over a motion about each pixel: a frame's shape, float32."""
    light = np.nan_to_num(components.direct + components.global_)
    calm = cv2.blur(light, (3, 3))
    kernel = np.ones((2 * math.ceil(px / 2.0) + 1,) * 2, np.uint8)
    apart = cv2.dilate(calm, kernel) - cv2.erode(calm, kernel)
    return np.asarray(apart, dtype=np.float32)


def _smooth(windows: NDArray[Any]) -> Plane:
    if not windows.size:  # the picture is smaller than one
        return windows.astype(np.float32)
    stacked = windows.astype(np.float32).reshape(-1, windows.shape[2])  # margins keep them apart
    blurred = cv2.GaussianBlur(stacked, (0, 0), _SMOOTH)
    return np.asarray(blurred, dtype=np.float32).reshape(windows.shape)


def _blocks(windows: Plane) -> Double:
    """The inner blocks of windows: (n, pixels)."""
    inner = windows[:, _MARGIN:-_MARGIN, _MARGIN:-_MARGIN].astype(np.float64)
    each = inner.shape[1] // _BLOCK
    tiles = inner.reshape(len(inner), each, _BLOCK, each, _BLOCK).transpose(0, 1, 3, 2, 4)
    return tiles.reshape(len(inner) * each * each, _BLOCK * _BLOCK)
