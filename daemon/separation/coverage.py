"""Separation under a moving occluder, and which pixels its shadow reached (§4.2).

Its level in full light and in the umbra are in `full_light`, where the shadow has been in
`crossed`; here they become components.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.crossed import Cells, grey_of
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import Judgement, bits, finish
from daemon.separation.full_light import PARTED, FullLight, Umbra
from daemon.separation.gaps import Gaps
from daemon.separation.levels import Levels, split_behind
from daemon.separation.noise import Noise, TemporalNoise, noise_range
from daemon.separation.order import Ranked
from daemon.separation.radiometry import Plane, Response
from daemon.separation.references import References
from daemon.separation.sweeping import Sweeping
from daemon.separation.warping import without

DARKEST, BRIGHTEST = 4, 2
"""Samples kept a pixel: enough to tell one frame in the umbra from several."""

_MISSED, _ONCE = 0.01, 0.25
"""Of the pixels: if more were never in the umbra, or in one frame only, it is said what to do."""

_WHOLE = 0.9  # of the end of the scale
_SAMPLE = 4  # noise is measured on every fourth row and column


class Occluder:
    """Frames of a scene swept by an occluder's shadow -> direct, global, coverage.

    L_max = L_d + g L_g and L_min = g L_g with g the part of the source that the occluder leaves
    (a stick: 1), b = 0 in the umbra. `planes["coverage"]` (uint16) counts the frames near a pixel's
    minimum, up to `DARKEST`; 0 where it was never unlit, or in penumbra only. `averaged` takes the
    means of the samples in full light and in the umbra and states what noise leaves in them
    (`planes` direct_std, global_std); without it the brightest and the darkest (the paper's), whose
    error is a bias.
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
        self._lit = FullLight()
        self._umbra = Umbra()
        self._table: Plane | None = None  # deviation of a sample, by counts
        self._cells = Cells(self._response)
        self._gaps = Gaps()
        self._noise = TemporalNoise(self._response.full_scale)
        self._sweeping = Sweeping()
        self._last: NDArray[Any] | None = None  # a sample of the last frame
        self._moved = False  # which was interpolated

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
            self._gaps.add(told)
            frames = self._high.frames
            if frames & (frames - 1) == 0 and (noise := self.noise()) is not None:
                self._table = noise.deviation(np.arange(self._response.full_scale + 1))
            self._lit.add(told, self._high.planes[1], self._low.planes[0], self._table)
            if self._averaged:
                self._umbra.add(told, self._low.planes, self._table)
            self._sweeping.add(pixels)
            self._watch(pixels, observation.warp is not None)

    def _watch(self, pixels: NDArray[Any], moved: bool) -> None:
        """Keep what tells of noise and of the shadow's way."""
        self._cells.add(pixels)
        sample = np.ascontiguousarray(pixels[::_SAMPLE, ::_SAMPLE])
        if self._last is not None:
            self._noise.add(self._last, sample, interpolated=moved or self._moved)
        self._last, self._moved = sample, moved

    def brightest(self) -> NDArray[Any] | None:
        """See `Extremes`."""
        return self._high.planes[0] if self._high.frames else None

    def noise(self) -> Noise | None:
        """See `Extremes`."""
        found = self._noise.noise()
        return None if found is None else _by_brighter(found, self._response)

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before two frames are in."""
        frames = self._low.frames
        if frames < 2:
            raise NotYet(f"an occluder's sweep needs 2 frames, {frames} came so far")
        low = self._response.linear(self._low.planes)
        high = self._response.linear(self._high.planes)
        noise = self.noise()
        deviation = self._response.deviation(noise, self._high.planes[0])
        crossed = self._cells.crossed(frames)
        seen = crossed.seen(low, high, deviation)
        never = crossed.never_unlit(seen, high[0], deviation)
        never |= self._gaps.within(high[0], low[0], deviation, seen)
        coverage = _near_minimum(low, high, deviation)
        single = ~never & seen & (coverage == 1)
        coverage[never] = 0
        levels = self._levels(noise)
        split = split_behind(levels, self._alpha, self._references, self._response, noise)
        planes: dict[str, NDArray[Any]] = {"coverage": coverage}
        judged = Judgement.of_extremes(deviation, frames)
        if self._averaged:
            planes |= {"direct_std": split.direct_std, "global_std": split.global_std}
            judged = _judgement(deviation, frames)
        swept, advice = self._sweeping.told()
        return finish(
            split.direct,
            split.indirect,
            response=self._response,
            brightest=high[0],
            saturated=self._high.planes[0] >= self._response.saturated_from,
            flags=bits(never, Quality.NEVER_UNLIT) | bits(single, Quality.SINGLE),
            planes=planes,
            judgement=judged,
            facts={
                "estimator": "plateau" if self._averaged else "maxmin",
                "frames": frames,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": 0.0,
                **swept,
                "advice": [*advice, *_sparse(never, single)],
                **self._references.facts(split.source),
            },
        )

    def _levels(self, noise: Noise | None) -> Levels:
        """The light in full light and in the umbra: means, or the extremes."""
        brightest, darkest = self._high.planes[0], self._low.planes[0]
        told = np.ones(darkest.shape[:2], np.float32)
        if not self._averaged:
            one = np.ones(darkest.shape, np.uint16)
            return Levels.of_counts(self._response, noise, (brightest, one), (darkest, one), told)
        table = None if noise is None else noise.deviation(np.arange(self._response.full_scale + 1))
        bright = self._lit.level(self._high.planes[1], darkest, self._table)
        dark = self._umbra.level(self._low.planes, bright[0], table)
        return Levels.of_counts(self._response, noise, bright, dark, told)

    def summary(self) -> dict[str, float]:
        """Frames, those not used, the part of the picture that the shadow has crossed, and the
        coverage: the part crossed of what it would show on."""
        frames = self._low.frames
        covered, coverage = self._cells.crossed(frames).shares() if frames >= 2 else (0.0, 0.0)
        return {
            "frames": float(frames),
            "unused": float(self._unused),
            "covered": covered,
            "coverage": coverage,
        }


def _near_minimum(low: Plane, high: Plane, deviation: Plane) -> NDArray[np.uint16]:
    """How many of the kept darkest samples lie near the darkest: nearer than a tenth of the light
    that the pixel lost, or than noise parts two samples. Of colours, their mean: a shadow takes all
    of them, and noise less so."""
    noise = grey_of(deviation) * np.float32(1.0 if low.ndim == 3 else 3.0**-0.5)
    darkest = grey_of(low[0])
    tolerance = np.maximum(
        np.float32(PARTED) * noise, np.float32(0.1) * (grey_of(high[0]) - darkest)
    )
    near = [grey_of(plane) - darkest <= tolerance for plane in low]
    return np.asarray(np.count_nonzero(near, axis=0), dtype=np.uint16)


def _sparse(never: NDArray[np.bool_], single: NDArray[np.bool_]) -> list[str]:
    """What to do where the stick went too far from one frame to the next."""
    missed, once = float(never.mean()), float(single.mean())
    if missed <= _MISSED and once <= _ONCE:
        return []
    return [
        f"{missed:.1%} of the pixels were never in the stick's full shadow, and {once:.1%} in a "
        "single frame: sweep again, more slowly, or with a wider stick, and over all of the scene"
    ]


def _by_brighter(noise: Noise, response: Response) -> Noise:
    """No level's light has more noise than that of brighter ones. In a fast sweep hardly a pixel of
    the umbra stays there, and what it changes by is not noise."""
    levels = np.asarray(noise.levels, dtype=np.float32)
    slope = response.slope(levels)
    light = np.asarray(noise.deviations, dtype=np.float32) * slope
    whole = levels < _WHOLE * response.saturated_from  # beyond, noise is cut off
    if not whole.any():
        return noise
    light[whole] = np.minimum.accumulate(light[whole][::-1])[::-1]
    return Noise(noise.levels, tuple(float(x) for x in light / slope))


def _judgement(deviation: Plane, frames: int) -> Judgement:
    """Of a pixel that nothing happens to, noise makes the darkest of so many samples by half of the
    range darker than the mean."""
    limit = np.float32(noise_range(frames) / 2 + 2.0) * deviation
    return Judgement(limit, limit, deviation)
