"""Photon transfer: a camera's gain and read noise from pairs of frames of one scene."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Curve, Measurement, NotYet, Observation, Plot
from daemon.separation.radiometry import Response
from daemon.separation.sampling import line

_LEVELS = 64  # bins of counts that pairs of samples are sorted into
_ENOUGH = 400  # samples that make a level
_TOP = 0.9  # of the scale: above, noise is cut off
_ROUNDING = 1.0 / 12.0


class PhotonTransfer:
    """Pairs of frames -> variance against level, and the line through it.

    The variance of a sample is read² + k level: shot noise is Poisson, so that k is the counts that
    an electron makes. The difference of two frames of a still scene is noise alone; a change of the
    light between them is taken out by their means. Samples are sorted into levels by a frame of its
    own: sorted by their own noise, they would have another mean than their light. Memory: two
    frames and a table.
    """

    def __init__(self, response: Response) -> None:
        self._response = response
        self._open: int | None = None
        self._sorter: NDArray[Any] | None = None
        self._first: NDArray[Any] | None = None
        self._samples = np.zeros(_LEVELS)
        self._light = np.zeros(_LEVELS)
        self._squares = np.zeros(_LEVELS)
        self._pairs = 0
        self._flicker: list[float] = []

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`: of each pattern the first frame sorts, then come pairs."""
        if observation.pattern != self._open:
            self._open = observation.pattern
            self._sorter = self._first = None
        if not observation.used:
            self._first = None
        elif self._sorter is None:
            self._sorter = pixels.copy()
        elif self._first is None:
            self._first = pixels.copy()
        else:
            self._pair(self._sorter, self._first, pixels)
            self._first = None

    def _pair(self, sorter: NDArray[Any], one: NDArray[Any], other: NDArray[Any]) -> None:
        top = min(self._response.saturated_from, self._response.full_scale) * _TOP
        good = sorter < top
        if np.count_nonzero(good) < _ENOUGH:
            return
        black = self._response.black
        first, second = one[good] - np.float64(black), other[good] - np.float64(black)
        means = float(first.mean()), float(second.mean())
        drift = means[0] / means[1] if min(means) > 5 else 1.0
        difference = first - second * drift
        mean = (first + second * drift) / 2
        index = (sorter[good] * (_LEVELS / (self._response.full_scale + 1))).astype(np.intp)
        self._samples += np.bincount(index, minlength=_LEVELS)
        self._light += np.bincount(index, mean, minlength=_LEVELS)
        self._squares += np.bincount(index, difference**2, minlength=_LEVELS)
        self._pairs += 1
        self._flicker.append(drift - 1.0)

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet without samples at several levels."""
        enough = self._samples >= _ENOUGH
        if np.count_nonzero(enough) < 3:
            raise NotYet(
                f"{np.count_nonzero(enough)} levels of light have enough samples, and 3 are "
                "needed: expose longer (--exposure), so that the scene fills the camera's scale"
            )
        samples = self._samples[enough]
        level = self._light[enough] / samples
        variance = self._squares[enough] / (2 * samples)
        sd = variance * np.sqrt(2.0 / samples) + 1e-9
        (floor, slope), (floor_sd, slope_sd) = line(level, variance, sd)
        if slope <= 0:
            raise NotYet("the noise does not grow with the light: is the camera's output linear?")
        read = max(floor - _ROUNDING, 0.0) ** 0.5
        gain = 1.0 / slope
        room = self._response.full_scale - self._response.black
        flicker = float(np.std(self._flicker)) if len(self._flicker) > 1 else 0.0
        off = float(np.max(np.abs(variance - floor - slope * level) / (floor + slope * level)))
        advice = []
        if off > 0.2:
            advice.append(
                f"Noise differs by {off:.0%} from read and shot noise at some level: the scene "
                "moved, the light flickers, or the camera's output is not linear."
            )
        facts = {
            "values": {
                "noise": {"read_counts": round(read, 5), "counts_per_e": round(slope, 7)},
            },
            "gain_e_per_count": round(gain, 4),
            "gain_sd": round(gain * slope_sd / slope, 4),
            "read_noise_counts": round(read, 4),
            "read_noise_e": round(read * gain, 3),
            "read_noise_sd_counts": round(floor_sd / (2 * read), 4) if read else None,
            "full_scale_e": round(room * gain, 1),
            "greatest_departure": round(off, 4),
            "flicker": round(flicker, 5),
            "pairs": self._pairs,
            "figures": [
                ["gain", f"{gain:.3f} ± {gain * slope_sd / slope:.3f} e⁻/count"],
                ["read noise", f"{read * gain:.2f} e⁻ ({read:.2f} counts)"],
                ["full scale", f"{room * gain:.0f} e⁻"],
            ],
            "advice": advice,
        }
        curve = Curve("variance", level, variance, sd, (floor, slope))
        plot = Plot("Photon transfer", "level (counts)", "variance (counts²)", (curve,))
        return Measurement(facts, {"photon_transfer": plot}, name="calibration")

    def summary(self) -> dict[str, float]:
        """Pairs so far."""
        return {"pairs": float(self._pairs)}
