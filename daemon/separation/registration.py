"""How far the camera has moved since a scan began, told in frames in which a shadow moves.

A shadow's edges outshine the scene's texture, and a mesh's are everywhere: whatever follows edges
follows the mesh. But the shadow is not where the scene is: against the mean of earlier frames, in
which it is smeared out, it is noise, and its spectrum can be learned (a mesh's is a few lines).
Weighted by the inverse of that spectrum the correlation of a frame with the mean has its peak at
the camera's shift: the most likely one, with a variance that the spectra tell beforehand (Knapp and
Carter's generalised correlation). Pictures are logarithms of light, so that the source's strength
does not matter. Only shifts are looked for: a camera on a tripod hardly turns.

The first frames are the reference: they are aligned among themselves once they are all there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane, Response

LEAST_PX = 0.3
"""A shift below it is none: the frame is used as it is."""

MOST = 0.03
"""A shift beyond this part of the picture's longer side is not looked for."""

UNSURE_PX = 0.1
"""Where shifts are known no better (standard deviation), the scene has too little texture."""

REFERENCE = 48
"""Frames that the reference and the shadow's spectrum are learned from."""

Warp = tuple[float, float, float, float, float, float]
Spectrum = NDArray[np.complex64]

_WORK = 320  # longer side of the pictures that are compared
_LEAST_SIDE = 200
_FLOOR = 0.03  # of the bright places: added to light, so that the dark ones' noise has no say
_FOLLOWED = 0.25  # of the differences: only a mesh that was taken for the scene explains so much
_TAPER = 0.08  # part of the picture at each edge that fades out
_SHORTEST = (1, 16, 8, 4, 2, 1, 1, 1, 1)
"""Wavelengths, in small pixels, that count in each round of aligning the first frames: all, to see
whether they lie apart at all; then long ones first, which a shake leaves in the mean."""
_SAMPLED = 6  # every so many of the first frames show how far halves of the waves agree

_STEPS = 6  # of refining a peak
_PEAK = 5.0  # deviations of the correlation by which a peak is told from chance
_SHARE = 0.35  # of the height that the reference's own peak has


@dataclass(frozen=True, slots=True)
class Shift:
    """A frame's shift against the reference, in pixels; `found`: the correlation has a peak."""

    x: float
    y: float
    found: bool = True

    @property
    def px(self) -> float:
        """How far."""
        return math.hypot(self.x, self.y)

    @property
    def warp(self) -> Warp:
        """What takes the frame back to the reference."""
        return (1.0, 0.0, -self.x, 0.0, 1.0, -self.y)


class Registration:
    """Finds each frame's shift. Deterministic; memory: `REFERENCE` small pictures at most."""

    def __init__(self, response: Response, *, mesh: bool = False) -> None:
        """With `mesh` the shadow is a pattern that is alike everywhere, and could be followed."""
        self._response = response
        self._mesh = mesh
        self._explained = 0.0  # part of the first frames' differences that their shifts take away
        self._first: list[Spectrum] = []
        self._matched: Spectrum | None = None  # the reference over the shadow's spectrum
        self._curvature = np.zeros((2, 2))
        self._seen_sd = math.inf
        self._noise = 1.0  # deviation of the correlation by chance
        self._factor = 1
        self._shape = (0, 0)
        self._waves: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._window: Plane | None = None
        self.wandered = 0.0
        """How far the first frames lay from one another, px."""

    def suits(self, shape: tuple[int, ...]) -> bool:
        """Whether pictures of a shape are large enough: in tiny ones a fine mesh is all texture."""
        return max(shape[:2]) // self._reduced(shape) >= _LEAST_SIDE

    def _reduced(self, shape: tuple[int, ...]) -> int:
        even = 2 if self._response.bayer else 1
        return even * max(1, -(-max(shape[:2]) // (_WORK * even)))

    @property
    def learned(self) -> bool:
        """Whether there is a reference."""
        return self._matched is not None

    @property
    def sd(self) -> float:
        """The standard deviation of a shift, px; inf before a reference is there."""
        if self._matched is None or np.linalg.det(self._curvature) <= 0.0:
            return math.inf
        least = math.sqrt(float(np.trace(np.linalg.inv(self._curvature))))
        return self._factor * max(least, self._seen_sd)

    @property
    def tells(self) -> bool:
        """Whether the scene has texture enough for shifts to be known."""
        followed = self._mesh and self._explained > _FOLLOWED
        return self.sd < UNSURE_PX and not followed

    def learn(self, pixels: NDArray[Any]) -> None:
        """Take in a frame for the reference; the last of `REFERENCE` ones makes it."""
        if self._matched is not None:
            return
        if self._window is None:
            self._prepare(pixels.shape)
        self._first.append(self._spectrum(pixels))
        if len(self._first) == REFERENCE:
            self._settle()
            self._first.clear()

    def of(self, pixels: NDArray[Any]) -> Shift:
        """The shift of a frame. Raises ValueError before a reference is there."""
        if self._matched is None:
            raise ValueError("there is no reference yet")
        x, y, height = self._find(self._spectrum(pixels), self._matched)
        found = height > max(_PEAK, _SHARE * self._noise) * self._noise
        return Shift(round(x * self._factor, 3), round(y * self._factor, 3), found)

    # ------------------------------------------------------------ pictures

    def _prepare(self, shape: tuple[int, ...]) -> None:
        self._factor = self._reduced(shape)
        height, width = (n // self._factor // 2 * 2 for n in shape[:2])
        self._shape = (height, width)
        self._window = _fading(height)[:, None] * _fading(width)[None, :]
        rows, columns = np.fft.fftfreq(height), np.fft.rfftfreq(width)
        self._waves = np.asarray(2 * np.pi * rows), np.asarray(2 * np.pi * columns)

    def _spectrum(self, pixels: NDArray[Any]) -> Spectrum:
        """Of the logarithm of a frame's light, in a small grey picture."""
        assert self._window is not None
        height, width = self._shape
        factor = self._factor
        small = pixels[: height * factor, : width * factor]
        if factor > 1:
            small = cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA)
        grey = small.astype(np.float32) if small.ndim == 2 else small.mean(2, dtype=np.float32)
        grey = self._response.linear_between(grey)
        floor = np.float32(_FLOOR * max(float(np.quantile(grey[::4, ::4], 0.95)), 1e-3))
        log = np.log(np.maximum(grey, 0) + floor)
        spectrum = np.fft.rfft2((log - log.mean()) * self._window).astype(np.complex64)
        spectrum[0, 0] = 0
        return spectrum

    # ------------------------------------------------------------ the reference

    def _settle(self) -> None:
        """Align the first frames among themselves, and learn what the shadow makes of them."""
        count = len(self._first)
        shifts = np.zeros((count, 2))
        assert self._waves is not None
        wave = np.hypot(self._waves[0][:, None], self._waves[1][None, :]) / (2 * np.pi)
        for shortest in _SHORTEST:
            seen = wave * shortest <= 1.0
            before = shifts.copy()
            moved = [self._moved(s, *d) for s, d in zip(self._first, shifts, strict=True)]
            total = np.sum(moved, axis=0)
            mean = total / count
            shadow = np.mean([np.abs(s - mean) ** 2 for s in moved], axis=0) * count / (count - 1)
            shadow += 0.05 * np.median(shadow)
            for k, spectrum in enumerate(self._first):
                others = (total - moved[k]) / (count - 1)
                x, y, _ = self._find(spectrum, (seen * others / shadow).astype(np.complex64))
                shifts[k] = x, y
            shifts -= np.median(shifts, axis=0)
            change = np.abs(shifts - before).max() * self._factor
            if shortest == 1 and change < LEAST_PX / 2:
                break
        moved = [self._moved(s, *d) for s, d in zip(self._first, shifts, strict=True)]
        mean = np.mean(moved, axis=0)
        shadow = np.mean([np.abs(s - mean) ** 2 for s in moved], axis=0) * count / (count - 1)
        shadow += 0.05 * np.median(shadow)
        signal = np.maximum(np.abs(mean) ** 2 - shadow / count, 0.0)  # the mean has shadow, too
        self._matched = (mean / shadow).astype(np.complex64)
        self._noise = math.sqrt(_both(np.abs(mean) ** 2 / shadow))
        self._curvature = self._information(signal / shadow)
        unaligned = np.mean([np.abs(s - np.mean(self._first, axis=0)) ** 2 for s in self._first], 0)
        self._explained = 1.0 - _both(shadow) / max(_both(unaligned), 1e-9)
        self.wandered = float(np.hypot(*shifts.T).max()) * self._factor
        self._differ(mean, shadow)

    def _differ(self, mean: NDArray[Any], shadow: NDArray[Any]) -> None:
        """See how far two halves of the waves, every other one, agree about the first frames."""
        rows, columns = np.indices(mean.shape)
        odd = (rows + columns) % 2 == 1
        found = [
            [
                self._find(s, (part * mean / shadow).astype(np.complex64))[:2]
                for s in self._first[::_SAMPLED]
            ]
            for part in (odd, ~odd)
        ]
        apart = np.subtract(*np.asarray(found))
        # of both halves together the deviation is half of their difference's
        self._seen_sd = float(np.sqrt(np.mean(np.sum(apart**2, axis=1)))) / 2.0

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


def aligned(pixels: NDArray[Any], warp: tuple[float, ...], bayer: bool) -> NDArray[Any]:
    """A frame moved by a warp to where the reference lies, same shape and dtype: bilinear, so that
    no sample is brighter or darker than its neighbours. A mosaic's four kinds of pixels are moved
    each by itself. What lies outside the frame repeats its edge: see `beyond`."""
    matrix = np.asarray(warp, np.float64).reshape(2, 3)
    if not bayer:
        return _warped(pixels, matrix)
    out = np.empty_like(pixels)
    for row in (0, 1):
        for column in (0, 1):
            first = np.array([column, row], np.float64)
            shift = (matrix[:, :2] @ first + matrix[:, 2] - first) / 2.0
            part = np.ascontiguousarray(pixels[row::2, column::2])
            out[row::2, column::2] = _warped(part, np.column_stack([matrix[:, :2], shift]))
    return out


def placed(
    pixels: NDArray[Any],
    warp: tuple[float, ...],
    bayer: bool,
    known: tuple[NDArray[Any], NDArray[Any]] | None,
) -> NDArray[Any]:
    """A frame `aligned`; what it knows nothing of becomes the middle between two frames of extremes
    that are `known`, so that it counts as neither."""
    found = aligned(pixels, warp, bayer)
    if known is not None:
        outside = beyond(pixels.shape, warp, bayer)
        first, second = (plane[outside].astype(np.uint32) for plane in known)
        found[outside] = (first + second) // 2
    return found


def beyond(shape: tuple[int, ...], warp: tuple[float, ...], bayer: bool) -> NDArray[np.bool_]:
    """Pixels (H, W) of which a frame that was moved by a warp knows nothing."""
    matrix = np.asarray(warp, np.float64).reshape(2, 3)
    inverse = np.linalg.inv(matrix[:, :2])
    y, x = np.ogrid[: shape[0], : shape[1]]
    moved_x, moved_y = x - matrix[0, 2], y - matrix[1, 2]
    from_x = inverse[0, 0] * moved_x + inverse[0, 1] * moved_y
    from_y = inverse[1, 0] * moved_x + inverse[1, 1] * moved_y
    edge = 1.0 if bayer else 0.0  # a mosaic's outermost colour may be one pixel in
    outside = np.zeros(shape[:2], np.bool_)
    for at, last in ((from_x, shape[1] - 1), (from_y, shape[0] - 1)):
        outside |= (at < edge - 0.01) | (at > last - edge + 0.01)
    return outside


def _warped(pixels: NDArray[Any], matrix: NDArray[np.float64]) -> NDArray[Any]:
    size = (pixels.shape[1], pixels.shape[0])
    return np.asarray(
        cv2.warpAffine(
            pixels, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    )


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
