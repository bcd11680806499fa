"""What the exposures of a bracket tell of a sensor's noise, and of their own ratios.

Two exposures of one pattern differ by noise alone, once they are scaled to each other; a linear
sensor's noise has two numbers, read noise and shot noise, which hold for all levels and exposures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.noise import from_frame
from daemon.separation.radiometry import Plane, Response
from daemon.separation.sampling import Mask

ROUNDING = 1.0 / 12.0
"""Variance of a count's rounding error."""

_SAMPLES = 30_000  # compared of a pattern, on an odd grid: all colours of a mosaic
_LEVELS = 24  # of light, with a deviation each
_ENOUGH = 50  # samples of a level
_OUTLIER = 4.0  # deviations


@dataclass(frozen=True, slots=True)
class Sensor:
    """Noise of a linear sensor: the variance of a frame's linear light x is `read` + `shot` x."""

    read: float  # counts²
    shot: float  # counts

    @classmethod
    def fitted(
        cls,
        reads: NDArray[np.float64],
        shots: NDArray[np.float64],
        variances: NDArray[np.float64],
        samples: NDArray[np.float64],
    ) -> Sensor:
        """The sensor of which `variances` are reads * read + shots * shot, each measured from so
        many samples; neither number below 0."""
        weight = np.sqrt(samples) / np.maximum(variances, ROUNDING)
        design = np.stack([reads, shots], axis=1) * weight[:, None]
        wanted = variances * weight
        read, shot = np.linalg.lstsq(design, wanted, rcond=None)[0]
        if read < 0 or shot < 0:
            alone = design.T @ wanted / np.maximum(np.square(design).sum(axis=0), 1e-30)
            read, shot = (0.0, alone[1]) if read < 0 else (alone[0], 0.0)
        return cls(max(float(read), 0.0), max(float(shot), 0.0))


@dataclass(frozen=True, slots=True)
class Sample:
    """A pattern at one exposure: the mean of `frames` frames' linear light (float32, a frame's
    shape), and where one of them was saturated. `factor` is the exposure over the run's own."""

    factor: float
    light: Plane
    saturated: Mask
    frames: int = 1


class ExposureNoise:
    """The sensor's noise, from pairs of exposures of one pattern; constant memory.

    A sample of the shorter exposure less the longer's, scaled to it by ρ < 1, is noise of variance
    (1/n + ρ²/m) read + (1/n + ρ/m) shot x, for means of n and m frames. Its median at a level, and
    what grows with the level, is what is wrong with ρ, and is taken off.
    """

    def __init__(self, response: Response, known: Sensor | None = None) -> None:
        self._response = response
        self._known = known
        self._rows: dict[tuple[float, float], NDArray[np.float64]] = {}
        self._picture: Sensor | None = None
        self._sensor: Sensor | None = None

    def add(self, short: Sample, long: Sample, names: tuple[float, float]) -> None:
        """Compare two exposures of one pattern; `names` are what they should be."""
        self._sensor = None
        ratio = short.factor / long.factor
        step = int((short.light.size / _SAMPLES) ** 0.5) | 1
        grid = slice(None, None, step), slice(None, None, step)
        good = ~(short.saturated[grid] | long.saturated[grid])
        level = long.light[grid][good] * np.float32(ratio)
        apart = short.light[grid][good] - level
        top = self._response.linear_full_scale * ratio
        root = np.sqrt(np.maximum(level, 0.0) * np.float32(1.0 / top))  # even in what noise does
        bins = np.minimum(root * np.float32(_LEVELS), _LEVELS - 1).astype(np.intp)
        rows = self._rows.setdefault(names, np.zeros((6, _LEVELS)))
        order = np.argsort(bins, kind="stable")
        groups = np.split(order, np.searchsorted(bins[order], np.arange(1, _LEVELS)))
        usable = [index for index, group in enumerate(groups) if group.size >= _ENOUGH]
        at = {n: float(np.mean(level[groups[n]], dtype=np.float64)) for n in usable}
        middle = {n: float(np.median(apart[groups[n]])) for n in usable}
        slope = sum(at[n] * middle[n] for n in usable) / max(sum(at[n] ** 2 for n in usable), 1e-9)
        for index in usable:
            group = groups[index]
            off = apart[group] - middle[index] - slope * (level[group] - at[index])
            off = off.astype(np.float64)
            limit = _OUTLIER * (1.4826 * float(np.median(np.abs(off))) + 1.0)
            kept = off[np.abs(off) <= limit]
            light = max(at[index], 0.0)
            rows[:, index] += kept.size * np.array(
                [
                    1.0,
                    float(np.mean(kept**2)),
                    1.0 / short.frames + ratio**2 / long.frames,
                    (1.0 / short.frames + ratio / long.frames) * light,
                    light,
                    middle[index],
                ]
            )

    def picture(self, pixels: NDArray[Any]) -> None:
        """Take in a frame, for an upper bound as long as there is nothing to compare."""
        if self._picture is not None:
            return
        found = from_frame(pixels, self._response.full_scale, self._response.bayer)
        levels = np.asarray(found.levels, dtype=np.float32)
        light = self._response.linear_between(levels).astype(np.float64)
        variance = np.square(self._response.deviation(found, levels)).astype(np.float64)
        ones = np.ones_like(light)
        self._picture = Sensor.fitted(ones, np.maximum(light, 0.0), variance, ones)

    def sensor(self) -> Sensor:
        """What is known of the noise of one frame, by now."""
        if self._known is not None:
            return self._known
        if self._sensor is None:
            rows = np.concatenate([*self._rows.values(), np.zeros((6, 0))], axis=1)
            samples = rows[0]
            there = samples > 0
            if not there.any():
                return self._picture or Sensor(ROUNDING, 0.0)
            variance, reads, shots = rows[1:4, there] / samples[there]
            self._sensor = Sensor.fitted(reads, shots, variance, samples[there])
        return self._sensor

    @property
    def source(self) -> str:
        """From what the noise is known."""
        if self._known is not None:
            return "calibration"
        return "exposures compared" if self.measured else "one picture"

    @property
    def measured(self) -> bool:
        """Whether it is measured, not an upper bound."""
        return self._known is not None or any(rows[0].any() for rows in self._rows.values())

    def ratios(self) -> dict[tuple[float, float], float]:
        """By pairs of exposures: how much longer the longer one is by its light."""
        found = {}
        for (short, long), rows in self._rows.items():
            samples, levels, middles = rows[[0, 4, 5]][:, rows[0] > 0]
            square = float(np.sum(levels**2 / samples))
            if square > 0:
                off = float(np.sum(middles * levels / samples)) / square
                found[short, long] = long / short / max(1.0 + off, 1e-9)
        return found
