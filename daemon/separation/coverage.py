"""Separation under a moving occluder, and whether its shadow ever reached a pixel (§4.2).

A pixel is in full light for most of a sweep, so that its level there is a mean of many frames: the
brightest of them is noise, or an edge that a shaken camera brought there. In the umbra it may have
been once.

L_max and L_min say nothing of a pixel that the shadow never crossed: its minimum is its own noise,
and direct = 0 would be a lie. The frames tell it from a pixel that the source never reaches, whose
direct light *is* 0:

- *drop*: L_max - L_min beyond what noise does over that many frames and beyond the part of the
  light that comes and goes with the rest of the scene. Seen: the shadow was here.
- no drop, though the drop of the pixels around, at this pixel's brightness, would have been seen:
  the pixel is either *never unlit* or in the scene's own shadow. In such a shadow it is about as
  bright as its surroundings are unlit, and the occluder passed on both sides of it.
- no drop, and none to be expected of so dark a pixel: the same question is put to the mean of a
  cell of pixels, whose noise is smaller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import Judgement, bits, finish
from daemon.separation.noise import Noise, TemporalNoise, noise_range
from daemon.separation.order import Ranked
from daemon.separation.radiometry import Plane, Response
from daemon.separation.references import References
from daemon.separation.sweeping import Sweeping
from daemon.separation.warping import without

CELL = 8
"""Side of a cell, in pixels: its mean has an eighth of a pixel's noise."""

LEAST_DROP = 0.05
"""A smaller part of the light comes and goes with interreflection when an occluder passes by."""

LEAST_SHARE = 0.15
"""Nor is a drop the occluder's that is a smaller share of what most of the crossed scene lost."""

DARKEST, BRIGHTEST = 4, 2
"""Samples kept a pixel: enough to tell one frame in the umbra from several."""

LIT = 0.25
"""A sample that has lost less, of what a pixel lost at its darkest, is taken for lit: a frame or
two of penumbra among many ..."""

LIT_DEVIATIONS = 5.0
"""... or that noise may have made so."""

_TINY = np.float32(1e-6)
_LIMITED = 8  # frames after which it is asked again what is lit
_MOST = 65_535  # samples that are averaged
_SAMPLE = 4  # noise is measured on every fourth row and column


class Occluder:
    """Frames of a scene swept by an occluder's shadow -> direct, global, coverage.

    L_max = L_d + g L_g and L_min = g L_g with g the part of the source that the occluder leaves
    (a stick: 1), b = 0 in the umbra. `planes["coverage"]` (uint16) counts the frames near a pixel's
    minimum, up to `DARKEST`; 0 where it was never unlit. `averaged` takes the means of the samples
    in full light and in the umbra, without it the brightest and the darkest (the paper's).
    """

    def __init__(self, response: Response, *, lit_fraction: float, averaged: bool = True) -> None:
        self._response = response
        self._averaged = averaged
        self._alpha = lit_fraction
        self._references = References(response)
        self._unused = 0
        self._begin()

    def _begin(self) -> None:
        self._low = Ranked(DARKEST, largest=False)
        self._high = Ranked(BRIGHTEST, largest=True)
        self._lit = _Lit()
        self._table: Plane | None = None  # deviation of a sample, by counts
        self._cell_low: Plane | None = None
        self._cell_high: Plane | None = None
        self._pixel_noise = TemporalNoise(self._response.full_scale)
        self._cell_noise = TemporalNoise(self._response.full_scale)
        self._sweeping = Sweeping()
        self._last: tuple[NDArray[Any], Plane] | None = None
        self._moved = False  # the last frame was interpolated

    def update(
        self,
        pixels: NDArray[Any],
        observation: Observation,
        left_out: NDArray[np.bool_] | None = None,
    ) -> None:
        """See `Extremes`."""
        if not observation.used:
            self._unused += 1
        elif observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
        else:
            if observation.fresh:
                self._unused += self._low.frames
                self._begin()
            pixels = self._response.scaled(pixels, 1.0 / observation.strength)
            known = (self._high.planes[0], self._low.planes[0]) if self._low.frames else None
            told = without(pixels, left_out, known)
            self._low.add(told)
            self._high.add(told)
            frames = self._high.frames
            if frames & (frames - 1) == 0 and (noise := self.noise()) is not None:
                self._table = noise.deviation(np.arange(self._response.full_scale + 1))
            self._lit.add(told, self._high.planes[1], self._low.planes[0], self._table)
            self._sweeping.add(pixels)
            self._watch(pixels, observation.warp is not None)

    def _watch(self, pixels: NDArray[Any], moved: bool) -> None:
        """Keep what tells of noise and of the shadow's way."""
        cells = _cells(pixels)
        sample = np.ascontiguousarray(pixels[::_SAMPLE, ::_SAMPLE])
        if self._cell_low is None or self._cell_high is None:
            self._cell_low, self._cell_high = cells.copy(), cells.copy()
        else:
            np.minimum(self._cell_low, cells, out=self._cell_low)
            np.maximum(self._cell_high, cells, out=self._cell_high)
        if self._last is not None:
            interpolated = moved or self._moved
            self._pixel_noise.add(self._last[0], sample, interpolated=interpolated)
            self._cell_noise.add(self._last[1], cells)
        self._last, self._moved = (sample, cells), moved

    def brightest(self) -> NDArray[Any] | None:
        """See `Extremes`."""
        return self._high.planes[0] if self._high.frames else None

    def noise(self) -> Noise | None:
        """See `Extremes`."""
        return self._pixel_noise.noise()

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before two frames are in."""
        frames = self._low.frames
        if frames < 2:
            raise NotYet(f"an occluder's sweep needs 2 frames, {frames} came so far")
        low = self._response.linear(self._low.planes)
        high = self._response.linear(self._high.planes)
        pixel_noise = self.noise()
        deviation = self._response.deviation(pixel_noise, self._high.planes[0])
        cells = self._cells(frames)
        seen = self._seen(low, high, deviation, frames, cells)
        never = _never_unlit(seen, high[0], deviation, frames, cells)
        coverage = _near_minimum(low, high, deviation)
        single = ~never & seen & (coverage == 1)
        coverage[never] = 0
        brightest, darkest = high[0], low[0]
        judged = Judgement.of_extremes(deviation, frames)
        if self._averaged:
            brightest = self._response.linear_between(
                self._lit.level(self._high.planes[1], self._low.planes[0], self._table)
            )
            darkest = _umbra(low, self._response.deviation(pixel_noise, self._low.planes[0]))
            judged = _judgement(deviation, frames)
        ambient = self._references.mean(Lighting.AMBIENT)
        if ambient is not None:
            brightest, darkest = brightest - ambient, darkest - ambient
        direct, indirect = light_model.from_extremes(brightest, darkest, self._alpha)
        swept, advice = self._sweeping.told()
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=high[0],
            saturated=self._high.planes[0] >= self._response.saturated_from,
            flags=bits(never, Quality.NEVER_UNLIT) | bits(single, Quality.SINGLE),
            planes={"coverage": coverage},
            judgement=judged,
            facts={
                "estimator": "plateau" if self._averaged else "maxmin",
                "frames": frames,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": 0.0,
                **swept,
                "advice": advice,
                **self._references.facts("ambient frame" if ambient is not None else "none"),
            },
        )

    def _cells(self, frames: int) -> _Cells:
        """What the cells' means tell of the shadow's way."""
        if self._cell_low is None or self._cell_high is None:
            raise NotYet("no frame has come yet")
        low = self._response.linear_between(self._cell_low)
        high = self._response.linear_between(self._cell_high)
        deviation = self._response.deviation(self._cell_noise.noise(), self._cell_high)
        noisy: Plane = np.float32(noise_range(frames)) * deviation
        fraction = np.divide(high - low, np.maximum(high, _TINY), dtype=np.float32)
        least = LEAST_DROP
        crossed = (high - low > noisy) & (fraction > least)
        if crossed.any():
            least = max(least, LEAST_SHARE * float(np.median(fraction[crossed])))
            crossed &= fraction > least
        return _Cells(low, high, noisy, fraction, crossed, least)

    @staticmethod
    def _seen(
        low: Plane, high: Plane, deviation: Plane, frames: int, cells: _Cells
    ) -> NDArray[np.bool_]:
        """Pixels (H, W) whose light fell beyond noise: twice, or once with their whole cell."""
        enough = np.maximum(
            np.float32(noise_range(frames)) * deviation, np.float32(cells.least) * high[0]
        )
        twice = _any(high[1] - low[1] > enough)
        once = _any(high[0] - low[0] > enough)
        return twice | (once & _grown(cells.crossed, twice.shape))

    def summary(self) -> dict[str, float]:
        """Frames, those not used, the part of the picture that the shadow has crossed, and the
        coverage: the part crossed of what it would show on."""
        frames = self._low.frames
        covered = coverage = 0.0
        if frames >= 2:
            cells = self._cells(frames)
            covered = float(cells.crossed.mean())
            if covered > 0.0:
                missed = float(cells.never().mean())
                coverage = covered / (covered + missed)
        return {
            "frames": float(frames),
            "unused": float(self._unused),
            "covered": covered,
            "coverage": coverage,
        }


class _Lit:
    """The mean of a pixel's samples in full light: three planes.

    Lit are those above a limit near the second brightest so far. It is looked at anew now and then:
    an old one is too high for nothing but noise. Where the brightest have left the mean behind (the
    first frames had the shadow there) it begins again.
    """

    def __init__(self) -> None:
        self._frames = 0
        self._sum = np.zeros(0, np.uint32)
        self._count = np.zeros(0, np.uint16)
        self._least: NDArray[Any] = np.zeros(0, np.uint8)

    def add(
        self, samples: NDArray[Any], edge: NDArray[Any], darkest: NDArray[Any], table: Plane | None
    ) -> None:
        """Take in a frame; `edge` is the second brightest sample of each pixel, `darkest` the
        darkest, this frame's among them; `table` the deviation of noise by counts."""
        if not self._frames:
            self._sum = np.zeros(samples.shape, np.uint32)
            self._count = np.zeros(samples.shape, np.uint16)
        if self._frames < _LIMITED or self._frames % _LIMITED == 0:
            self._least = _least_lit(edge, darkest, table)
            left = self._sum < self._least.astype(np.uint32) * self._count
            self._sum[left], self._count[left] = 0, 0
        lit = (samples >= self._least) & (self._count < _MOST)
        self._sum += samples * lit
        self._count += lit
        self._frames += 1

    def level(self, edge: NDArray[Any], darkest: NDArray[Any], table: Plane | None) -> Plane:
        """The mean, float32 counts: the second brightest sample where none was lit."""
        mean = self._sum / np.maximum(self._count, 1).astype(np.float32)
        behind = (self._count == 0) | (mean < _least_lit(edge, darkest, table))
        return np.where(behind, edge, mean).astype(np.float32)


def _least_lit(edge: NDArray[Any], darkest: NDArray[Any], table: Plane | None) -> NDArray[Any]:
    """The least sample of each pixel that is taken for lit, in the samples' type."""
    brightest = edge.astype(np.float32)
    width = np.float32(LIT) * (brightest - darkest)
    if table is not None:
        np.maximum(width, np.float32(LIT_DEVIATIONS) * np.take(table, edge), out=width)
    least: NDArray[Any] = np.ceil(np.maximum(brightest - width, 0)).astype(edge.dtype)
    return least


@dataclass(frozen=True, slots=True)
class _Cells:
    """Means of cells over the sweep, linear light (float32): the darkest, the brightest, what noise
    explains of their difference, the fraction that was lost; whether the shadow crossed the cell,
    and the least fraction that says so."""

    low: Plane
    high: Plane
    noisy: Plane
    fraction: Plane
    crossed: NDArray[np.bool_]
    least: float

    def around(self) -> tuple[Plane, Plane]:
        """What crossed cells around say of each cell: its light in shadow, and out of it."""
        weight = np.where(self.crossed, self.fraction, np.float32(0)) ** 4
        return _around(self.low, weight), _around(self.high, weight)

    def never(self) -> NDArray[np.bool_]:
        """Cells that the shadow never reached though it would show on them; some are crossed."""
        unlit, lit = self.around()
        fraction = np.divide(lit - unlit, np.maximum(lit, _TINY), dtype=np.float32)
        between = (unlit + lit) * np.float32(0.5)
        return np.asarray(
            ~self.crossed
            & (fraction * self.high > np.maximum(self.noisy, self.least * self.high))
            & ~((self.high < between) & _enclosed(self.crossed))
        )


def _never_unlit(
    seen: NDArray[np.bool_], brightest: Plane, deviation: Plane, frames: int, cells: _Cells
) -> NDArray[np.bool_]:
    """Pixels (H, W) that the shadow never reached, as far as the pixels around can tell."""
    if not cells.crossed.any():
        return np.ones_like(seen)
    unlit_around, lit_around = cells.around()
    lost = lit_around - unlit_around
    fraction = np.divide(lost, np.maximum(lit_around, _TINY), dtype=np.float32)
    between: Plane = (unlit_around + lit_around) * np.float32(0.5)
    passed_by = _enclosed(cells.crossed)
    cell_never = cells.never()
    shape = seen.shape
    grey = _grey(brightest)
    expected = _smooth(fraction, shape) * grey
    tells = expected > np.maximum(
        np.float32(noise_range(frames)) * _grey(deviation), cells.least * grey
    )
    shadow = (grey < _smooth(between, shape)) & _grown(passed_by, shape)
    near = cv2.dilate(cell_never.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return ~seen & np.where(tells, ~shadow & _grown(near, shape), _grown(cell_never, shape))


def _near_minimum(low: Plane, high: Plane, deviation: Plane) -> NDArray[np.uint16]:
    """How many of the kept darkest samples lie near the darkest: nearer than a tenth of the light
    that the pixel lost, or than noise parts two samples. Of colours, their mean: a shadow takes all
    of them, and noise less so."""
    noise = _grey(deviation) * np.float32(1.0 if low.ndim == 3 else 3.0**-0.5)
    darkest = _grey(low[0])
    tolerance = np.maximum(
        np.float32(2.0 * 2.0**0.5) * noise, np.float32(0.1) * (_grey(high[0]) - darkest)
    )
    near = [_grey(plane) - darkest <= tolerance for plane in low]
    return np.asarray(np.count_nonzero(near, axis=0), dtype=np.uint16)


def _umbra(low: Plane, deviation: Plane) -> Plane:
    """The mean of the kept darkest samples (n, ...) that noise alone may part from the darkest."""
    near = low - low[0] <= np.float32(2.0 * 2.0**0.5) * deviation
    return np.asarray(np.sum(low * near, axis=0) / np.count_nonzero(near, axis=0), np.float32)


def _judgement(deviation: Plane, frames: int) -> Judgement:
    """Of a pixel that nothing happens to, noise makes the darkest of so many samples by half of the
    range darker than the mean."""
    limit = np.float32(noise_range(frames) / 2 + 2.0) * deviation
    return Judgement(limit, limit, deviation)


def _cells(pixels: NDArray[Any]) -> Plane:
    """Means of cells of CELL x CELL pixels and all channels: float32, the last ones partial."""
    height, width = (-(-n // CELL) for n in pixels.shape[:2])
    pad = ((0, height * CELL - pixels.shape[0]), (0, width * CELL - pixels.shape[1]))
    whole = (
        pixels
        if not any(after for _, after in pad)
        else cv2.copyMakeBorder(pixels, 0, pad[0][1], 0, pad[1][1], cv2.BORDER_REPLICATE)
    )
    rows = np.add.reduce(
        whole.reshape(height, CELL, -1), axis=1, dtype=np.uint32
    )  # (height, width * CELL * channels)
    sums = np.add.reduce(rows.reshape(height, width, -1), axis=2, dtype=np.uint32)
    samples = CELL * CELL * (1 if pixels.ndim == 2 else pixels.shape[2])
    return np.asarray(sums, dtype=np.float32) * np.float32(1.0 / samples)


def _around(plane: Plane, weight: Plane) -> Plane:
    """Each cell's surroundings: weighted means, from as near as there is any weight."""
    filled = np.zeros_like(plane)
    missing = np.ones(plane.shape, dtype=np.bool_)
    values = plane * weight
    enough = np.float32(0.02) * weight.max()
    reach = 2.0
    while missing.any():
        near = np.asarray(cv2.GaussianBlur(weight, (0, 0), reach), dtype=np.float32)
        total = np.asarray(cv2.GaussianBlur(values, (0, 0), reach), dtype=np.float32)
        found = missing & (near > enough)
        filled[found] = total[found] / near[found]
        missing &= ~found
        reach *= 2.0
        if reach > max(plane.shape):
            filled[missing] = values.sum() / weight.sum()
            break
    return filled


def _grown(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """A mask of cells as one of pixels."""
    pixels = np.repeat(np.repeat(mask, CELL, axis=0), CELL, axis=1)
    return pixels[: shape[0], : shape[1]]


def _smooth(plane: Plane, shape: tuple[int, ...]) -> Plane:
    """A plane of cells as one of pixels, interpolated between the cells' centres."""
    size = (plane.shape[1] * CELL, plane.shape[0] * CELL)
    pixels = cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(pixels[: shape[0], : shape[1]], dtype=np.float32)


def _enclosed(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells from which a crossed cell lies in three of the four directions at least."""
    left = np.logical_or.accumulate(seen, axis=1)
    right = np.logical_or.accumulate(seen[:, ::-1], axis=1)[:, ::-1]
    above = np.logical_or.accumulate(seen, axis=0)
    below = np.logical_or.accumulate(seen[::-1], axis=0)[::-1]
    sides = left.astype(np.uint8) + right + above + below
    return np.asarray(sides >= 3)


def _any(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask if mask.ndim == 2 else np.asarray(np.logical_or.reduce(mask, axis=2))


def _grey(light: Plane) -> Plane:
    return light if light.ndim == 2 else np.asarray(light.mean(axis=2), dtype=np.float32)
