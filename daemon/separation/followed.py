"""All samples of a few pixels, and the noise that is left in them when the light is taken out.

The light of a pixel, or of a few neighbours, over all patterns is a matrix of low rank; noise is
not. So what the few largest components of the matrix leave over is noise, whatever blur, texture
and place in the pattern made of the light:

- A checkerboard is a stripe along x times a stripe along y, under any blur. Over a grid of shifts
  a pixel's light is a constant and one such product: a matrix of rank 1 beside its rows' means.
- Under patterns without order a few neighbours share the patches that they see, and their light
  over the patterns has a low rank. It is found by the eigenvalues: those of noise alone are spread
  as Marchenko and Pastur have it (Veraart et al., NeuroImage 142, 2016).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.noise import Noise
from daemon.separation.radiometry import Plane, Response

Double = NDArray[np.float64]

_PLACES = 4096  # samples of a frame that are followed
_RUN = 8  # neighbours in a row, where patterns have no order
_MATRICES = {True: 1024, False: 384}  # that are looked at, with a grid of shifts and without
_LEAST = 32  # of them, to say anything
_DIM = 0.2  # of the brightest pixels' step: with less, a pixel is not looked at
_SURPLUS = 3.5  # times the variance expected from which a matrix, or a frame, holds more than noise
_FLOOR = 0.03  # of a matrix's mean variance, the least that a sample of it has
_ROUNDS = 4  # of fitting, each without the matrices that the last found too noisy
_LEVELS = 65  # that the noise is given at


class Followed:
    """The samples of some places of every pattern: memory goes with the patterns, not the picture.

    `shifts` is the shape of the grid that the patterns are shifts over, row by row; None: they have
    no order.
    """

    def __init__(self, patterns: int, shifts: tuple[int, int] | None, response: Response) -> None:
        self._shifts = shifts
        self._response = response
        self._seen = np.zeros(patterns, dtype=np.bool_)
        self._places: NDArray[np.intp] | None = None
        self._samples: NDArray[Any] | None = None

    def add(self, samples: NDArray[Any], pattern: int) -> None:
        """Take in a pattern's samples: counts, or averaged light."""
        if self._places is None or self._samples is None:
            run = 1 if self._shifts else _RUN
            self._places = _places(samples.shape, run, bool(self._response.bayer))
            self._samples = np.empty((self._seen.size, self._places.size), dtype=samples.dtype)
        if pattern < self._seen.size:
            np.take(samples, self._places, out=self._samples[pattern], mode="clip")
            self._seen[pattern] = True

    def light(self) -> Plane:
        """Linear light (patterns, places) of the patterns that came."""
        assert self._samples is not None, "asked for with samples alone"
        samples = self._samples[self._seen]
        return samples if samples.dtype == np.float32 else self._response.linear(samples)

    def noise(self, light: Plane, average: int) -> Noise | None:
        """The noise of one frame's counts, where `average` make a sample; None: too little to tell.

        `light` is that of `light`. Samples at an end of the scale are left out, for noise is cut
        off there.
        """
        matrices = self._matrices(light)
        if matrices is None:
            return None
        top, bottom = (
            float(self._response.linear_between(np.array([at], dtype=np.float32))[0])
            for at in (self._response.saturated_from, 0.0)
        )
        lowest, highest = (edge(matrices, axis=(1, 2)) for edge in (np.min, np.max))
        step = highest - lowest
        usable = (highest < top) & (step > _DIM * np.quantile(step, 0.9))
        whole = usable & (lowest > bottom)
        usable = whole if np.count_nonzero(whole) >= _LEAST else usable
        if np.count_nonzero(usable) < _LEAST:
            return None
        return _noise(matrices[usable], self._response, average, rank=1 if self._shifts else None)

    def _matrices(self, light: Plane) -> Double | None:
        """Of each place, or run of places, the samples: rows share their parts. None: too few."""
        count = _MATRICES[self._shifts is not None]
        if self._shifts is None:
            if len(light) <= _RUN:
                return None
            runs = light[:, : light.shape[1] // _RUN * _RUN].reshape(len(light), -1, _RUN)
            return runs[:, :count].transpose(1, 2, 0).astype(np.float64)
        rows = self._seen.reshape(self._shifts).all(axis=1)
        if np.count_nonzero(rows) < 2 or self._shifts[1] < 3:
            return None
        grid = np.zeros((*self._shifts, light.shape[1]), dtype=np.float64)
        grid[self._seen.reshape(self._shifts)] = light
        return np.ascontiguousarray(grid[rows][..., :count].transpose(2, 0, 1))


def _places(shape: tuple[int, ...], run: int, mosaic: bool) -> NDArray[np.intp]:
    """Indices of a frame's samples, at random, for those of a regular grid would all lie alike in a
    regular pattern; in runs of neighbours of one colour."""
    apart = shape[2] if len(shape) == 3 else 2 if mosaic else 1
    height, width = shape[0], int(np.prod(shape[1:]))
    run = max(min(run, width // apart), 1)
    rng = np.random.default_rng(0)
    rows = rng.integers(0, height, _PLACES // run)
    first = rows * width + rng.integers(0, width - (run - 1) * apart, rows.size)
    return np.asarray((first[:, None] + apart * np.arange(run)).reshape(-1))


def _noise(matrices: Double, response: Response, average: int, rank: int | None) -> Noise | None:
    """The noise in what is left of matrices of light (n, rows, columns) without the means of their
    rows and `rank` components (None: those that are told from noise).

    Its variance is fitted as a constant, a part proportional to light (a sensor's) and, behind a
    tone curve, one proportional to the square of the curve's slope (of what comes after it).
    None: it is not noise alone.
    """
    columns = matrices.shape[2]
    light = matrices - matrices.mean(axis=2, keepdims=True)
    values, vectors = np.linalg.eigh(light @ light.transpose(0, 2, 1))
    noisy = _of_noise(values, columns) if rank is None else _smallest(values, rank)
    left, parts = (np.where(of[:, None], vectors, 0.0) for of in (noisy, ~noisy))
    residual = left @ (left.transpose(0, 2, 1) @ light)
    along = parts.transpose(0, 2, 1) @ light
    along /= np.sqrt(np.maximum(np.where(noisy, np.inf, values), 1e-12))[:, :, None]
    across = np.square(left @ left.transpose(0, 2, 1))
    down = np.eye(columns) - 1.0 / columns - along.transpose(0, 2, 1) @ along
    np.square(down, out=down)
    of_frames = np.square(residual).mean(axis=0)
    if rank is not None and of_frames.max() > _SURPLUS * np.median(of_frames):
        return None  # a frame is not of its place: noise is alike in all
    level = matrices - residual
    basis = [np.ones_like(level), level]
    if not response.is_linear:
        counts = response.counts(level.astype(np.float32))
        basis.append(np.square(response.slope(counts)).astype(np.float64))
    # each residual is made of the noise of all samples of its matrix, by these weights
    design = np.stack([across @ column @ down for column in basis])
    weights = _fitted(np.square(residual), design)
    counts = response.full_scale * np.square(np.linspace(0.0, 1.0, _LEVELS)).astype(np.float32)
    light_at = response.linear_between(counts).astype(np.float64)
    slope = np.maximum(response.slope(counts).astype(np.float64), 1e-9)
    variance = weights[0] + weights[1] * light_at
    if not response.is_linear:
        variance += weights[2] * slope**2
    one = np.sqrt(np.maximum(variance * average, 0.0)) / slope
    return Noise(tuple(counts.tolist()), tuple(np.maximum(one, 12.0**-0.5).tolist()))


def _smallest(values: Double, rank: int) -> NDArray[np.bool_]:
    """Of ascending eigenvalues all but the `rank` largest."""
    return np.broadcast_to(np.arange(values.shape[1]) < values.shape[1] - rank, values.shape)


def _of_noise(values: Double, columns: int) -> NDArray[np.bool_]:
    """Which of ascending eigenvalues (n, rows) are noise: as many of the smallest as have a range
    within Marchenko and Pastur's 4 σ² √(m/N), σ² their mean."""
    values, rows = np.maximum(values, 0.0), values.shape[1]
    m = np.arange(1, rows + 1)
    free = columns - 1 - (rows - m)  # columns beside the means and the parts
    free = np.maximum(free, 1)
    mean = np.cumsum(values, axis=1) / (m * free)
    spread = (values - values[:, :1]) / free
    within = mean >= spread / (4.0 * np.sqrt(m / free))
    most = rows - np.argmax(within[:, ::-1], axis=1)
    return np.asarray(np.arange(rows) < most[:, None])


def _fitted(squares: Double, design: Double) -> Double:
    """Weights, none below 0, of a design (weights, n, ...) for squares of noise (n, ...), without
    the matrices that hold more than noise."""
    axes = tuple(range(1, squares.ndim))
    total = squares.sum(axis=axes)
    expected = np.maximum(design[0].sum(axis=axes), 1e-12)
    weights = np.zeros(len(design))
    share = (-1, *[1] * len(axes))
    each = np.broadcast_to(expected.reshape(share), squares.shape)
    for _ in range(_ROUNDS):
        ratio = total / expected
        calm = ratio <= _SURPLUS * np.median(ratio)
        trust = calm.reshape(share) / np.square(each)
        weighted = (design * trust).reshape(len(design), -1)
        normal = weighted @ design.reshape(len(design), -1).T
        weights = _not_negative(normal, weighted @ squares.reshape(-1))
        if not weights.any():
            break
        each = np.tensordot(weights, design, 1)
        # light that noise makes negative has no less noise than little light
        expected = np.maximum(each.sum(axis=axes), 1e-12)
        each = np.maximum(each, (_FLOOR / squares[0].size * expected).reshape(share))
    return weights


def _not_negative(normal: Double, wanted: Double) -> Double:
    """The least squares of a few weights that are not below 0, by trying which ones are."""
    best, least = np.zeros(wanted.size), 0.0
    for chosen in range(1, 1 << wanted.size):
        index = [n for n in range(wanted.size) if chosen >> n & 1]
        found = np.linalg.lstsq(normal[np.ix_(index, index)], wanted[index], rcond=None)[0]
        cost = -float(wanted[index] @ found)
        if (found >= 0).all() and cost < least:
            best, least = np.zeros(wanted.size), cost
            best[index] = found
    return best
