"""How far the camera has moved since a scan began, told in frames in which a shadow moves.

A shadow's edges outshine the scene's texture, and a mesh's are everywhere: whatever follows edges
follows the mesh. But the shadow is not where the scene is: against the mean of earlier frames, in
which it is smeared out, it is noise, and its spectrum can be learned (a mesh's is a few lines).
Weighted by the inverse of that spectrum the correlation of a frame with the mean has its peak near
the camera's shift (Knapp and Carter's generalised correlation). It is taken of logarithms of light,
so that the source's strength does not matter. That tells the place to a quarter of a pixel and no
better, because what is left of the shadow pulls; from there `placing.Levels` finds the rest, and
the turn.

The first frames are the reference: they are aligned among themselves once they are all there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.placing import Levels, Motion, shifted
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
_LEAST_SIDE = 200  # small pixels of the longer side
_FLOOR = 0.03  # of the bright places: added to light, so that the dark ones' noise has no say
_FOLLOWED = 0.25  # of the differences: only a mesh that was taken for the scene explains so much
_TAPER = 0.08  # part of the picture at each edge that fades out
_SHORTEST = (1, 16, 8, 4, 2, 1, 1, 1, 1)
"""Wavelengths, in small pixels, that count in each round of aligning the first frames: all, to see
whether they lie apart at all; then long ones first, which a shake leaves in the mean."""
_TOLD = 8.0  # deviations of a shift by which it is told from none: shadows make some large
_ALIKE = 1e-6  # of a spectrum: less than any noise makes, for frames that are all the same
_SETTLED = 0.15  # px: first frames that wander less from round to round lie apart as they do
_TILE = 16  # small pixels: halves of the picture are a checkerboard of such squares
_SAMPLED = 6  # every so many of the first frames show how far the halves agree

_STEPS = 6  # of refining a peak
_PEAK = 5.0  # deviations of the correlation by which a peak is told from chance
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
        """Whether pictures of a shape are large enough: in tiny ones a fine mesh is all texture."""
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
        followed = self._mesh and self._explained > _FOLLOWED
        return max(self.sd, self._coarse_sd) < UNSURE_PX and not followed

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
        if exact is None:
            return self._place(near, False)
        motion, variance = exact
        return self._place(motion, self._factor * _spread(variance) < UNSURE_PX)

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
        grey = small.astype(np.float32) if small.ndim == 2 else small.mean(2, dtype=np.float32)
        return self._response.linear_between(grey)

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
        self._place_first([shifted(*d) for d in shifts])
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
        self.wandered = float(np.hypot(*shifts.T).max()) * self._factor

    def _place_first(self, motions: list[Motion]) -> None:
        """Make the levels that all others are placed by, of the first frames, which have moved so,
        and see how well two halves of the picture agree about these."""
        self._levels = levels = Levels(self._first, motions)
        rows, columns = np.indices(self._first[0].shape) // _TILE
        odd = (rows + columns) % 2 == 1
        apart = []
        for picture, motion in list(zip(self._first, motions, strict=True))[::_SAMPLED]:
            halves = [levels.place(picture, motion, half) for half in (odd, ~odd)]
            one, other = (None if half is None else self._off(half[0]) for half in halves)
            if one is not None and other is not None:
                apart.append(one - other)
        if apart:
            # of both halves together the deviation is half of their difference's
            self.sd = self._factor * float(np.sqrt(np.mean(np.square(apart)) * 2.0)) / 2.0

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
        near = surface[np.ix_(rows, columns)]
        at_y, at_x = np.unravel_index(int(np.argmax(near)), near.shape)
        x, y = float(at_x) - reach, float(at_y) - reach
        return self._refined(cross, x, y)

    def _refined(self, cross: NDArray[Any], x: float, y: float) -> tuple[float, float, float]:
        """The peak of the correlation near a whole pixel, by Newton's steps."""
        assert self._waves is not None
        fy, fx = self._waves
        begin = np.array([x, y])
        at = begin.copy()
        height = 0.0
        twice = np.full(fx.size, 2.0)  # half of the spectrum stands for all
        twice[0] = twice[-1] = 1.0
        for _ in range(_STEPS):
            along = np.exp(1j * fx * at[0]) * twice
            across = np.exp(1j * fy * at[1])
            # sums over x first: rows of 1, fx, fx²
            inner = cross @ np.stack([along, fx * along, fx * fx * along], axis=1)
            sums = np.stack([across, fy * across, fy * fy * across]) @ inner
            height = float(sums[0, 0].real)
            slope = -np.array([sums[0, 1].imag, sums[1, 0].imag])
            bend = -np.array(
                [[sums[0, 2].real, sums[1, 1].real], [sums[1, 1].real, sums[2, 0].real]]
            )
            if bend[0, 0] >= 0.0 or np.linalg.det(bend) <= 0.0:
                break
            step = -np.linalg.solve(bend, slope)
            at += np.clip(step, -0.5, 0.5)
            if np.abs(step).max() < 1e-3:
                break
        if np.abs(at - begin).max() > 1.5:
            return float(begin[0]), float(begin[1]), height
        return float(at[0]), float(at[1]), height


def _fading(length: int) -> Plane:
    """A window that rises and falls as half a cosine at its ends."""
    edge = max(2, round(_TAPER * length))
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(edge) + 0.5) / edge)
    window = np.ones(length, np.float32)
    window[:edge], window[-edge:] = rise, rise[::-1]
    return window


def _both(half: NDArray[Any]) -> float:
    """The sum over a whole spectrum of which half is given."""
    return float(2.0 * half.sum() - half[:, 0].sum() - half[:, -1].sum())


def _spread(variance: NDArray[np.float64]) -> float:
    """The deviation of a shift, small pixels."""
    return math.sqrt(float(variance[0, 0] + variance[1, 1]))
