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

_SAMPLE = 4  # noise is measured on every fourth row and column
_ENOUGH = 100  # samples that make a level's deviation
_LEVELS = 24  # of light, at most, with a deviation each
_FITTED = 3  # phases that a fit takes
_MORE = 3.0  # times what a picture shows, an upper bound of noise: that is none


def _pictured(response: Response, pixels: NDArray[Any]) -> Noise:
    return from_frame(pixels, response.full_scale, response.bayer)


class ReferenceNoise:
    """Upper bounds of noise by the first reference of each kind: it has no pattern in it."""

    def __init__(self, response: Response) -> None:
        self._response = response
        self._found: dict[Lighting, Noise] = {}

    def add(self, pixels: NDArray[Any], lighting: Lighting) -> None:
        """Take in a reference frame."""
        if lighting not in self._found:
            self._found[lighting] = _pictured(self._response, pixels)

    def of(self, pattern: Noise) -> Noise:
        """The bound that a pattern's picture gives, and these."""
        for found in self._found.values():
            pattern = pattern.bounded_by(found)
        return pattern


class ScanNoise:
    """What a scan's frames tell of the camera's noise; constant memory."""

    def __init__(self, response: Response, average: int = 1) -> None:
        self._response = response
        self._average = average
        self._repeats = TemporalNoise(response.full_scale)
        self._pattern: Noise | None = None
        self._bounds = ReferenceNoise(response)
        self._last: tuple[int, NDArray[Any]] | None = None

    def add(self, pixels: NDArray[Any], pattern: int) -> None:
        """Take in a frame of a pattern."""
        if self._pattern is None:
            self._pattern = _pictured(self._response, pixels)
        if self._average == 1:
            return
        sample = np.ascontiguousarray(pixels[::_SAMPLE, ::_SAMPLE])
        if self._last is not None and self._last[0] == pattern:
            self._repeats.add(self._last[1], sample)
        self._last = pattern, sample

    def add_reference(self, pixels: NDArray[Any], lighting: Lighting) -> None:
        """Take in a reference frame."""
        self._bounds.add(pixels, lighting)

    @property
    def _picture(self) -> Noise | None:
        return None if self._pattern is None else self._bounds.of(self._pattern)

    def told(self, residual: Noise | None = None, *, ordered: bool = False) -> Told:
        """What is known by now; `residual`: the noise of one frame in what the light that patterns
        have in common leaves over (`Followed`); `ordered`: they have it, as other signs say.

        A picture shows no less noise than there is, unless files were compressed: that takes noise
        away where a picture is smooth, and adds error where it has a pattern. A calibration is
        believed unless the scan's own frames contradict it.
        """
        picture = self._picture
        if residual and picture and not ordered and residual.over(picture) > _MORE:
            residual = None  # the light has not the order that it was said to have
        for found, source in ((self._repeats.noise(), REPEATS), (residual, RESIDUALS)):
            if found is not None:
                return told(self._response, found, source, [found], self._average, sure=True)
        bounds = [] if picture is None else [picture]
        return told(self._response, picture, PICTURE, bounds, self._average)


REPEATS, PICTURE = "repeated frames", "one picture"
RESIDUALS, CALIBRATION = "residuals of the fit", "calibration"

_SURE, _UNSURE = 1.25, 1.5
_ROUNDED = 1.0 / 12.0  # variance of a count's rounding


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

    def rounding(self, light: Plane) -> Plane:
        """Variance of linear light at a level of it that averaging leaves (float32): counts are
        rounded alike in all frames where noise is less than about half a count (Widrow; the first
        harmonic of the error that Gaussian noise dithers)."""
        if self.response.noise_from is not None:  # merged exposures are no whole counts
            return np.zeros_like(light)
        counts = self.response.counts(light)
        slope = self.response.slope(counts)
        one = self.response.deviation(self.noise, counts) / np.maximum(slope, np.float32(1e-9))
        own = np.maximum(np.square(one) - np.float32(_ROUNDED), 0.0)
        alike = np.float32(_ROUNDED) * np.exp(np.float32(-4.0 * np.pi**2) * own)
        return np.asarray(alike * np.square(slope), dtype=np.float32)

    def wave_deviations(self, mean: Plane, amplitude: Plane) -> tuple[Plane, Plane]:
        """Those of linear light over the phases of a sinusoid, as its mean and as its wave meet
        them (float32)."""
        of_mean, of_wave = self.response.wave_deviations(self.noise, mean, amplitude)
        by = np.float32(self.average**-0.5)
        return of_mean * by, of_wave * by

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


def told(
    response: Response,
    own: Noise | None,
    source: str,
    bounds: list[Noise],
    average: int = 1,
    *,
    sure: bool = False,
) -> Told:
    """The calibrated noise unless the scan's own contradicts it, else the latter.

    `bounds` are what the scan's frames say, each the noise or more; a picture alone is no proof of
    more, for texture looks like noise. `sure`: they are the noise.
    """
    if response.noise_from is not None:
        return Told(response, own, average, response.noise_from)
    calibrated = response.noise
    if calibrated is None:
        return Told(response, own, average, source)
    ratio = min((bound.over(calibrated) for bound in bounds), default=1.0)
    slack = _SURE if sure else _UNSURE
    more = ratio > slack and source != PICTURE
    if more or ratio < 1.0 / slack:
        return Told(response, own, average, source, ratio)
    return Told(response, calibrated, average, CALIBRATION, ratio)


class ResidualNoise:
    """Noise from what a fit of M + B sin(φ + δ) leaves, on every fourth row and column.

    With three phases a fit leaves nothing: repeats of a phase tell it then, or the pictures of all
    three, in whatever order they come.
    """

    def __init__(self, response: Response) -> None:
        self._response = response
        self._frequencies: dict[int, _Residuals] = {}
        self._pictures: list[Noise] = []
        self._bounds = ReferenceNoise(response)

    def add(self, pixels: NDArray[Any], light: Plane, frequency: int, delta: float) -> None:
        """Take in a frame (counts and their linear light) of a phase."""
        if len(self._pictures) < _FITTED:
            self._pictures.append(_pictured(self._response, pixels))
        residuals = self._frequencies.setdefault(frequency, _Residuals())
        residuals.add(light[::_SAMPLE, ::_SAMPLE], delta)

    def add_reference(self, pixels: NDArray[Any], lighting: Lighting) -> None:
        """Take in a reference frame."""
        self._bounds.add(pixels, lighting)

    def told(self) -> Told:
        """What is known by now of one frame's noise: see `ScanNoise`."""
        fitted = self._fitted()
        if fitted is not None:
            return told(self._response, fitted, RESIDUALS, [fitted], sure=True)
        shown = self._picture
        if shown is None:
            return told(self._response, None, PICTURE, [])
        shown = self._bounds.of(shown)
        return told(self._response, shown, PICTURE, [shown])

    @property
    def _picture(self) -> Noise | None:
        return Noise.mean(self._pictures) if self._pictures else None

    @property
    def misfit(self) -> float | None:
        """What the fit leaves over what a picture shows: far above 1, frames are no sinusoid."""
        fitted = self._fitted()
        shown = self._picture
        return None if fitted is None or shown is None else fitted.typical / shown.typical

    @property
    def distortion(self) -> float | None:
        """What the fit leaves over the wave's amplitude, where that is large: the median."""
        found = [r.distortion() for r in self._frequencies.values() if r.freedom > 0]
        return max(found) if found else None

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
    if counts.size < _ENOUGH:
        return None
    slope = response.slope(counts)
    groups = np.array_split(np.argsort(counts, kind="stable"), min(counts.size // _ENOUGH, _LEVELS))
    levels, deviations = [], []
    for group in groups:
        median = float(np.median(variance[group])) / (1.0 - 2.0 / (9.0 * freedom)) ** 3
        encoded = np.sqrt(median) / max(float(np.median(slope[group])), 1e-9)
        levels.append(float(np.mean(counts[group], dtype=np.float64)))
        deviations.append(float(max(encoded, 12.0**-0.5)))
    return Noise(tuple(levels), tuple(deviations))


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
