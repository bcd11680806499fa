"""How far the camera has moved since a scan began, told in frames in which a shadow moves.

A shadow's edges outshine the scene's texture, and a mesh's are everywhere: whatever follows edges
follows the mesh. But the shadow is not where the scene is: against the mean of earlier frames, in
which it is smeared out, it is noise, and its spectrum can be learned (a mesh's is a few lines).
Weighted by the inverse of that spectrum the correlation of a frame with the mean has its peak near
the camera's shift (Knapp and Carter's generalised correlation). It is taken of logarithms of light,
so that the source's strength does not matter. That tells the place to a quarter of a pixel and no
better, because what is left of the shadow pulls; from there `placing.Levels` finds the rest, and
the turn.

The first frames are the reference: they are aligned among themselves once they are all there, by
their correlation first, then round by round with the levels that they make, turns too. An exact
place that lies nowhere near the correlation's is not believed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.placing import Levels, Motion, inverse, rigid, shifted
from daemon.separation.radiometry import Plane, Response

LEAST_PX = 0.1
"""A shift below it is none: the frame is used as it is."""

MOST = 0.03
"""A shift beyond this part of the picture's longer side is not looked for."""

UNSURE_PX = 0.1
"""Where shifts are known no better (standard deviation), the scene has too little texture."""

REFERENCE = 48
"""Frames that the reference and the shadow's spectrum are learned from."""

FEWEST = 16
"""Of a recording that is shorter: so many tell something."""

Warp = tuple[float, float, float, float, float, float]
Spectrum = NDArray[np.complex64]

_WORK = 320  # longer side of the pictures that are compared
_LEAST_SIDE = 200  # small pixels of the longer side: in fewer a mesh's shadow passes for motion
_FLOOR = 0.03  # of the bright places: added to light, so that the dark ones' noise has no say
_FOLLOWED = 0.25  # of the differences: only a mesh that was taken for the scene explains so much
_SOFT = 0.5  # px: finer things interpolation moves by another way
_TAPER = 0.08  # part of the picture at each edge that fades out
_SHORTEST = (1, 16, 8, 4, 2, 1, 1, 1, 1)
"""Wavelengths, in small pixels, that count in each round of aligning the first frames: all, to see
whether they lie apart at all; then long ones first, which a shake leaves in the mean."""
_TOLD = 8.0  # deviations of a shift by which it is told from none: shadows make some large
_ALIKE = 1e-6  # of a spectrum: less than any noise makes, for frames that are all the same
_SETTLED = 0.15  # px: first frames that wander less from round to round lie apart as they do
_TILE = 16  # small pixels: halves of the picture are a checkerboard of such squares
_REFINED = 8  # rounds in which the first frames are placed
_STIRRED = 0.02  # px: first frames that wander less from round to round are placed
_ASTRAY = 1.5  # small px from where the correlation found a frame
_MANY_ASTRAY = 0.25  # of the first frames: then it is not the scene that is followed
_SAMPLED = 6  # every so many of the first frames show how far the halves agree

_PEAK = 5.0  # deviations of the correlation by which a peak is told from chance
_GREY = np.full((1, 3), 1 / 3, np.float32)
_SHARE = 0.35  # of the height that the reference's own peak has


@dataclass(frozen=True, slots=True)
class Place:
    """Where a frame was taken from: how far its middle is shifted against the reference's (`x`,
    `y`, pixels) and how far the frame is turned (radians). `px` is how far the corner moved that
    moved most; up to `least` that is not told from standing still. `found`: the place is known as
    well as `UNSURE_PX` asks."""

    x: float
    y: float
    turn: float = 0.0
    px: float = 0.0
    least: float = 0.0
    found: bool = True
    middle: tuple[float, float] = (0.0, 0.0)

    @property
    def warp(self) -> Warp | None:
        """What takes the frame back to the reference; None: it lies there."""
        if self.px <= self.least:
            return None
        if not self.turn:
            return (1.0, 0.0, -self.x, 0.0, 1.0, -self.y)
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        x, y = self.middle
        from_x, from_y = x + self.x, y + self.y
        return (
            cos,
            sin,
            round(x - cos * from_x - sin * from_y, 4),
            -sin,
            cos,
            round(y + sin * from_x - cos * from_y, 4),
        )


class Registration:
    """Finds each frame's place. Deterministic; memory: `REFERENCE` small pictures at most."""

    def __init__(self, response: Response, *, mesh: bool = False) -> None:
        """With `mesh` the shadow is a pattern that is alike everywhere, and could be followed."""
        self._response = response
        self._mesh = mesh
        self._explained = 0.0  # part of the first frames' differences that their shifts take away
        self._astray = 0.0  # part of the first frames whose exact place is not confirmed
        self._first: list[Plane] = []
        self._levels: Levels | None = None  # None: there is no reference yet
        self._matched: Spectrum = np.zeros((0, 0), np.complex64)  # over the shadow's spectrum
        self._coarse_sd = math.inf
        self._noise = 1.0  # deviation of the correlation by chance
        self._factor = 1
        self._full = (0, 0)
        self._shape = (0, 0)
        self._waves: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._window: Plane | None = None
        self.sd = math.inf
        """The standard deviation of a shift, px; inf before a reference is there."""
        self.wandered = 0.0
        """How far the first frames lay from the middle of all, px."""

    def suits(self, shape: tuple[int, ...]) -> bool:
        """Whether pictures of a shape are large enough to be asked; `tells` knows more."""
        return max(shape[:2]) // self._reduced(shape) >= _LEAST_SIDE

    def _reduced(self, shape: tuple[int, ...]) -> int:
        even = 2 if self._response.bayer else 1
        return even * max(1, -(-max(shape[:2]) // (_WORK * even)))

    @property
    def learned(self) -> bool:
        """Whether there is a reference."""
        return self._levels is not None

    @property
    def tells(self) -> bool:
        """Whether the scene has texture enough for places to be known."""
        return self._seen and self.sd < UNSURE_PX and self._astray < _MANY_ASTRAY

    @property
    def _seen(self) -> bool:
        """Whether the correlation sees the scene, and not the mesh."""
        followed = self._mesh and self._explained > _FOLLOWED
        return self._coarse_sd < UNSURE_PX and not followed

    def learn(self, pixels: NDArray[Any]) -> None:
        """Take in a frame for the reference; the last of `REFERENCE` ones makes it."""
        if self._levels is not None:
            return
        if self._window is None:
            self._prepare(pixels.shape)
        self._first.append(self._small(pixels))
        if len(self._first) == REFERENCE:
            self.settle()

    def settle(self) -> None:
        """Make the reference of the frames there are; of fewer than `FEWEST` there is none."""
        if self._levels is None and len(self._first) >= FEWEST:
            self._settle()
            self._first.clear()

    def of(self, pixels: NDArray[Any], strength: float = 1.0) -> Place:
        """The place of a frame, in which the source has about that strength. Raises ValueError
        before a reference is there."""
        if self._levels is None:
            raise ValueError("there is no reference yet")
        small = self._small(pixels)
        x, y, height = self._find(self._spectrum(small), self._matched)
        found = height > max(_PEAK, _SHARE * self._noise) * self._noise
        near = shifted(x, y)
        exact = self._levels.place(small / np.float32(strength), near) if found else None
        if exact is None or not self._confirmed(exact[0], near):
            return self._place(near, False)
        motion, variance = exact
        place = self._place(motion, self._factor * _spread(variance) < UNSURE_PX)
        if place.found and place.warp is not None:
            apart = self._apart(small / np.float32(strength), motion)
            place = replace(place, found=apart is not None and apart < 2.0 * place.least)
        return place

    def _apart(self, picture: Plane, motion: Motion) -> float | None:
        """How far two halves of a picture, a checkerboard's squares, put it apart, px; None: one of
        them tells nothing."""
        assert self._levels is not None
        rows, columns = np.indices(picture.shape) // _TILE
        odd = (rows + columns) % 2 == 1
        one, other = (self._levels.place(picture, motion, half) for half in (odd, ~odd))
        if one is None or other is None:
            return None
        return self._factor * float(np.hypot(*(self._off(one[0]) - self._off(other[0]))))

    def _place(self, motion: Motion, found: bool) -> Place:
        """In pixels of the frame. A turn that no pixel feels is none."""
        assert self._levels is not None
        moved = motion[:2] @ np.array([*self._levels.middle, 1.0]) - self._levels.middle
        x, y = (round(float(v) * self._factor, 3) for v in moved)
        turn = round(math.atan2(motion[1, 0], motion[0, 0]), 7)
        height, width = self._full
        middle = ((width - 1) / 2.0, (height - 1) / 2.0)
        swung = abs(turn) * math.hypot(*middle)
        least = max(LEAST_PX, _TOLD * self.sd) if math.isfinite(self.sd) else LEAST_PX
        if swung <= least:
            turn = swung = 0.0
        return Place(x, y, turn, math.hypot(x, y) + swung, least, found, middle)

    # ------------------------------------------------------------ pictures

    def _prepare(self, shape: tuple[int, ...]) -> None:
        self._factor = self._reduced(shape)
        height, width = (n // self._factor // 2 * 2 for n in shape[:2])
        self._shape = (height, width)
        self._full = (height * self._factor, width * self._factor)
        self._window = _fading(height)[:, None] * _fading(width)[None, :]
        rows, columns = np.fft.fftfreq(height), np.fft.rfftfreq(width)
        self._waves = np.asarray(2 * np.pi * rows), np.asarray(2 * np.pi * columns)

    def _small(self, pixels: NDArray[Any]) -> Plane:
        """A small grey picture of a frame's light."""
        height, width = self._shape
        factor = self._factor
        small = pixels[: height * factor, : width * factor]
        if factor > 1:
            small = cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA)
        grey: Plane = small.astype(np.float32)
        if grey.ndim == 3:
            grey = np.asarray(cv2.transform(grey, _GREY), np.float32)
        light = self._response.linear_between(grey)
        return np.asarray(cv2.GaussianBlur(light, (3, 3), _SOFT), np.float32)

    def _spectrum(self, grey: Plane) -> Spectrum:
        """Of the logarithm of a small picture."""
        assert self._window is not None
        floor = np.float32(_FLOOR * max(float(np.quantile(grey[::4, ::4], 0.95)), 1e-3))
        log = np.log(np.maximum(grey, 0) + floor)
        spectrum = np.fft.rfft2((log - log.mean()) * self._window).astype(np.complex64)
        spectrum[0, 0] = 0
        return spectrum

    # ------------------------------------------------------------ the reference

    def _settle(self) -> None:
        """Align the first frames among themselves, and learn what the shadow makes of them."""
        count = len(self._first)
        spectra = [self._spectrum(small) for small in self._first]
        shifts = np.zeros((count, 2))
        assert self._waves is not None
        wave = np.hypot(self._waves[0][:, None], self._waves[1][None, :]) / (2 * np.pi)
        for shortest in _SHORTEST:
            seen = wave * shortest <= 1.0
            before = shifts.copy()
            moved = [self._moved(s, *d) for s, d in zip(spectra, shifts, strict=True)]
            total = np.sum(moved, axis=0)
            mean = total / count
            shadow = np.mean([np.abs(s - mean) ** 2 for s in moved], axis=0) * count / (count - 1)
            shadow += np.maximum(0.05 * np.median(shadow), np.float32(_ALIKE))
            for k, spectrum in enumerate(spectra):
                others = (total - moved[k]) / (count - 1)
                x, y, _ = self._find(spectrum, (seen * others / shadow).astype(np.complex64))
                shifts[k] = x, y
            shifts -= np.median(shifts, axis=0)
            change = np.abs(shifts - before).max() * self._factor
            if shortest == 1 and change < _SETTLED:
                break
        moved = [self._moved(s, *d) for s, d in zip(spectra, shifts, strict=True)]
        mean = np.mean(moved, axis=0)
        shadow = np.mean([np.abs(s - mean) ** 2 for s in moved], axis=0) * count / (count - 1)
        shadow += np.maximum(0.05 * np.median(shadow), np.float32(_ALIKE))
        signal = np.maximum(np.abs(mean) ** 2 - shadow / count, 0.0)  # the mean has shadow, too
        self._matched = (mean / shadow).astype(np.complex64)
        self._noise = math.sqrt(_both(np.abs(mean) ** 2 / shadow))
        curvature = self._information(signal / shadow)
        if np.linalg.det(curvature) > 0.0:
            self._coarse_sd = self._factor * math.sqrt(float(np.trace(np.linalg.inv(curvature))))
        unaligned = np.mean([np.abs(s - np.mean(spectra, axis=0)) ** 2 for s in spectra], 0)
        self._explained = 1.0 - _both(shadow) / max(_both(unaligned), 1e-9)
        motions = self._place_first([shifted(*d) for d in shifts])
        self.wandered = max(self._place(motion, True).px for motion in motions)

    def _place_first(self, motions: list[Motion]) -> list[Motion]:
        """Make the levels that all others are placed by, of the first frames, which have moved
        about so, and see how well two halves of the picture agree about these. Their motions."""
        levels = self._levels = Levels.guessed(self._first, motions)
        sure = [True] * len(motions)
        if not self._seen:
            return motions
        for _ in range(_REFINED):
            levels = self._levels = levels.gathered(
                list(compress(self._first, sure)), list(compress(motions, sure))
            )
            before = motions
            motions, sure = self._placed(levels, motions)
            stirred = [levels.apart(*pair) for pair in zip(before, motions, strict=True)]
            if self._factor * float(np.median(stirred)) < _STIRRED:
                break
        self._astray = 1.0 - sum(sure) / len(sure)
        known = list(compress(zip(self._first, motions, strict=True), sure))
        apart = [px for px in (self._apart(*pair) for pair in known[::_SAMPLED]) if px is not None]
        if apart:
            # of both halves together the deviation is half of their difference's
            self.sd = math.sqrt(float(np.mean(np.square(apart)))) / 2.0
        return motions

    def _placed(self, levels: Levels, near: list[Motion]) -> tuple[list[Motion], list[bool]]:
        """The first frames' motions, found from ones that are `near`, and whether they are
        confirmed by these; the middle one's is none."""
        found = [levels.place(p, m) for p, m in zip(self._first, near, strict=True)]
        motions, sure = [], []
        for one, before in zip(found, near, strict=True):
            lies = one is not None and self._confirmed(one[0], before)
            motions.append(one[0] if one is not None and lies else before)
            sure.append(lies)
        turns = [math.atan2(m[1, 0], m[0, 0]) for m in motions]
        x, y = np.median([self._off(m) for m in motions], axis=0)
        middle = inverse(rigid(float(x), float(y), float(np.median(turns)), levels.middle))
        return [m @ middle for m in motions], sure

    def _confirmed(self, exact: Motion, near: Motion) -> bool:
        """Whether a motion is the one that the correlation found: else it has gone astray."""
        return float(np.hypot(*(self._off(exact) - self._off(near)))) < _ASTRAY

    def _off(self, motion: Motion) -> NDArray[np.float64]:
        """By how much the middle of a small picture is shifted."""
        assert self._levels is not None
        middle = np.array(self._levels.middle)
        shift: NDArray[np.float64] = motion[:2, :2] @ middle + motion[:2, 2] - middle
        return shift

    def _information(self, ratio: NDArray[Any]) -> NDArray[np.float64]:
        """What spectra of such a ratio of signal to noise tell of a shift (Fisher's), px^-2."""
        assert self._waves is not None
        fy, fx = self._waves[0][:, None], self._waves[1][None, :]
        xx, xy, yy = (float(_both(ratio * a * b)) for a, b in ((fx, fx), (fx, fy), (fy, fy)))
        return np.array([[xx, xy], [xy, yy]])

    # ------------------------------------------------------------ a frame

    def _moved(self, spectrum: Spectrum, x: float, y: float) -> NDArray[np.complex64]:
        """The spectrum of a picture moved back by a shift."""
        assert self._waves is not None
        fy, fx = self._waves
        turned = np.exp(1j * fy * y)[:, None] * np.exp(1j * fx * x)[None, :]
        return np.asarray(spectrum * turned, np.complex64)

    def _find(self, spectrum: Spectrum, matched: Spectrum) -> tuple[float, float, float]:
        """Where the correlation is highest, x and y in small pixels, and how high."""
        cross = spectrum * np.conj(matched)
        height, width = self._shape
        surface = np.fft.irfft2(cross, s=self._shape) * (height * width)
        reach = max(2, round(MOST * max(self._shape)))
        rows, columns = (np.arange(-reach, reach + 1) % n for n in self._shape)
        inner = surface[np.ix_(rows[1:-1], columns[1:-1])]
        top, left = np.unravel_index(int(np.argmax(inner)), inner.shape)
        near = surface[np.ix_(rows[top : top + 3], columns[left : left + 3])]
        (x, over_x), (y, over_y) = _vertex(near[1]), _vertex(near[:, 1])
        height_there = float(near[1, 1]) + over_x + over_y
        return x + float(left) + 1 - reach, y + float(top) + 1 - reach, height_there


def _fading(length: int) -> Plane:
    """A window that rises and falls as half a cosine at its ends."""
    edge = max(2, round(_TAPER * length))
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(edge) + 0.5) / edge)
    window = np.ones(length, np.float32)
    window[:edge], window[-edge:] = rise, rise[::-1]
    return window


def _vertex(three: NDArray[Any]) -> tuple[float, float]:
    """Where a parabola through three heights, a peak's, is highest, and by how much more."""
    before, peak, after = (float(v) for v in three)
    bend = 2.0 * peak - before - after
    if bend <= 0.0:
        return 0.0, 0.0
    at = (after - before) / (2.0 * bend)
    return at, 0.5 * bend * at * at


def _both(half: NDArray[Any]) -> float:
    """The sum over a whole spectrum of which half is given."""
    return float(2.0 * half.sum() - half[:, 0].sum() - half[:, -1].sum())


def _spread(variance: NDArray[np.float64]) -> float:
    """The deviation of a shift, small pixels."""
    return math.sqrt(float(variance[0, 0] + variance[1, 1]))
