"""Which exposures may be chosen; which one, with which gain, fills the camera's scale, and what
that does to noise. `daemon.separation.metering` chooses by pictures instead."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, log10

LONGEST_US = 1e6
"""Beyond a second light and scene are seldom still enough: no longer one is chosen unasked."""
TARGET = 0.8
"""Where a picture's level is to be, as a share of full scale: there is room for a source that grows
a little brighter."""
BRIGHTEST = 0.001
"""Share of a picture's samples that may be brighter than its level, and so may saturate."""

_ALIKE = 0.1
"""A change by less than this part is not worth another setting."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Which exposures may be chosen. `period_us`: only whole numbers of it, where one fits; with
    `briefly` also what is shorter than one."""

    shortest_us: float
    longest_us: float
    period_us: float | None = None
    briefly: bool = False

    def allowed(self, wanted_us: float) -> float:
        """The longest exposure that may be chosen and is no longer than wanted, else the least."""
        exposure = min(max(wanted_us, self.shortest_us), self.longest_us)
        period = self.period_us
        if period is None or period > self.longest_us or (self.briefly and exposure < period):
            return exposure
        periods = max(floor(exposure / period + 1e-6), ceil(self.shortest_us / period), 1)
        return periods * period


@dataclass(frozen=True, slots=True)
class Settings:
    """What a camera is set to and can be set to. `gain_unit` as in CameraInfo: a gain in a unit of
    the device's own cannot be converted, and is left as it is."""

    exposure_us: float
    exposure_range_us: tuple[float, float]
    refresh_hz: float  # of the projector: exposures are of whole periods
    gain: float | None = None
    gain_range: tuple[float, float] | None = None
    gain_unit: str = ""

    @property
    def amplification(self) -> float:
        """Counts an electron makes, in some constant unit."""
        return 1.0 if self.gain is None else self._linear(self.gain)

    @property
    def amplifications(self) -> tuple[float, float]:
        """The least and the greatest that can be set."""
        if self.gain is None or self.gain_range is None or self.gain_unit not in {"dB", "ISO"}:
            return self.amplification, self.amplification
        return self._linear(self.gain_range[0]), self._linear(self.gain_range[1])

    def _linear(self, gain: float) -> float:
        return gain if self.gain_unit == "ISO" else 10.0 ** (gain / 20.0)

    def named(self, amplification: float) -> float:
        """An amplification in the gain's unit."""
        return round(amplification if self.gain_unit == "ISO" else 20.0 * log10(amplification), 2)


@dataclass(frozen=True, slots=True)
class Setting:
    """What to set a camera to. `level` of the picture and `noise` of a frame, in counts, as parts
    of what they were, where shot noise rules; None: leave it as it is."""

    exposure_us: float | None
    gain: float | None
    level: float
    noise: float


def filling(now: Settings, factor: float) -> Setting:
    """How to make the picture `factor` times as bright, with the least noise.

    The lowest gain holds the most light: exposure is changed first, and gain makes up for what the
    longest exposure leaves. Exposures of more than a refresh are whole numbers of refreshes.
    """
    least, most = now.amplifications
    wanted = factor * now.exposure_us * now.amplification  # exposure times amplification
    shortest, longest = now.exposure_range_us
    longest = min(longest, max(now.exposure_us, LONGEST_US))
    period = 1e6 / now.refresh_hz
    exposure = Limits(shortest, longest, period, briefly=True).allowed(wanted / least)
    amplification = min(max(wanted / exposure, least), most)
    if amplification < 2.0 * least and exposure + period < LONGEST_US:
        amplification = least  # what the rounding to whole refreshes took is not worth a gain
    longer, gained = exposure / now.exposure_us, amplification / now.amplification
    if abs(longer - 1.0) < _ALIKE:
        longer = 1.0
    if abs(gained - 1.0) < _ALIKE:
        gained = 1.0
    return Setting(
        None if longer == 1.0 else exposure,
        None if gained == 1.0 else now.named(amplification),
        level=longer * gained,
        noise=gained * longer**0.5,  # in electrons it grows with the root of the light
    )
