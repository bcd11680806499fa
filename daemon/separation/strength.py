"""How strong the source is in each frame of a video in which a shadow moves.

First the light of each place in full light is learned, from frames in which the source hardly
changes: that is told by the median of the ratios of one frame to the next, which shadows that come
and go do not shift, but which wanders by a per cent or two. Once full light is known in most places
it is kept, and each frame is compared with it: the ratios of the places that are in full light now
gather in a peak, whose middle is the source's strength. Nothing accumulates then. What was learned
is never updated by frames that were scaled with it: such a loop has no anchor, and runs away.

Ambient light makes the source's change look smaller than it is: strength is that of all the light.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane, Response

LEARN = 24
"""Frames in a row in which no place becomes brighter, before full light is taken for known; and as
many again, from which strength 1 is learned."""

_SAMPLES = 20_000  # pixels that are looked at: means of several would mix light and shade
_DARKEST = 1e-3  # linear counts: below it there is no logarithm
_FLOOR = 0.15  # of the brightest place: darker ones, which noise moves more, are left out
_GROWN = 1.05  # a place that has become brighter by more was not in full light before
_STILL = 0.01  # share of the places that may still do so when full light is known
_LIT = 0.9  # of the brightest: samples that are averaged as full light
_REACHES = (0.08, 0.05)  # half widths of the windows that go to a peak's middle, of ln(ratio)
_ROUNDS = 12  # of looking for a peak
_LEAST = 20  # places in a window that tell anything


class SourceStrength:
    """Follows one source. Deterministic; memory: a few planes of `_SAMPLES`."""

    def __init__(self, response: Response) -> None:
        self._response = response
        self._now: Plane | None = None
        self._strength = 1.0
        self._brightest: Plane | None = None
        self._sum: Plane | None = None
        self._count: Plane | None = None
        self._quiet = 0
        self._full: Plane | None = None  # full light; NaN: too dark a place
        self._peaks: list[float] = []
        self._one: float | None = None  # where the peak is under strength 1

    @property
    def learned(self) -> bool:
        """Whether strength is that of the source in the frames from which full light was learned;
        before, it is that of the first frame, and wanders."""
        return self._one is not None

    @property
    def latest(self) -> float:
        """The source's strength in the last frame that was asked about."""
        return self._strength

    def of(self, pixels: NDArray[Any]) -> float:
        """The source's strength in the next frame."""
        last, self._now = self._now, self._sample(pixels)
        if last is None:
            return 1.0
        level = last + self._now  # of both, so that noise does not choose
        tells = level > _FLOOR * level.max()
        self._strength *= float(np.median(self._now[tells] / last[tells]))
        if self._full is None:
            return self._strength
        known = np.isfinite(self._full)
        ratio = self._now[known] / self._full[known]
        if self._one is not None:
            self._strength = _peak(ratio, self._strength * self._one) / self._one
            return self._strength
        self._strength = _peak(ratio, self._strength)
        return self._strength

    def accept(self) -> None:
        """The frame last asked about is used: full light is learned from it."""
        assert self._now is not None
        if self._full is not None:
            self._learn_one()
            return
        now = self._now * np.float32(1.0 / self._strength)
        if self._brightest is None or self._sum is None or self._count is None:
            self._brightest, self._sum, self._count = now, now.copy(), np.ones_like(now)
            return
        grown = now > np.float32(_GROWN) * self._brightest
        self._sum[grown], self._count[grown] = 0.0, 0.0
        self._brightest = np.maximum(self._brightest, now)
        lit = now > np.float32(_LIT) * self._brightest
        self._sum += now * lit
        self._count += lit
        tells = self._brightest > _FLOOR * np.quantile(self._brightest, 0.99)
        self._quiet = self._quiet + 1 if np.mean(grown[tells]) < _STILL else 0
        if self._quiet >= LEARN:
            mean = self._sum / np.maximum(self._count, 1)
            self._full = np.where(tells, mean, np.float32(np.nan))

    def _learn_one(self) -> None:
        """Learn what strength the frames in use have against full light, once that is known."""
        if self._one is None:
            self._peaks.append(self._strength)
            if len(self._peaks) == LEARN:
                self._one = float(np.median(self._peaks))
                self._strength /= self._one

    def restart(self) -> None:
        """Forget what was learned; the frame last asked about has strength 1."""
        now = self._now
        self.__init__(self._response)  # type: ignore[misc]
        self._now = now

    def _sample(self, pixels: NDArray[Any]) -> Plane:
        """Linear light of every so many rows and columns; of a mosaic, of one colour."""
        even = 2 if self._response.bayer else 1
        apart = math.isqrt(pixels.shape[0] * pixels.shape[1] // _SAMPLES)
        step = even * max(1, apart // even)
        light = self._response.linear(np.ascontiguousarray(pixels[::step, ::step]))
        grey = light if light.ndim == 2 else light.mean(axis=2, dtype=np.float32)
        return np.maximum(grey, np.float32(_DARKEST))


def _peak(ratio: Plane, start: float) -> float:
    """The middle of the peak of the ratios that lies nearest to `start`; that, where none is."""
    at, middle = np.log(ratio), math.log(start)
    for reach in _REACHES:
        for _ in range(_ROUNDS):
            away = at[np.abs(at - middle) < reach] - middle
            if away.size < _LEAST:
                return start
            weight = 1.0 - np.square(away / reach)
            step = float(np.sum(weight * away) / np.sum(weight))
            middle += step
            if abs(step) < 1e-5:
                break
    return math.exp(middle)
