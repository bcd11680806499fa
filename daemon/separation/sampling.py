"""What measurements of the rig have in common: moments of frames, bright pixels, robust figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import NotYet, Observation
from daemon.separation.radiometry import Plane

Mask = NDArray[np.bool_]

_BLOCKS = 8  # along each side, for a spread over the picture
_LEAST_PIXELS = 64  # good ones, to say anything
_MAD = 1.4826  # standard deviation of a Gaussian over its median absolute deviation


def thinned(plane: NDArray[Any], most: int = 8192) -> NDArray[Any]:
    """About so many of a plane's samples, all over it, flat: enough for a median or a quantile."""
    flat = plane.reshape(-1)
    step = max(flat.size // most, 1)
    if step > 1 and plane.ndim > 1:  # not all in the same columns, or of one colour
        step |= 1
        while np.gcd(step, int(np.prod(plane.shape[1:]))) > 1:
            step += 2
    return flat[::step]


def gathered(values: NDArray[Any]) -> float:
    """Where most of a population lies, though the rest is all to one side: the median of the
    shortest interval that holds half of it (the shorth's)."""
    ordered = np.sort(thinned(values))
    half = ordered.size // 2
    if half < 2:
        return float(np.median(ordered))
    first = int(np.argmin(ordered[half:] - ordered[: ordered.size - half]))
    return float(np.median(ordered[first : first + half + 1]))


class Moments:
    """Mean and variance of frames at each sample: two planes, whatever their number."""

    def __init__(self) -> None:
        self._sum: NDArray[np.float64] | None = None
        self._squares: NDArray[np.float64] | None = None
        self.frames = 0

    def add(self, pixels: NDArray[Any]) -> None:
        """Take in a frame."""
        values = pixels.astype(np.float64)
        if self._sum is None or self._squares is None:
            self._sum, self._squares = values, values * values
        else:
            self._sum += values
            self._squares += values * values
        self.frames += 1

    def mean(self) -> Plane:
        """The mean, float32. Raises NotYet without frames."""
        if self._sum is None:
            raise NotYet("no frame has come yet")
        return (self._sum / self.frames).astype(np.float32)

    def variance(self) -> Plane:
        """The variance of a single frame, unbiased. Raises NotYet with fewer than two."""
        if self._sum is None or self._squares is None or self.frames < 2:
            raise NotYet("a variance takes two frames")
        spread = self._squares - self._sum * self._sum / self.frames
        return np.maximum(spread / (self.frames - 1), 0.0).astype(np.float32)


class Turns:
    """When a pattern's frames have all come: with its last, or, where that one is missing, when
    another pattern's first comes."""

    def __init__(self) -> None:
        self._open: int | None = None

    def overdue(self, observation: Observation) -> int | None:
        """The pattern before this observation's whose last frame never came, if there is one."""
        before, same = self._open, observation.pattern
        self._open = None if observation.last else same
        return None if before == same else before


def bright(black: Plane, white: Plane, saturated: Mask) -> Mask:
    """Samples that see the source well: a tenth of the brightest at least, and unsaturated.

    Raises NotYet, with the remedy, where there are hardly any.
    """
    lit = white - black
    good = ~saturated & (lit > 0.1 * np.quantile(lit, 0.999)) & (lit > 0)
    if np.count_nonzero(good) < _LEAST_PIXELS:
        raise NotYet(
            "too few pixels see the source without being saturated: expose more briefly "
            "(--exposure), or point camera and projector at the same scene"
        )
    return np.asarray(good)


def ratio(part: Plane, whole: Plane, good: Mask) -> tuple[float, float]:
    """The ratio of sums over `good` samples, and its standard deviation from the spread over the
    picture (NaN where the picture has too few blocks to tell)."""
    found = _of_sums(part[good], whole[good])
    return found, _spread([_of_sums(part[cut], whole[cut]) for cut in _blocks(good)])


def median_ratio(part: Plane, whole: Plane, good: Mask) -> tuple[float, float]:
    """The median of the ratios at `good` samples, which a minority of surfaces that behave in
    another way does not move; and its standard deviation as of `ratio`."""
    found = float(np.median(part[good] / whole[good]))
    return found, _spread([float(np.median(part[cut] / whole[cut])) for cut in _blocks(good)])


def _of_sums(part: Plane, whole: Plane) -> float:
    return float(part.sum(dtype=np.float64)) / float(whole.sum(dtype=np.float64))


def _blocks(good: Mask) -> list[tuple[NDArray[np.intp], ...]]:
    """The good samples of each block of the picture that has enough of them."""
    found = []
    for rows in np.array_split(np.arange(good.shape[0]), _BLOCKS):
        for columns in np.array_split(np.arange(good.shape[1]), _BLOCKS):
            if not rows.size or not columns.size:
                continue
            here = np.nonzero(good[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
            if len(here[0]) >= _LEAST_PIXELS // 4:
                found.append((here[0] + rows[0], here[1] + columns[0], *here[2:]))
    return found


def _spread(ratios: list[float]) -> float:
    """Of the mean of some ratios, by their median absolute deviation; NaN for less than four."""
    if len(ratios) < 4:
        return float("nan")
    spread = _MAD * float(np.median(np.abs(np.asarray(ratios) - np.median(ratios))))
    return float(spread / len(ratios) ** 0.5)


def line(
    x: NDArray[np.float64], y: NDArray[np.float64], sd: NDArray[np.float64] | None = None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(offset, slope) of a weighted straight line, and their standard deviations.

    With `sd` the deviations are those that it implies, enlarged where the points scatter more.
    Raises ValueError for fewer than two points.
    """
    if x.size < 2:
        raise ValueError("a line takes two points")
    weight = np.ones_like(x) if sd is None else 1.0 / np.square(sd)
    design = np.stack([np.ones_like(x), x])
    normal = (design * weight) @ design.T
    solved = np.linalg.solve(normal, (design * weight) @ y)
    residual = y - solved @ design
    freedom = max(1, x.size - 2)
    scatter = float(np.sum(weight * residual**2)) / freedom
    covariance = np.linalg.inv(normal) * (scatter if sd is None else max(1.0, scatter))
    offset, slope = (float(v) for v in solved)
    first, second = (float(v) for v in np.sqrt(np.diag(covariance)))
    return (offset, slope), (first, second)
