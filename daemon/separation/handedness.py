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

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane
from daemon.separation.sampling import Mask, thinned

Wave = NDArray[np.complex64]

STRONG = 6.0
"""Deviations of a wave's noise from which its phase is trusted."""

_WINDOW = 5  # pixels over which a phase's slope is taken
_COHERENT = 0.3  # of the slopes in a window: below, a border runs through it
_LEAST_MAJORITY = 0.6  # of the usable pixels must agree on a way round
_REACH = 41  # pixels, about a find


class WaveSums:
    """Σ w_i I_i for each of a few weights a pattern: constant memory, the camera's counts.

    `weights` (patterns, waves) complex, of mean 0 over the patterns, so that light which is in all
    of them cancels; patterns of weight 0 are not needed. A sum tells nothing before each of the
    others came once.
    """

    def __init__(self, weights: NDArray[np.complex128]) -> None:
        self._weights = weights
        self._sums: list[tuple[Plane, Plane]] = []
        self._buffer: Plane | None = None
        self._missing = {int(n) for n in np.flatnonzero(np.any(weights != 0, axis=1))}
        self._seen: set[int] = set()
        self._broken = False

    def add(self, samples: NDArray[Any], pattern: int) -> None:
        """Take in the samples of a pattern; a second time spoils the sums."""
        if pattern in self._seen or pattern >= len(self._weights):
            self._broken = True
            return
        self._seen.add(pattern)
        if pattern not in self._missing:
            return
        self._missing.discard(pattern)
        values = samples.astype(np.float32)
        if self._buffer is None:
            self._buffer = np.empty_like(values)
            self._sums = [(np.zeros_like(values), np.zeros_like(values)) for _ in self._weights[0]]
        for weight, parts in zip(self._weights[pattern], self._sums, strict=True):
            for factor, plane in zip((weight.real, weight.imag), parts, strict=True):
                np.multiply(values, np.float32(factor), out=self._buffer)
                np.add(plane, self._buffer, out=plane)

    @property
    def complete(self) -> bool:
        """Whether all patterns that are needed came, each once."""
        return not (self._broken or self._missing)

    def waves(self) -> list[Wave] | None:
        """The waves (H, W), colours added up; None unless `complete`."""
        if not self.complete:
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
    way: waves of phase x + y and x - y. The last row's are 0 where the rows before it tell them.
    None where the shifts don't tell a wave's phase."""
    columns, rows = (sorted({shift[axis] for shift in shifts}) for axis in range(2))
    along = _duals(columns, period)
    across = _duals(rows[:-1], period) or _duals(rows, period)
    if along is None or across is None:
        return None
    x = np.asarray([along[shift[0]] for shift in shifts])
    y = np.asarray([across.get(shift[1], 0j) for shift in shifts])
    return np.stack([x * y, x * np.conj(y)], axis=1)


def _duals(offsets: list[int], period: float) -> dict[int, complex] | None:
    """By offset, the weights that give a wave's complex amplitude; None where they cannot."""
    turn = 2.0 * np.pi * np.asarray(offsets) / period
    design = np.stack([np.ones_like(turn), np.cos(turn), np.sin(turn)])
    normal = design @ design.T
    if np.linalg.cond(normal) > 100.0:
        return None
    dual = np.linalg.solve(normal, design)
    return dict(zip(offsets, dual[1] + 1j * dual[2], strict=True))


def strength(waves: Sequence[Wave], deviation: Plane) -> Plane:
    """The weakest wave's amplitude over its noise, whose deviation is of a frame's shape. Colours
    may share theirs: interpolated from one mosaic, or compressed as one picture."""
    noise = deviation if deviation.ndim == 2 else deviation.sum(axis=2)
    weakest = np.minimum.reduce([np.abs(wave) for wave in waves])
    return np.asarray(weakest / np.maximum(noise, np.float32(1e-6)), dtype=np.float32)


def imbalance(waves: Sequence[Wave], strength: Plane) -> float | None:
    """How unlike two waves' amplitudes are: the median of |A - B|/(A + B), 0 to 1.

    A checkerboard is a product of a part along x and one along y, under any blur, so that one point
    lit by it has equal amplitudes of x + y and x - y; other frames, or their wrong order, don't.
    None where hardly any pixel is modulated.
    """
    strong = strength > np.float32(STRONG)
    if len(waves) != 2 or np.count_nonzero(thinned(strong)) < _WINDOW**2:
        return None
    some = thinned(strong)
    first, second = (np.abs(thinned(wave)[some]) for wave in waves)
    return float(np.median(np.abs(first - second) / (first + second)))


def reversed_pattern(waves: Sequence[Wave], strength: Plane) -> Mask:
    """Where the pattern lies the other way round than in most of the picture: (H, W) bool.

    `waves`: phases that rise with two projector coordinates, each its own, or with one; of one
    the slope is compared, that must not run against the picture's. `strength` (H, W): amplitude in
    standard deviations of its noise. Nothing is found where no way round prevails.
    """
    strong = strength > np.float32(STRONG)
    slopes = [slope for wave in waves for slope in _slopes(wave, strong)]
    usable = strong & np.logical_and.reduce([size > np.float32(_COHERENT) for _, size in slopes])
    if np.count_nonzero(usable) < _WINDOW**2:
        return np.zeros(strength.shape, dtype=np.bool_)
    angles = [angle for angle, _ in slopes]
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
    joined = np.zeros(int(pieces.max()) + 1, dtype=np.bool_)
    joined[pieces[found]] = True
    return np.asarray(joined[pieces] & _morphed(found, cv2.MORPH_DILATE, _REACH))


def _slopes(wave: Wave, strong: Mask) -> Iterator[tuple[Plane, Plane]]:
    """Along x and along y: the phase's step from pixel to pixel, the mean of a window, and the
    length of that mean, 0 (they differ) to 1."""
    real, imaginary = (np.ascontiguousarray(part) for part in (wave.real, wave.imag))
    size = np.asarray(cv2.magnitude(real, imaginary), dtype=np.float32)
    scale = strong.astype(np.float32) / np.maximum(size, np.float32(1e-9))
    real, imaginary = (np.asarray(part * scale, dtype=np.float32) for part in (real, imaginary))
    window = (_WINDOW, _WINDOW)
    for axis in (1, 0):
        here, there = (_shifted(axis, by) for by in (slice(None, -1), slice(1, None)))
        a, b, c, d = real[here], imaginary[here], real[there], imaginary[there]
        steps = (a * c + b * d, a * d - b * c, (strong[here] & strong[there]).astype(np.float32))
        edge = (0, 1, 0, 0) if axis == 0 else (0, 0, 0, 1)  # the last row or column has none
        along, turned, weight = (
            cv2.blur(cv2.copyMakeBorder(step, *edge, cv2.BORDER_CONSTANT), window) for step in steps
        )
        angle = np.asarray(cv2.phase(along, turned), dtype=np.float32)  # 0 to 2π
        angle -= (angle > np.float32(np.pi)) * np.float32(2.0 * np.pi)
        length = cv2.magnitude(along, turned) / np.maximum(weight, np.float32(1e-3))
        yield angle, np.asarray(length, dtype=np.float32)


def _shifted(axis: int, by: slice) -> tuple[slice, slice]:
    return (by, slice(None)) if axis == 0 else (slice(None), by)


def _morphed(mask: Mask, how: int, size: int) -> Mask:
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), how, kernel)) > 0


def _grey(wave: NDArray[Any]) -> Wave:
    grey = wave if wave.ndim == 2 else wave.sum(axis=2)
    return np.asarray(grey, dtype=np.complex64)
