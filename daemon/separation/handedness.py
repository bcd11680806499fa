"""Which way round a pattern lies in the picture: light that came by a mirror has it reversed.

A mirror that shows the lit scene in focus has light of two values like any surface, so that no
sample of a pixel betrays it (the paper's Fig. 8). Its neighbours do. A camera and a projector on
the same side of a surface see it the same way round: as one goes over the picture, the projector's
coordinates turn in one sense, however the surface is bent. By way of one mirror they turn in the
other. Sums over the scan of the samples, times a wave of each pattern's shift, hold the pattern's
place at each pixel as a phase (`WaveSums`), which blur, texture and light scattered symmetrically
below a surface leave where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]
Wave = NDArray[np.complex64]

STRONG = 6.0
"""Deviations of a wave's noise from which its phase is trusted."""

_WINDOW = 5  # pixels over which a phase's slope is taken
_COHERENT = 0.3  # of the slopes in a window: below, a border runs through it
_LEAST_MAJORITY = 0.6
_REACH = 41  # pixels, about a find


class WaveSums:
    """Σ w_i I_i for each of a few weights a pattern: constant memory, the camera's counts.

    `weights` (patterns, waves) complex, of mean 0 over the patterns, so that light which is in all
    of them cancels. A sum tells nothing before each pattern came once.
    """

    def __init__(self, weights: NDArray[np.complex128]) -> None:
        self._weights = weights
        self._sums: list[tuple[Plane, Plane]] = []
        self._buffer: Plane | None = None
        self._seen: set[int] = set()
        self._broken = False

    def add(self, samples: NDArray[Any], pattern: int) -> None:
        """Take in the samples of a pattern; a second time spoils the sums."""
        if pattern in self._seen or pattern >= len(self._weights):
            self._broken = True
            return
        values = samples.astype(np.float32)
        if self._buffer is None:
            self._buffer = np.empty_like(values)
            self._sums = [(np.zeros_like(values), np.zeros_like(values)) for _ in self._weights[0]]
        self._seen.add(pattern)
        for weight, parts in zip(self._weights[pattern], self._sums, strict=True):
            for factor, plane in zip((weight.real, weight.imag), parts, strict=True):
                np.multiply(values, np.float32(factor), out=self._buffer)
                np.add(plane, self._buffer, out=plane)

    def waves(self) -> list[Wave] | None:
        """The waves (H, W), colours added up; None while a pattern is missing."""
        if self._broken or len(self._seen) < len(self._weights):
            return None
        return [_grey(np.asarray(real + 1j * imaginary)) for real, imaginary in self._sums]

    @property
    def gain(self) -> float:
        """Deviation of a wave for samples of deviation 1."""
        return float(np.sqrt(np.sum(np.abs(self._weights[:, 0]) ** 2)))


def shift_weights(
    shifts: Sequence[tuple[int, int]], period: float
) -> NDArray[np.complex128] | None:
    """Weights of `WaveSums` for shifts (x, y) over a whole grid of a pattern of one period each
    way: waves of phase x + y and x - y. None where the shifts don't tell a wave's phase."""
    along = []
    for axis in range(2):
        offsets = sorted({shift[axis] for shift in shifts})
        turn = 2.0 * np.pi * np.asarray(offsets) / period
        design = np.stack([np.ones_like(turn), np.cos(turn), np.sin(turn)])
        normal = design @ design.T
        if np.linalg.cond(normal) > 100.0:
            return None
        dual = np.linalg.solve(normal, design)
        along.append(dict(zip(offsets, dual[1] + 1j * dual[2], strict=True)))
    x = np.asarray([along[0][shift[0]] for shift in shifts])
    y = np.asarray([along[1][shift[1]] for shift in shifts])
    return np.stack([x * y, x * np.conj(y)], axis=1)


def strength(waves: Sequence[Wave], deviation: Plane) -> Plane:
    """The weakest wave's amplitude over its noise, whose deviation is of a frame's shape."""
    noise = deviation if deviation.ndim == 2 else np.sqrt(np.square(deviation).sum(axis=2))
    weakest = np.minimum.reduce([np.abs(wave) for wave in waves])
    return np.asarray(weakest / np.maximum(noise, np.float32(1e-6)), dtype=np.float32)


def imbalance(waves: Sequence[Wave], strength: Plane) -> float | None:
    """How unlike two waves' amplitudes are: the median of |A - B|/(A + B), 0 to 1.

    A checkerboard is a product of a part along x and one along y, under any blur, so that one point
    lit by it has equal amplitudes of x + y and x - y; other frames, or their wrong order, don't.
    None where hardly any pixel is modulated.
    """
    strong = strength > np.float32(STRONG)
    if len(waves) != 2 or np.count_nonzero(strong) < _WINDOW**2:
        return None
    first, second = (np.abs(wave)[strong] for wave in waves)
    return float(np.median(np.abs(first - second) / (first + second)))


def reversed_pattern(waves: Sequence[Wave], strength: Plane) -> Mask:
    """Where the pattern lies the other way round than in most of the picture: (H, W) bool.

    `waves`: phases that rise with two projector coordinates, each its own, or with one; of one
    the slope is compared, that must not run against the picture's. `strength` (H, W): amplitude in
    standard deviations of its noise. Nothing is found where no way round prevails.
    """
    strong = strength > np.float32(STRONG)
    slopes = [_slope(wave, strong, axis) for wave in waves for axis in (1, 0)]
    coherent = np.minimum.reduce([np.abs(slope) for slope in slopes]) > _COHERENT
    usable = strong & coherent
    if np.count_nonzero(usable) < _WINDOW**2:
        return np.zeros(strength.shape, dtype=np.bool_)
    angles = [np.angle(slope) for slope in slopes]
    if len(waves) == 2:
        turn = angles[0] * angles[3] - angles[1] * angles[2]
    else:
        x, y = (float(np.median(angle[usable])) for angle in angles)
        turn = angles[0] * np.float32(x) + angles[1] * np.float32(y)
    positive = float(np.mean(turn[usable] > 0))
    if max(positive, 1.0 - positive) < _LEAST_MAJORITY:
        return np.zeros(strength.shape, dtype=np.bool_)
    against: Mask = usable & ((turn < 0) if positive > 0.5 else (turn > 0))
    # a window across a border gives any slope, in a band of its own width: not as wide as a find
    wide = _morphed(against, cv2.MORPH_OPEN, _WINDOW + 2)
    found: Mask = against & _morphed(wide, cv2.MORPH_DILATE, _WINDOW + 2)
    if not found.any():
        return found
    # around it the mirror's images are too fine for a slope: what is joined to it without one
    loose = found | (strong & ~(usable & ~against))
    _, pieces = cv2.connectedComponents(loose.astype(np.uint8))
    joined = np.isin(pieces, np.unique(pieces[found]))
    return np.asarray(joined & _morphed(found, cv2.MORPH_DILATE, _REACH))


def _slope(wave: Wave, strong: Mask, axis: int) -> Wave:
    """The mean of the phase's steps along an axis, as a number of length 0 (they differ) to 1."""
    length = np.abs(wave)
    sign = wave / np.maximum(length, np.float32(1e-9))
    sign[~strong] = 0
    step = np.zeros_like(sign)
    here: list[slice] = [slice(None), slice(None)]
    there: list[slice] = [slice(None), slice(None)]
    here[axis], there[axis] = slice(None, -1), slice(1, None)
    step[tuple(here)] = sign[tuple(there)] * np.conj(sign[tuple(here)])
    window = (_WINDOW, _WINDOW)
    real, imaginary = (
        cv2.blur(np.ascontiguousarray(part), window) for part in (step.real, step.imag)
    )
    weight = cv2.blur(np.abs(step), window)
    total = np.asarray(real + 1j * imaginary, dtype=np.complex64)
    return np.asarray(total / np.maximum(weight, np.float32(1e-3)), dtype=np.complex64)


def _morphed(mask: Mask, how: int, size: int) -> Mask:
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), how, kernel)) > 0


def _grey(wave: NDArray[Any]) -> Wave:
    grey = wave if wave.ndim == 2 else wave.sum(axis=2)
    return np.asarray(grey, dtype=np.complex64)
