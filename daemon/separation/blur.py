"""The blur of projector and camera: from what it leaves of checkers; what it leaves of waves."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi

import numpy as np
from numpy.typing import NDArray

_TOLD = 4
"""Contrast up to this size tells the blur: that of larger checkers is lost to local scattering."""
_FINE = 9  # points a pixel at which light is computed for `of_optics`
_SIGMAS = np.arange(0.0, 3.0, 0.02)


def of_image(contrast: Mapping[int, float]) -> float:
    """Sigma of a Gaussian, in projector px, that a projected image is to be blurred with before it
    is read between its pixels by linear interpolation. `contrast` by size of checkers; 0: unknown.
    """
    return _fitted(contrast, 1)


def of_optics(contrast: Mapping[int, float]) -> float:
    """Sigma of a Gaussian, in projector px, for all that blurs between the projector's levels and
    the camera's counts, the pixels of both included. `contrast` by size of checkers; 0: unknown."""
    return _fitted(contrast, _FINE)


def of_wave(sigma: float, period: float, weave: float = 0.0) -> float:
    """What a blur leaves of the amplitude of sin(x + weave sin y), its mean over y: without a weave
    exp(-2π²σ²f²)."""
    return float(np.mean(np.abs(blurred_wave(sigma / period, weave))))


def of_stripes(sigma: float, stripe: float) -> float:
    """What a blur, above 0, leaves of the contrast of stripes in their middles; one unit."""
    order = np.arange(16)
    odd = 2 * order + 1
    left = np.exp(-0.5 * np.square(odd * pi * sigma / stripe))
    return float(4.0 / pi * np.sum((-1.0) ** order / odd * left))


def blurred_wave(sigma: float, weave: float, shift: float = 0.0) -> NDArray[np.complex128]:
    """What a blur, in periods, leaves of exp(i weave sin(y + shift)) beside exp(ix), at 256 places
    of a period along y: of each of its harmonics along y, a Gaussian takes its own part."""
    y = np.arange(256) * (2.0 * pi / 256)
    order = np.fft.fftfreq(256, 1 / 256)
    left = np.fft.fft(np.exp(1j * weave * np.sin(y)))
    left *= np.exp(-2.0 * pi**2 * sigma**2 * (1.0 + order**2) + 1j * order * shift)
    return np.asarray(np.fft.ifft(left))


def _fitted(contrast: Mapping[int, float], per_pixel: int) -> float:
    """Checkers are drawn, blurred, and sampled at places all over a pixel, each at the integer
    shift at which its contrast is greatest; the median over places is compared with what was
    measured, as it was measured. Between `per_pixel` points a pixel light is interpolated."""
    told = {size: value for size, value in contrast.items() if size <= _TOLD}
    if not told:
        return 0.0
    errors = [
        sum((_contrast_left(size, sigma, per_pixel) - value) ** 2 for size, value in told.items())
        for sigma in _SIGMAS
    ]
    return round(float(_SIGMAS[int(np.argmin(errors))]), 3)


def _contrast_left(size: int, sigma: float, per_pixel: int) -> float:
    """Of checkers of a size, at the median of all places in a pixel."""
    drawn = np.arange(-32 * size * per_pixel, 32 * size * per_pixel)
    x = (drawn - (per_pixel - 1) / 2) / per_pixel  # pixel n is centred at n
    wave = np.where((drawn // (size * per_pixel)) % 2 == 0, 1.0, -1.0)
    if sigma > 0:
        spread = sigma * per_pixel
        reach = int(4 * spread) + 1
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / spread) ** 2)
        wave = np.convolve(wave, kernel / kernel.sum(), mode="same")
    shifts = np.arange(0, size, max(1, size // 4))
    places = np.linspace(-0.5, 0.5, 11)
    seen = np.interp(places[:, None] + shifts[None, :], x, wave)
    greatest = np.abs(seen).max(axis=1)
    return float(np.median(greatest[:, None] * greatest[None, :]))
