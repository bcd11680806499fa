"""From camera counts to linear light, and averages of frames in constant memory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.noise import Noise

Plane = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Response:
    """How a camera's counts follow from light.

    `full_scale` is the largest count, `black` the counts without light, `tone` the curve that it
    encoded with (linear, srgb, gamma:2.2), `saturation` the counts from which a sample is called
    saturated (None: full scale), `bayer` the mosaic's first two pixels or "", `noise` that of a
    frame's counts as it was calibrated (None: it was not).
    """

    full_scale: int
    black: float = 0.0
    tone: str = "linear"
    saturation: float | None = None
    bayer: str = ""
    noise: Noise | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.full_scale <= 65535:
            raise ValueError(f"full scale must be 1 to 65535 counts, not {self.full_scale}")
        if not 0.0 <= self.black < self.full_scale:
            raise ValueError(
                f"a black level of {self.black:g} counts leaves nothing of the full scale of "
                f"{self.full_scale}"
            )
        _exponent(self.tone)

    @property
    def is_linear(self) -> bool:
        """Whether counts are proportional to light but for the black level."""
        return self.tone == "linear"

    @property
    def saturated_from(self) -> float:
        """The least count that is called saturated."""
        return float(self.full_scale if self.saturation is None else self.saturation)

    @property
    def linear_full_scale(self) -> float:
        """Full scale in linear counts, black removed."""
        return float(_table(self.full_scale, self.black, self.tone)[self.full_scale])

    def linear(self, counts: NDArray[Any]) -> Plane:
        """Linear light in counts of the input's full scale, black removed: float32, same shape.

        `counts` are uint8 or uint16. Tone curves map 0 to 0 and full scale to full scale; values
        below black come out negative, for noise to average out.
        """
        if self.is_linear:
            light = counts.astype(np.float32)
            if self.black:
                light -= np.float32(self.black)
            return light
        return np.take(_table(self.full_scale, self.black, self.tone), counts)

    def linear_between(self, counts: Plane) -> Plane:
        """As `linear`, for means of counts (float32): interpolated between whole counts."""
        if self.is_linear:
            return counts - np.float32(self.black)
        table = self.table()
        return np.interp(counts, np.arange(table.size), table).astype(np.float32)

    def counts(self, light: Plane) -> Plane:
        """Encoded counts (float32, not rounded) of linear light: the inverse of `linear`."""
        if self.is_linear:
            return light + np.float32(self.black)
        table = self.table()
        return np.interp(light, table, np.arange(table.size)).astype(np.float32)

    def scaled(self, counts: NDArray[Any], factor: float) -> NDArray[Any]:
        """The counts of `factor` times the light: same shape and dtype. Saturated ones stay."""
        if factor == 1.0:
            return counts
        every = np.arange(np.iinfo(counts.dtype).max + 1 if self.full_scale > 255 else 256)
        light = self.linear(every.astype(counts.dtype)) * np.float32(factor)
        table = np.clip(np.rint(self.counts(light)), 0, self.full_scale).astype(counts.dtype)
        saturated = every >= self.saturated_from
        table[saturated] = every[saturated]
        return np.take(table, counts)

    def table(self) -> Plane:
        """Linear light of each count from 0 to full scale."""
        return _table(self.full_scale, self.black, self.tone)[: self.full_scale + 1]

    def slope(self, counts: NDArray[Any]) -> Plane:
        """Linear light that one count more stands for, at a level of encoded counts: float32."""
        if self.is_linear:
            return np.ones(np.shape(counts), dtype=np.float32)
        slopes: Plane = np.take(_slopes(self), _whole(counts, self.full_scale), mode="clip")
        return slopes

    def deviation(self, noise: Noise | None, counts: NDArray[Any]) -> Plane:
        """Standard deviation of linear light at a level of encoded counts: float32, same shape.

        None stands for the rounding of counts alone.
        """
        if noise is None:
            noise = Noise((0.0, float(self.full_scale)), (12.0**-0.5,) * 2)
        table = _deviations(self, noise)
        found: Plane = np.take(table, _whole(counts, self.full_scale), mode="clip")
        return found

    @property
    def noise_from(self) -> str | None:
        """From what `deviation` knows the noise by itself, whatever it is handed; None: it does
        not."""
        return None

    def wave_deviations(
        self, noise: Noise | None, mean: Plane, amplitude: Plane
    ) -> tuple[Plane, Plane]:
        """Standard deviations of linear light over the phases of a sinusoid, as a mean and as its
        wave meets them: float32. Noise that grows evenly with light is that of the mean."""
        del amplitude
        even = self.deviation(noise, self.counts(mean))
        return even, even


def decode(encoded: NDArray[np.float64], tone: str) -> NDArray[np.float64]:
    """Linear light from encoded values, both 0 to 1 (IEC 61966-2-1 for srgb)."""
    if tone == "srgb":
        return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    decoded: NDArray[np.float64] = encoded ** _exponent(tone)
    return decoded


def encode(light: NDArray[np.float64], tone: str) -> NDArray[np.float64]:
    """Encoded values from linear light, both 0 to 1: the inverse of `decode`."""
    if tone == "srgb":
        return np.where(light <= 0.04045 / 12.92, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    encoded: NDArray[np.float64] = light ** (1.0 / _exponent(tone))
    return encoded


def _exponent(tone: str) -> float:
    if tone in {"linear", "srgb"}:
        return 1.0
    name, _, value = tone.partition(":")
    if name != "gamma" or not value:
        raise ValueError(f"the tone curve {tone!r} is none of linear, srgb, gamma:2.2")
    exponent = float(value)
    if not exponent > 0.0:
        raise ValueError(f"a gamma must be above 0, not {value}")
    return exponent


@lru_cache(maxsize=16)
def _table(full_scale: int, black: float, tone: str) -> Plane:
    """Linear light of every count that a uint16 can hold; black is removed as light."""
    counts = np.arange(65536 if full_scale > 255 else 256, dtype=np.float64)
    encoded = np.minimum(counts / full_scale, 1.0)
    offset = decode(np.asarray(black / full_scale), tone)
    table: Plane = ((decode(encoded, tone) - offset) * full_scale).astype(np.float32)
    table.setflags(write=False)
    return table


def _whole(counts: NDArray[Any], full_scale: int) -> NDArray[Any]:
    """Counts as an index: noise and tone curves are smooth, the nearest is near enough."""
    if counts.dtype.kind == "u":
        return counts
    whole: NDArray[np.uint16] = np.clip(counts, 0, full_scale).astype(np.uint16)
    return whole


@lru_cache(maxsize=16)
def _slopes(response: Response) -> Plane:
    """Linear light a count for every count up to full scale."""
    return np.asarray(np.gradient(response.table()), dtype=np.float32)


@lru_cache(maxsize=16)
def _deviations(response: Response, noise: Noise) -> Plane:
    """Deviation of linear light for every count up to full scale."""
    return noise.deviation(np.arange(response.full_scale + 1)) * _slopes(response)


class FrameMean:
    """The mean of frames in linear light: one plane, whatever their number.

    Counts are summed as integers where the tone curve is linear, so the order does not matter and
    nothing wraps before 65,537 frames of 16 bits; else linear light is summed.
    """

    def __init__(self, response: Response) -> None:
        self._response = response
        self._sum: NDArray[Any] | None = None
        self.frames = 0

    def add(self, pixels: NDArray[Any]) -> None:
        """Take in a frame (uint8 or uint16). Raises OverflowError past 65,537 frames."""
        if self.frames >= 65_537:
            raise OverflowError("no more than 65,537 frames can be averaged")
        if self._sum is None:
            kind = np.uint32 if self._response.is_linear else np.float32
            self._sum = np.zeros(pixels.shape, dtype=kind)
        values = pixels if self._response.is_linear else self._response.linear(pixels)
        np.add(self._sum, values, out=self._sum)
        self.frames += 1

    def clear(self) -> None:
        """Begin again, in the same memory."""
        if self._sum is not None:
            self._sum[...] = 0
        self.frames = 0

    def value(self) -> Plane:
        """The mean in linear counts, black removed: float32. Raises ValueError with no frames."""
        if self._sum is None or self.frames == 0:
            raise ValueError("no frame has been averaged yet")
        mean = self._sum.astype(np.float32)
        mean *= np.float32(1.0 / self.frames)
        if self._response.is_linear and self._response.black:
            mean -= np.float32(self._response.black)
        return mean
