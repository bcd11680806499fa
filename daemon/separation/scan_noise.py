"""Noise of a pattern scan's averaged frames, from repeats of a pattern or from its first picture.

Repeats of one pattern differ by noise alone and are compared on every fourth row and column. With
one frame a pattern the first picture gives an upper bound; nothing is looked at after it, so that
comparing frames stays as fast as memory is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Lighting
from daemon.separation.noise import Noise, TemporalNoise, from_frame
from daemon.separation.radiometry import Plane, Response

_SAMPLE = 4
_ENOUGH = 100  # samples that make a level's deviation
_LEVELS = 24


class ScanNoise:
    """What a scan's frames tell of the camera's noise; constant memory."""

    def __init__(self, response: Response, average: int = 1) -> None:
        self._response = response
        self._average = average
        self._repeats = TemporalNoise(response.full_scale)
        self._picture: Noise | None = None
        self._pictured = False
        self._kinds: set[Lighting] = set()
        self._last: tuple[int, NDArray[Any]] | None = None

    def add(self, pixels: NDArray[Any], pattern: int) -> None:
        """Take in a frame of a pattern."""
        if not self._pictured:
            self._pictured = True
            self._bound(pixels)
        if self._average == 1:
            return
        sample = np.ascontiguousarray(pixels[::_SAMPLE, ::_SAMPLE])
        if self._last is not None and self._last[0] == pattern:
            self._repeats.add(self._last[1], sample)
        self._last = pattern, sample

    def add_reference(self, pixels: NDArray[Any], lighting: Lighting) -> None:
        """Take in a reference frame, whose picture has no pattern in it: the first of its kind."""
        if lighting not in self._kinds:
            self._kinds.add(lighting)
            self._bound(pixels)

    def _bound(self, pixels: NDArray[Any]) -> None:
        found = from_frame(pixels, self._response.full_scale, self._response.bayer)
        self._picture = found if self._picture is None else self._picture.bounded_by(found)

    def told(self, ranks: Noise | None = None) -> Told:
        """What is known by now; `ranks`: the noise of one frame that explains how far apart the
        ranks of samples are, for which a picture is no match.

        A calibration is believed unless the scan's own frames contradict it: repeats either way,
        else a picture and ranks together (each may hold more than noise) or a picture with less.
        """
        repeats, calibrated = self._repeats.noise(), self._response.noise
        own, source = (
            (repeats, REPEATS) if repeats else (ranks, RANKS) if ranks else (self._picture, PICTURE)
        )
        if calibrated is None:
            return Told(self._response, own, self._average, source)
        own_bounds = [repeats] if repeats else [self._picture, ranks]
        found = [one.over(calibrated) for one in own_bounds if one]
        ratio = min(found, default=1.0)
        slack = _SURE if repeats else _UNSURE
        excess = ratio > slack and (repeats is not None or ranks is not None)
        if excess or ratio < 1.0 / slack:
            return Told(self._response, own, self._average, source, ratio)
        return Told(self._response, calibrated, self._average, CALIBRATION, ratio)


REPEATS, RANKS, PICTURE = "repeated frames", "ranks", "one picture"
RESIDUALS, CALIBRATION = "residuals of the fit", "calibration"

_SURE, _UNSURE = 1.25, 1.5


@dataclass(frozen=True, slots=True)
class Told:
    """What is known of the noise of a pattern's averaged frames, and from what.

    `noise` is that of one frame's counts (None: rounding alone); `agreement` the scan's own figure
    over the calibrated one (None: none is applied).
    """

    response: Response
    noise: Noise | None
    average: int
    source: str
    agreement: float | None = None

    @property
    def measured(self) -> bool:
        """Whether it is measured, not an upper bound."""
        return self.source != PICTURE

    def deviation(self, light: Plane) -> Plane:
        """Standard deviation of a pattern's averaged linear light at a level of it (float32)."""
        one = self.response.deviation(self.noise, self.response.counts(light))
        if self.average > 1:
            one *= np.float32(self.average**-0.5)
        return one

    def facts(self) -> dict[str, Any]:
        """For quality.json."""
        facts: dict[str, Any] = {"noise_from": self.source}
        if self.agreement is not None:
            facts["noise_of_calibrated"] = round(self.agreement, 3)
        return facts

    def advice(self) -> list[str]:
        """A line where the calibration is contradicted."""
        if self.agreement is None or self.source == CALIBRATION:
            return []
        return [
            f"the frames have {self.agreement:.2g} times the calibrated noise, which is therefore "
            "not used: run `umbra calibrate noise` again with these camera settings; if it stays, "
            "light flickers or something moved"
        ]


class ResidualNoise:
    """Noise from what a fit of M + B sin(φ + δ) leaves, on every fourth row and column.

    With three phases a fit leaves nothing: repeats of a phase tell it then, or the first picture.
    """

    def __init__(self, response: Response) -> None:
        self._response = response
        self._frequencies: dict[int, _Residuals] = {}
        self._picture: Noise | None = None

    def add(self, pixels: NDArray[Any], light: Plane, frequency: int, delta: float) -> None:
        """Take in a frame (counts and their linear light) of a phase."""
        if self._picture is None:
            self._picture = from_frame(pixels, self._response.full_scale, self._response.bayer)
        residuals = self._frequencies.setdefault(frequency, _Residuals())
        residuals.add(light[::_SAMPLE, ::_SAMPLE], delta)

    @property
    def source(self) -> str:
        """From what the noise is known."""
        return "residuals of the fit" if self.measured else "one picture"

    @property
    def measured(self) -> bool:
        """Whether it is measured, not an upper bound."""
        return self._fitted() is not None

    @property
    def misfit(self) -> float | None:
        """What the fit leaves over what a picture shows: far above 1, frames are no sinusoid."""
        fitted = self._fitted()
        if fitted is None or self._picture is None:
            return None
        return fitted.typical / self._picture.typical

    @property
    def distortion(self) -> float | None:
        """What the fit leaves over the wave's amplitude, where that is large: the median."""
        found = [r.distortion() for r in self._frequencies.values() if r.freedom > 0]
        return max(found) if found else None

    def noise(self) -> Noise | None:
        """Deviation of one frame's counts by level."""
        return self._fitted() or self._picture

    def _fitted(self) -> Noise | None:
        found = [r.variance() for r in self._frequencies.values() if r.freedom > 0]
        if not found:
            return None
        light = np.concatenate([level.reshape(-1) for level, _ in found])
        variance = np.concatenate([v.reshape(-1) for _, v in found])
        freedom = min(r.freedom for r in self._frequencies.values() if r.freedom > 0)
        return by_level(self._response, light, variance, freedom)


def by_level(response: Response, light: Plane, variance: Plane, freedom: int) -> Noise | None:
    """Noise of encoded counts from samples of the variance of linear light, by level.

    The median of each level is taken, for what is not noise (blur, motion) is in the minority;
    a χ² distribution's median is below its mean by (1 - 2/9f)³.
    """
    counts = response.counts(light)
    slope = response.deviation(None, counts) * np.float32(12.0**0.5)
    groups = np.array_split(np.argsort(counts, kind="stable"), min(counts.size // _ENOUGH, _LEVELS))
    levels, deviations = [], []
    for group in groups if counts.size >= _ENOUGH else ():
        median = float(np.median(variance[group])) / (1.0 - 2.0 / (9.0 * freedom)) ** 3
        encoded = np.sqrt(median) / max(float(np.median(slope[group])), 1e-9)
        levels.append(float(np.mean(counts[group], dtype=np.float64)))
        deviations.append(float(max(encoded, 12.0**-0.5)))
    return Noise(tuple(levels), tuple(deviations)) if levels else None


class _Residuals:
    """Sums of one frequency on the sampled pixels, in float64: small differences of squares."""

    def __init__(self) -> None:
        self._sums: NDArray[np.float64] | None = None
        self._squares: NDArray[np.float64] | None = None
        self._normal = np.zeros((3, 3))
        self._frames = 0

    def add(self, light: Plane, delta: float) -> None:
        values = light.astype(np.float64)
        if self._sums is None or self._squares is None:
            self._sums = np.zeros((3, *values.shape))
            self._squares = np.zeros(values.shape)
        row = np.array([1.0, np.cos(delta), np.sin(delta)])
        self._sums += row.reshape(3, *[1] * values.ndim) * values
        self._squares += values * values
        self._normal += np.outer(row, row)
        self._frames += 1

    @property
    def freedom(self) -> int:
        """Frames beyond the three that a fit takes."""
        singular = np.linalg.matrix_rank(self._normal, tol=1e-6) < 3
        return 0 if singular else self._frames - 3

    def variance(self) -> tuple[Plane, Plane]:
        """The mean level and the variance of one frame around the fit, of each sampled pixel."""
        assert self._sums is not None
        assert self._squares is not None
        fitted = np.tensordot(np.linalg.inv(self._normal), self._sums, axes=1)
        left = self._squares - np.einsum("k...,k...->...", fitted, self._sums)
        variance = np.maximum(left, 0.0) / self.freedom
        return fitted[0].astype(np.float32), variance.astype(np.float32)

    def distortion(self) -> float:
        """Root mean square of what the fit leaves over the wave's amplitude: the median over the
        brighter half of the wave."""
        assert self._sums is not None
        _, cosine, sine = np.tensordot(np.linalg.inv(self._normal), self._sums, axes=1)
        amplitude = np.hypot(cosine, sine)
        large = (amplitude >= np.median(amplitude)) & (amplitude > 0)
        if not large.any():
            return 0.0
        _, variance = self.variance()
        return float(np.median(np.sqrt(variance[large]) / amplitude[large]))
