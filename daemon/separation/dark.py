"""The camera without light: black level, read noise, hot pixels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Curve, Measurement, NotYet, Observation, Plot
from daemon.separation.radiometry import Plane
from daemon.separation.sampling import Moments, Turns, line

_HOT = 8.0
"""A hot pixel is above its neighbours by so many standard deviations of its mean, and ..."""
_HOT_COUNTS = 2.0
"""... by so many counts."""
_APART = 1.01
"""Exposures whose quotient is less are one exposure: a line through them says nothing."""

_SEEN = 2.0
"""Light has reached the sensor where the picture varies so many times more than its noise."""


class Dark:
    """Frames with the source off, at several exposures -> black level, read noise, hot pixels.

    Level and variance are straight lines against the exposure, whatever light still arrives: what
    they have at no exposure is the black level and the read noise. Memory: a few planes.
    """

    def __init__(self, full_scale: int, exposures: int, bayer: str = "") -> None:
        self._full_scale = full_scale
        self._exposures = exposures
        self._step = 2 if bayer else 1
        self._open = Moments()
        self._turns = Turns()
        self._exposure_us = 0.0
        self._points: list[tuple[float, float, float]] = []  # exposure in µs, level, variance
        self._longest: tuple[float, Plane, float] | None = None  # and the deviation of its mean

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        if self._turns.overdue(observation) is not None:
            self._close()
        self._exposure_us = observation.exposure_us
        if observation.used:
            self._open.add(pixels)
        if observation.last:
            self._close()

    def _close(self) -> None:
        if self._open.frames > 1:
            mean, variance = self._open.mean(), self._open.variance()
            usual = np.abs(mean - np.median(mean)) <= 8 * _robust(mean)
            level = float(mean[usual].mean(dtype=np.float64))
            spread = float(variance[usual].mean(dtype=np.float64))
            self._points.append((self._exposure_us, level, spread))
            deviation = (spread / self._open.frames) ** 0.5
            if self._longest is None or self._exposure_us >= self._longest[0]:
                self._longest = self._exposure_us, mean, deviation
        self._open = Moments()

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet before the last exposure is in, and for a camera that does
        not expose as it is told."""
        if len(self._points) < self._exposures or self._longest is None:
            raise NotYet(f"{len(self._points)} of {self._exposures} exposures have been taken")
        exposure, level, variance = (np.asarray(c) for c in zip(*self._points, strict=True))
        if exposure.max() <= _APART * exposure.min():
            raise NotYet(
                f"the camera says that it exposed for {exposure.max() / 1e3:.3g} ms each time, "
                "whatever it was told: switch its automatic exposure off, or set the exposure that "
                "scans use on the camera and do without this calibration"
            )
        (black, rate), (black_sd, _) = line(exposure, level)
        (floor, growth), _ = line(exposure, variance)
        read = max(floor, 0.0) ** 0.5
        longest_us, mean, deviation = self._longest
        structure = _robust(_without(mean, self._step))
        rise = rate * longest_us
        lit = _robust(mean) > _SEEN * max(deviation, 0.29) and rise > 0.5
        hot = self._hot(mean, max(deviation, structure))
        number = None if lit else int(np.count_nonzero(hot))
        advice = []
        if lit:
            advice.append(
                f"Light reached the sensor ({rise:.1f} counts at {longest_us / 1e3:.3g} ms): the "
                "black level is what is left at no exposure; to count hot pixels, cover the lens."
            )
        if level.min() < 3 * read:
            advice.append("Noise is cut off at 0 counts: raise the camera's black level.")
        facts = {
            "values": {"black": round(black, 4), "read_noise": round(read, 4)},
            "black_counts": round(black, 4),
            "black_sd": round(black_sd, 4),
            "read_noise_counts": round(read, 4),
            "counts_per_second": round(rate * 1e6, 4),
            "hot_pixels": number,
            "light_reached_the_sensor": lit,
            "exposures_us": [float(e) for e in exposure],
            "full_scale": self._full_scale,
            "figures": [
                ["black level", f"{black:.2f} ± {black_sd:.2f} counts"],
                ["read noise", f"{read:.2f} counts"],
                ["hot pixels", "not counted: light" if number is None else str(number)],
            ],
            "advice": advice,
        }
        ms = exposure / 1e3
        curve = Curve("level", ms, level, np.sqrt(variance), (black, rate * 1e3))
        spread = Curve("variance", ms, variance, None, (floor, growth * 1e3))
        plots = {
            "level": Plot("Level in the dark", "exposure (ms)", "counts", (curve,), False),
            "variance": Plot("Variance in the dark", "exposure (ms)", "counts²", (spread,)),
        }
        planes: dict[str, NDArray[Any]] = {"dark": mean}
        if not lit:
            planes["hot"] = np.asarray(hot if hot.ndim == 2 else hot.any(axis=2), dtype=np.uint16)
        return Measurement(facts, plots, planes, name="calibration")

    def _hot(self, mean: Plane, deviation: float) -> NDArray[np.bool_]:
        return np.asarray(_without(mean, self._step) > max(_HOT * deviation, _HOT_COUNTS))

    def summary(self) -> dict[str, float]:
        """Exposures that are complete."""
        return {"exposures": float(len(self._points))}


def _without(mean: Plane, step: int) -> Plane:
    """What a plane has above the median of each sample's neighbours of its own colour."""
    found = np.empty_like(mean)
    for y in range(step):
        for x in range(step):
            cut = np.ascontiguousarray(mean[y::step, x::step])
            found[y::step, x::step] = cut - cv2.medianBlur(cut, 5)
    return found


def _robust(plane: Plane) -> float:
    """Standard deviation by the median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(plane - np.median(plane))))
