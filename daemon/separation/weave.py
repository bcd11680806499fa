"""What a weave tells of blur: the local frequency of sin(x + weave sin y), period by period.

The weave makes the wave finer where it is steep and coarser where it is flat: its frequency's
square, in units of that along x, is 1 + weave² cos² y. Blur takes more from the finer parts, so how
the amplitude goes with the local frequency tells it. Both are taken less their mean over a period,
and compared within windows of two, which neither texture (the amplitude is a part of the pixel's
light) nor the slant of a surface (frequencies are over the window's own) gets into; what else
spreads a window's frequencies, an edge or a curved mirror, leaves it out. Plain stripes have one
frequency, and do not tell.
"""

from __future__ import annotations

from math import pi

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.blur import blurred_wave, of_wave
from daemon.separation.handedness import Wave
from daemon.separation.sampling import gathered

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

_PERIOD = 16  # samples of the picture to a period: it is thinned out to that
_COARSEST = 1.0  # radians from a sample to the next: beyond, its steepest parts wrap
_WINDOW = 2 * _PERIOD + 1
_ONE = _PERIOD + 1  # an odd window of a period
_FILLED = 0.6  # of a window's pixels must have a wave
_STRONG = 0.1  # of the picture's strong waves
_UNLIKE = 2.0  # times the spread of frequencies that the weave makes: another cause
_ENOUGH = 4  # windows
_SURE = 0.02  # of direct light: a worse standard error says nothing
_TINY = np.float32(1e-6)
_SIGMAS = np.arange(0.0, 0.2, 0.002)  # of the period


class Woven:
    """The local frequency of a wave (H, W) complex of a pattern with a weave; `of` is None where
    the picture has too little of it, or too finely."""

    def __init__(self, wave: Wave, strong: Mask, step: int, *, period: float, weave: float) -> None:
        self._wave, self._step = wave[::step, ::step], step
        self._shape: tuple[int, ...] = wave.shape
        self._period, self._weave = period, weave
        within = np.ascontiguousarray(strong[::step, ::step], dtype=np.uint8)
        self._strong = np.zeros(within.shape, dtype=np.float32)
        self._strong[2:-2, 2:-2] = cv2.erode(within, np.ones((5, 5), np.uint8))[2:-2, 2:-2]
        filled = np.asarray(cv2.blur(self._strong, (_WINDOW, _WINDOW))) > np.float32(_FILLED)
        self._usable = (self._strong > 0) & filled
        # the pixel's own and its neighbours': their noise is not the same one, so that products of
        # the two are free of its square
        own = rates(self._wave)
        near = _beside(own[0], down=True), _beside(own[1], down=False)
        typical = self._mean(own[0] * near[0] + own[1] * near[1])
        self._typical = np.maximum(typical, np.float32(1e-4))
        self._squares = [_square(rates) / self._typical for rates in (own, near)]

    @classmethod
    def of(cls, wave: Wave, *, period: float, weave: float) -> Woven | None:
        """See the class."""
        amplitude = np.abs(wave)
        strong = amplitude > np.float32(_STRONG) * np.quantile(amplitude[::4, ::4], 0.9)
        if not strong.any():
            return None
        rate = float(np.sqrt(np.median(_square(rates(wave))[strong])))
        step = max(1, round(2.0 * pi / max(rate, 1e-3) / _PERIOD))
        if rate * step > _COARSEST or min(wave.shape) < step * _WINDOW:
            return None
        return cls(wave, strong, step, period=period, weave=weave)

    def blur(self, light: Plane) -> float | None:
        """Sigma of a Gaussian in projector pixels; None where the picture does not tell it.

        `light` (H, W) is all of a pixel's light. What is not told from its own standard error is
        taken for less, as far as it is not.
        """
        part = np.abs(self._wave) / np.maximum(light[:: self._step, :: self._step], _TINY)
        level, own, near = (
            plane - self._mean(plane, _ONE)
            for plane in (np.log(np.maximum(part, _TINY)), *self._squares)
        )
        spread = self._mean(own * near)
        going = self._mean(level * (own + near)) * np.float32(0.5)
        typical = float(np.median(self._typical[self._usable])) if self._usable.any() else 1.0
        slopes, expected = _slopes((typical / (1.0 + self._weave**2 / 2.0)) ** 0.5, self._weave)
        alike = self._usable & (spread < _UNLIKE * expected) & (spread > expected / _UNLIKE)
        windows = np.count_nonzero(alike) / _WINDOW**2
        if windows < _ENOUGH:
            return None
        found = going[alike] / spread[alike]
        slope = float(gathered(found))
        error = 1.25 * 1.4826 * float(np.median(np.abs(found - slope))) / windows**0.5
        if error > _SURE:
            return None
        slope *= slope**2 / (slope**2 + error**2)
        return float(np.interp(-slope, -slopes, _SIGMAS)) * self._period

    def gain(self, sigma: float) -> Plane:
        """What gives each pixel's wave (H, W) back what a blur took from its frequency."""
        even = np.float32(1.0 + self._weave**2 / 2.0)
        finer: Plane = np.asarray(cv2.blur(self._squares[0] + self._squares[1], (3, 3)))
        finer *= even / np.maximum(self._mean(finer, _ONE), _TINY)
        np.clip(finer, 1.0, 1.0 + self._weave**2, out=finer)
        finer[~self._usable] = even
        taken = np.float32(2.0 * (pi * sigma / self._period) ** 2)
        gain: Plane = np.exp((finer - even) * taken)
        gain *= np.float32(1.0 / of_wave(sigma, self._period, self._weave))
        height, width = self._shape
        whole: Plane = np.asarray(cv2.resize(gain, (width, height)), dtype=np.float32)
        return whole

    def _mean(self, plane: Plane, size: int = _WINDOW) -> Plane:
        """Over a window around each pixel, of the pixels that have a wave."""
        sums = np.asarray(cv2.blur(plane * self._strong, (size, size)))
        part = np.asarray(cv2.blur(self._strong, (size, size)))
        mean: Plane = np.asarray(sums / np.maximum(part, np.float32(1e-3)), dtype=np.float32)
        return mean


def rates(wave: Wave) -> tuple[Plane, Plane]:
    """Radians a pixel along rows and along columns, (H, W); 0 at the border."""
    along, down = (np.zeros(wave.shape, dtype=np.float32) for _ in range(2))
    along[:, 1:-1] = np.angle(wave[:, 2:] * np.conj(wave[:, :-2])) * np.float32(0.5)
    down[1:-1] = np.angle(wave[2:] * np.conj(wave[:-2])) * np.float32(0.5)
    return along, down


def _beside(plane: Plane, *, down: bool) -> Plane:
    """The mean of the two neighbours below and above, or right and left."""
    kernel = np.asarray([[0.5, 0.0, 0.5]], dtype=np.float32)
    return np.asarray(cv2.filter2D(plane, -1, kernel.T if down else kernel))


def _square(rates: tuple[Plane, Plane]) -> Plane:
    square: Plane = np.square(rates[0]) + np.square(rates[1])
    return square


def _slopes(rate: float, weave: float) -> tuple[NDArray[np.float64], float]:
    """What `Woven.blur` finds on a plane whose wave advances by `rate` radians a sample along x,
    for each of `_SIGMAS`; and the spread of frequencies."""
    slopes, spreads = [], []
    for sigma in _SIGMAS:
        wave, ahead, behind = (blurred_wave(sigma, weave, at) for at in (0.0, rate, -rate))
        square = rate**2 + np.square(np.angle(ahead * np.conj(behind)) * 0.5)
        square = square / square.mean() - 1.0
        level = np.log(np.abs(wave))
        spreads.append(float(np.mean(np.square(square))))
        slopes.append(float(np.mean((level - level.mean()) * square)) / spreads[-1])
    return np.asarray(slopes), spreads[0]
