"""One scene's light from several exposures, merged in linear radiance (high dynamic range).

Light is given in counts of the run's own exposure. A sample x of an exposure f times as long is f L
with the noise of a linear sensor, variance r² + k x, so that x/f tells L with the weight

    f² / (r² + k f L)  ~  f² / (q + f L),    q = r²/k

which is the exposure where shot noise is all, its square where read noise is. L in it is what the
longest exposure that is not saturated says: the same for all weights of a pixel, for weights that
follow each sample's own noise would favour the dark ones. Saturated samples are left out. A mosaic
is merged raw, sample by sample: what is saturated says nothing of its neighbours, and a colour that
is dim keeps its long exposures where green has lost them. In a picture whose colours were mixed
before (RGB) a pixel is left out whole. Where the shortest exposure is saturated too, nothing tells
the light: that sample stays, the end of the merged scale.

`Bracketed` stands before any estimator, which sees one merged frame a pattern, and `Radiance` is
its camera's response.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import (
    Components,
    Estimator,
    Lighting,
    NotYet,
    Observation,
    Result,
)
from daemon.separation.exposure_noise import ROUNDING, ExposureNoise, Sample, Sensor
from daemon.separation.noise import Noise
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.sampling import Mask

CROSSOVER = 0.01
"""q where no calibration tells it, of full scale: read and shot noise are alike there. A q that is
quite wrong costs 8 % more deviation for shot noise alone, 27 % for none (exposures 1, 4, 16)."""

_BAND = 32_768  # samples merged at a time
_OFF = 0.03  # of the ratio of two exposures: from here it is said


def merge(samples: Sequence[Sample], crossover: float) -> tuple[Plane, Mask, NDArray[np.int64]]:
    """Light of a pattern's exposures in counts of the run's own: float32, a frame's shape; where
    even the shortest is saturated; and how many samples of each exposure were used, from the
    shortest to the longest. `crossover` is q in linear counts. Raises ValueError for no samples.
    """
    if not samples:
        raise ValueError("no exposure of this pattern was taken")
    ordered = sorted(samples, key=lambda sample: sample.factor)
    light = np.empty_like(ordered[0].light)
    lost = np.empty(light.shape, dtype=np.bool_)
    used = np.zeros(len(ordered), dtype=np.int64)
    rows = max(1, _BAND // max(light[:1].size, 1))
    for top in range(0, len(light), rows):
        band = slice(top, top + rows)
        part = [
            replace(sample, light=sample.light[band], saturated=sample.saturated[band])
            for sample in ordered
        ]
        used += _merge_band(part, np.float32(crossover), light[band], lost[band])
    return light, lost, used


def _merge_band(
    ordered: list[Sample], crossover: np.float32, light: Plane, lost: Mask
) -> NDArray[np.int64]:
    """Merge some rows into `light` and `lost`: as many as the processor's cache holds."""
    good = [~spoiled(sample.saturated) for sample in ordered]
    seen = [sample.light * np.float32(1.0 / sample.factor) for sample in ordered]
    base = seen[0]
    level = base.copy()
    for one, there in zip(seen[1:], good[1:], strict=True):
        np.copyto(level, one, where=there)
    np.maximum(level, np.float32(0.0), out=level)
    # differences from the shortest are summed: small numbers, and equal samples stay as they are
    light[...] = 0
    weights = np.zeros_like(base)
    for sample, one, there in zip(ordered, seen, good, strict=True):
        weight = level * np.float32(sample.factor)
        weight += crossover
        np.divide(np.float32(sample.frames * sample.factor**2), weight, out=weight)
        weight *= there
        weights += weight
        if sample is not ordered[0]:
            weight *= one - base
            light += weight
    known = weights > 0
    np.divide(light, weights, out=light, where=known)
    light += base
    np.logical_and(ordered[0].saturated, ~known, out=lost)
    return np.array([np.count_nonzero(there) for there in good])


def spoiled(saturated: Mask) -> Mask:
    """Samples that a saturated one spoils: itself, and the others of an RGB pixel."""
    if saturated.ndim == 2:
        return saturated
    return np.repeat(saturated.any(axis=2, keepdims=True), saturated.shape[2], axis=2)


@dataclass(frozen=True, slots=True)
class Radiance(Response):
    """What an estimator of merged frames has in place of the camera's response.

    Frames are linear light already, float32, in counts of the run's own exposure; full scale is
    that of the shortest one, and its noise falls wherever a longer one is not saturated. The noise
    that an estimator finds by itself, by level alone, does not know of that and is not asked for.
    """

    factors: tuple[float, ...] = (1.0,)
    average: int = 1
    meter: ExposureNoise | None = field(default=None, compare=False)
    crossover: float = 1.0

    @classmethod
    def of(
        cls,
        response: Response,
        factors: Sequence[float],
        average: int,
        meter: ExposureNoise,
        crossover: float,
    ) -> Radiance:
        """For frames of a camera merged from so many exposures of `average` frames."""
        return cls(
            full_scale=response.full_scale,
            black=response.black,
            tone=response.tone,
            saturation=response.saturation,
            bayer=response.bayer,
            factors=tuple(sorted(factors)),
            average=average,
            meter=meter,
            crossover=crossover,
        )

    @property
    def is_linear(self) -> bool:
        """Merged light is no whole number of counts: see `FrameMean`."""
        return False

    @property
    def saturated_from(self) -> float:
        """The least light that saturates the shortest exposure."""
        return float(np.float32(_limit(self) / self.factors[0]))

    @property
    def linear_full_scale(self) -> float:
        """Full scale of the shortest exposure in linear counts of the run's own."""
        return float(self.camera.linear_full_scale / self.factors[0])

    @property
    def camera(self) -> Response:
        """The camera's own response."""
        return Response(self.full_scale, self.black, self.tone, self.saturation, self.bayer)

    def linear(self, counts: NDArray[Any]) -> Plane:
        """Merged frames are linear."""
        return np.asarray(counts, dtype=np.float32)

    def linear_between(self, counts: Plane) -> Plane:
        """Merged frames are linear."""
        return counts

    def counts(self, light: Plane) -> Plane:
        """Merged frames are linear."""
        return light

    def slope(self, counts: NDArray[Any]) -> Plane:
        """Merged frames are linear."""
        return np.ones(np.shape(counts), dtype=np.float32)

    def deviation(self, noise: Noise | None, counts: NDArray[Any]) -> Plane:
        """Standard deviation of merged light at a level of it: float32, same shape. None stands for
        the rounding of counts alone."""
        light = np.maximum(np.asarray(counts, dtype=np.float32), np.float32(0.0))
        sensor = Sensor(0.0, 0.0)
        if noise is not None and self.meter is not None:
            sensor = self.meter.sensor()
        camera = self.camera
        limit = _limit(self)
        colours = light.max(axis=2, keepdims=True) if light.ndim == 3 else light  # see `spoiled`
        total, weights = np.zeros_like(light), np.zeros_like(light)
        for factor in self.factors:
            seen = light * np.float32(factor)
            variance = np.float32(sensor.shot) * seen + np.float32(sensor.read)
            rounding = np.square(camera.slope(camera.counts(seen))) * np.float32(ROUNDING)
            np.maximum(variance, rounding, out=variance)
            weight = np.float32(factor**2) / (np.float32(self.crossover) + seen)
            if factor != self.factors[0]:
                weight *= colours * np.float32(factor) < limit
            weights += weight
            total += np.square(weight * np.float32(1.0 / factor)) * variance
        return np.asarray(
            np.sqrt(total * np.float32(1.0 / self.average)) / weights, dtype=np.float32
        )

    @property
    def noise_from(self) -> str | None:
        """See `Response`: a bracket's exposures tell it, once there are two to compare."""
        if self.meter is None or not self.meter.measured:
            return None
        return self.meter.source

    def wave_deviations(
        self, noise: Noise | None, mean: Plane, amplitude: Plane
    ) -> tuple[Plane, Plane]:
        """See `Response`: from the crest to the trough of a wave exposures come and go."""
        of_mean, of_wave = np.zeros_like(mean), np.zeros_like(mean)
        for eighths in (-3, -1, 1, 3):
            sine = float(np.sin(eighths * np.pi / 8))
            variance = np.square(self.deviation(noise, mean + np.float32(sine) * amplitude))
            of_mean += variance * np.float32(0.25)
            of_wave += variance * np.float32(0.5 * sine**2)
        return np.sqrt(of_mean), np.sqrt(of_wave)


def _limit(response: Radiance) -> float:
    """The least linear light of one exposure that is saturated."""
    camera = response.camera
    return float(camera.linear_between(np.array([camera.saturated_from], dtype=np.float32))[0])


class Bracketed:
    """An estimator's front end: a pattern's frames at several exposures -> one merged frame.

    Frames of one pattern come one after the other, in any order of exposures, `average` of each;
    `Observation.exposure` says which it is, and where `exposure_us` and `own_us` are known they say
    how long it really was. `inner` makes the estimator of merged frames, which averages no more.
    Memory: one mean an exposure. Of a pattern that lacks a frame the others are merged.
    """

    def __init__(
        self,
        response: Response,
        inner: Callable[[Response], Estimator],
        *,
        factors: Sequence[float],
        average: int = 1,
        own_us: float = 0.0,
        sensor: Sensor | None = None,
    ) -> None:
        self._response = response
        self._own_us = own_us
        self._crossover = CROSSOVER * response.full_scale
        if sensor is not None and sensor.shot > 0:
            self._crossover = max(sensor.read, ROUNDING) / sensor.shot
        self._noise = ExposureNoise(response, sensor)
        self._radiance = Radiance.of(response, factors, average, self._noise, self._crossover)
        self._inner = inner(self._radiance)
        self._exposures = {factor: _Exposure(response) for factor in sorted(factors)}
        self._open: Observation | None = None
        self._used = np.zeros(len(factors))
        self._samples = 0
        self._merged = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that merging cannot respect."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("exposures are merged as they are: no warp, strength 1")
        if observation.exposure not in self._exposures:
            raise ValueError(f"the bracket has no exposure {observation.exposure:g}")
        if self._open is not None and _place(self._open) != _place(observation):
            self._close()
        if observation.used:
            self._open = observation
            length = 0.0
            if self._own_us > 0 and observation.exposure_us > 0:
                length = observation.exposure_us / self._own_us
            self._exposures[observation.exposure].add(pixels, length or observation.exposure)
            if self._merged == 0:
                self._noise.picture(pixels)
        else:  # counted there
            self._inner.update(pixels, msgspec.structs.replace(observation, last=False))
        if observation.last:
            self._close()

    def _close(self) -> None:
        """Hand the merged frame on."""
        if self._open is None:
            return
        samples = {name: one.sample() for name, one in self._exposures.items() if one.frames}
        for short, long in pairwise(samples):
            self._noise.add(samples[short], samples[long], (short, long))
        light, saturated, used = merge(list(samples.values()), self._crossover)
        np.maximum(light, np.float32(self._radiance.saturated_from), out=light, where=saturated)
        if self._open.lighting is Lighting.PATTERN and len(used) == len(self._used):
            self._used += used
            self._samples += light.size
        self._inner.update(
            light, msgspec.structs.replace(self._open, last=True, exposure=1.0, exposure_us=0.0)
        )
        self._merged += 1
        self._open = None
        for exposure in self._exposures.values():
            exposure.clear()

    def result(self) -> Result:
        """See `Estimator`. Raises NotYet as the estimator does that it is before."""
        try:
            result = self._inner.result()
        except NotYet:
            if self._open is None:
                raise
            whole = copy.deepcopy(self)  # the last pattern may be all that is wanting
            whole._close()
            return whole.result()
        if not isinstance(result, Components):
            return result
        return replace(result, facts=self._told(result.facts))

    def _told(self, facts: dict[str, Any]) -> dict[str, Any]:
        sensor = self._noise.sensor()
        ratios = self._noise.ratios()
        shares = self._used / max(self._samples, 1)
        lines = [
            f"exposure {long:g} has {found:.3g} times the light of exposure {short:g}, not "
            f"{long / short:.3g} times: the camera's exposure times, its black level (--black) or "
            "its tone curve (--tone) are not as given"
            for (short, long), found in ratios.items()
            if abs(found * short / long - 1.0) > _OFF
        ]
        return {
            **facts,
            "noise_from": self._noise.source,
            "bracket": {
                "exposures": list(self._exposures),
                "unit": "of the run's own exposure, in whose counts the components are",
                "used": {
                    f"{factor:g}": round(float(share), 4)
                    for factor, share in zip(self._exposures, shares, strict=True)
                },
                "ratios_measured": {
                    f"{long:g}/{short:g}": round(found, 4)
                    for (short, long), found in ratios.items()
                },
                "read_noise_counts": round(sensor.read**0.5, 4),
                "shot_noise_counts": round(sensor.shot, 6),
            },
            "advice": [*facts.get("advice", ()), *lines],
        }

    def summary(self) -> dict[str, float]:
        """Those of the estimator, whose patterns are merged ones."""
        return self._inner.summary()


class _Exposure:
    """A pattern's frames at one exposure."""

    def __init__(self, response: Response) -> None:
        self._mean = FrameMean(response)
        self._saturated: Mask | None = None
        self._from = response.saturated_from
        self._length = 0.0

    def add(self, pixels: NDArray[Any], length: float) -> None:
        if self._saturated is None:
            self._saturated = np.zeros(pixels.shape, dtype=np.bool_)
        self._mean.add(pixels)
        self._saturated |= pixels >= self._from
        self._length += length

    @property
    def frames(self) -> int:
        return self._mean.frames

    def sample(self) -> Sample:
        """The mean so far. Only where there are frames."""
        assert self._saturated is not None
        return Sample(self._length / self.frames, self._mean.value(), self._saturated, self.frames)

    def clear(self) -> None:
        self._mean.clear()
        self._length = 0.0
        if self._saturated is not None:
            self._saturated[...] = False


def _place(observation: Observation) -> tuple[Lighting, int]:
    return observation.lighting, observation.pattern
