"""What blur took from the waves of a scan, and how it is known.

Blur of standard deviation s takes exp(-2π²s²f²) from a wave of frequency f: the ratio of two waves'
amplitudes tells s, and a weave has many frequencies in one wave; of plain stripes of one period
blur and global light look alike. Light that scatters or is reflected within the scene over less
than a period takes more from the finer wave as well, but that is of some places, where blur is all
over the picture: the ratio that most of it has is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, pi

import cv2
import numpy as np

from daemon.separation.blur import of_wave
from daemon.separation.handedness import Wave
from daemon.separation.radiometry import Plane
from daemon.separation.sampling import gathered
from daemon.separation.wave_fit import WaveFit
from daemon.separation.weave import Woven, rates

_UNSURE = 0.25  # of what a known blur took: it is one figure for all the scene
_UNKNOWN, _TYPICAL = 0.5, 1.0  # of what so many px take, where it is not known
_STRONG = np.float32(0.25)  # of the picture's strong waves: weaker ones tell little
_BLURRED = 0.03  # of direct light: less is not worth saying


@dataclass(frozen=True, slots=True)
class WaveBlur:
    """`sigma` in projector pixels of projector and camera together, None where it is not known,
    and from what it is; `periods` (none: random phases, whose blur is not looked for) and `weave`
    are those of the waves."""

    sigma: float | None
    source: str
    periods: tuple[float, ...]
    weave: float

    @classmethod
    def of(
        cls, fits: Sequence[WaveFit], periods: Sequence[float], weave: float, known: float | None
    ) -> WaveBlur:
        """From several periods, else as calibrated (`known`), else from the weave of one."""
        periods = tuple(periods)
        sigma, source = None, ""
        if not periods or len(fits) != len(periods):
            pass
        elif len(fits) > 1:
            sigma, source = _of_periods(fits, periods, weave), "scan"
        elif known is not None:
            sigma, source = known, "calibration"
        else:
            woven = _woven(fits[0], periods[0], weave)
            sigma = None if woven is None else woven.blur(fits[0].grey()[0])
            source = "" if sigma is None else "weave"
        return cls(sigma, source, periods, weave)

    def gain(self, fit: WaveFit, index: int) -> float | Plane:
        """What gives a wave its amplitude back, of the shape of a frame or one for all."""
        if not self.sigma or not self.periods:
            return 1.0
        woven = _woven(fit, self.periods[index], self.weave)
        if woven is None:
            return 1.0 / of_wave(self.sigma, self.periods[index], self.weave)
        gain = woven.gain(self.sigma)
        return gain if fit.solve()[0].ndim == 2 else gain[..., None]

    @property
    def doubt(self) -> float:
        """The part of direct light that the blur leaves unsure, as a deviation: a quarter of what
        it took, for it is one figure for all the scene; unknown, half of what 1 px of it takes."""
        if not self.periods:
            return 0.0
        part, sigma = (_UNKNOWN, _TYPICAL) if self.sigma is None else (_UNSURE, self.sigma)
        kept = [of_wave(sigma, period, self.weave) for period in self.periods]
        return part * (1.0 - sum(kept) / len(kept))

    def advice(self) -> list[str]:
        """A line where blur may matter and is not known."""
        if self.sigma is not None or not self.periods:
            return []
        taken = 1.0 - min(of_wave(_TYPICAL, period, self.weave) for period in self.periods)
        if taken < _BLURRED:
            return []
        return [
            "the blur of projector and camera is not known, for one period of plain stripes does "
            f"not tell it: 1 px of it makes direct light {taken:.0%} too small, which counts as "
            "global; take the pattern with its weave (--weave 1) or a second period "
            "(--periods 16,24), or run `umbra calibrate leak`"
            if self.weave == 0.0
            else "the blur of projector and camera is not known, for too little of the picture "
            f"tells it, or with too much noise: 1 px of it makes direct light {taken:.0%} too "
            "small, which counts as global; run `umbra calibrate leak`, or take a second period "
            "(--periods 16,24)"
        ]

    def facts(self) -> dict[str, float | str | None]:
        """For quality.json."""
        return {
            "blur_px": None if self.sigma is None else round(self.sigma, 3),
            "blur_from": self.source,
            "blur_unsure": round(self.doubt, 4),
        }


def _of_periods(fits: Sequence[WaveFit], periods: Sequence[float], weave: float) -> float:
    """By the amplitudes' means over a period of the longest: a weave is once round in it."""
    squares = np.asarray([-4.0 * log(of_wave(0.5, period, weave)) for period in periods])
    waves = [fit.grey()[1] for fit in fits]
    across = _across(waves[int(np.argmax(periods))])
    means = [np.asarray(cv2.blur(np.abs(wave), (across, across)))[::2, ::2] for wave in waves]
    bright = means[0] >= _STRONG * np.quantile(means[0], 0.9)  # all where there is no light
    levels = [np.log(np.maximum(mean[bright], np.float32(1e-6))) for mean in means]
    logs = [gathered(level - levels[0]) for level in levels]
    slope = np.polyfit(squares, logs, 1)[0] if np.ptp(squares) else 0.0
    return float(np.sqrt(max(-slope, 0.0)))


def _across(wave: Wave) -> int:
    """A period in pixels of the picture, odd; as far as the picture has room for it."""
    strong = np.abs(wave) >= np.quantile(np.abs(wave), 0.5)
    rate = float(np.median(np.hypot(*rates(wave))[strong]))
    height, width = wave.shape
    return int(min(2.0 * pi / max(rate, 1e-3), height / 2, width / 2)) // 2 * 2 + 1


def _woven(fit: WaveFit, period: float, weave: float) -> Woven | None:
    return None if weave == 0.0 else Woven.of(fit.grey()[1], period=period, weave=weave)
