"""From a sweep of checker sizes to the scan that a scene needs (Appendix A).

Fine patterns lose direct light to blur, coarse ones take local global light for direct: between
them lies the size to use. With C(s) the contrast of checkers of size s: on most surfaces C falls
short of that of the largest size by what blur takes, k(s), a median over the picture; where C/k
still grows with s, light scatters over less than s. Noise is measured in repeated frames; the
number of images follows from it by the deviations of the estimators (docs/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.blur import of_optics, of_wave
from daemon.separation.contrast import CheckerSweep
from daemon.separation.estimator import (
    Curve,
    Lighting,
    Measurement,
    NotYet,
    Observation,
    Plot,
)
from daemon.separation.exposure import BRIGHTEST, TARGET, Setting, Settings, filling
from daemon.separation.radiometry import Plane, Response
from daemon.separation.sampling import Mask, Moments

_RESOLVED = 0.95  # of the largest size's contrast: a size that has it tells pixel from pixel
_CHECKER_SD = 1.9  # of a frame's noise: error of 25 shifts by their largest and smallest samples
_SINUSOID = 12.0  # variance of global, in a frame's, times the number of phases
_MOST_PHASES = 25  # of a sinusoid: beyond, frames are averaged instead
_WEAVE = 1.0  # of the sinusoids that are advised: a scan's default


@dataclass(frozen=True, slots=True)
class Situation:
    """What is wanted and what the rig can do. `error` is of full scale, `known` the names of the
    calibration's values."""

    error: float
    settings: Settings
    leakage: float = 0.0
    known: frozenset[str] = frozenset()


class Advice:
    """References, then checkers of ascending sizes with their complements -> what to do.

    Memory: a plane a size, and a few.
    """

    def __init__(
        self,
        response: Response,
        sizes: tuple[int, ...],
        images: tuple[int, ...],
        situation: Situation,
    ) -> None:
        self._response = response
        self._sizes = sizes
        self._situation = situation
        self._planes: list[Plane] = []
        self._sweep = CheckerSweep(response, images, lambda _, plane: self._planes.append(plane))
        self._white = Moments()

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        self._sweep.update(pixels, observation)
        if observation.lighting is Lighting.WHITE and observation.used:
            self._white.add(self._response.linear(pixels))

    # ------------------------------------------------------------ results

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet before all sizes are in."""
        saturated, sign = self._sweep.references.white_saturated, self._sweep.sign
        if len(self._planes) < len(self._sizes) or saturated is None or sign is None:
            raise NotYet(f"{len(self._planes)} of {len(self._sizes)} sizes have been taken")
        _, white, good = self._sweep.lit()
        full = self._response.linear_full_scale
        sizes = np.asarray(self._sizes, dtype=np.float64)
        direct = self._direct(good)
        kept = self._kept(good, direct)
        blur, local, level = self._errors(good, kept, full)
        setting, light = self._exposure(white, saturated, full)
        variance = self._white.variance()[good]
        noise = float(np.sqrt(variance.mean(dtype=np.float64))) / full  # of a frame, full scale
        total = np.sqrt(blur**2 + local**2)
        # Of sizes that are about as good the finest: what is too coarse is not always seen.
        enough = max(1.1 * float(total.min()), self._situation.error / 2)
        best = int(np.argmax(total <= enough))
        size = self._sizes[best]
        later = noise * setting.noise  # at the exposure and gain that are advised
        exposure_us = setting.exposure_us or self._situation.settings.exposure_us
        unit = self._situation.settings.gain_unit
        blur, local = setting.level * blur, setting.level * local
        total = setting.level * total
        periods = self._periods(kept, 2 * size, setting.level * level)
        images = _images(later, self._situation.error, len(periods))
        scale = self._scale(sign, good)
        limits = [
            ("camera resolution" if scale > size / 4 else "projector blur", float(blur[best])),
            ("local scattering", float(local[best])),
            ("noise", images.noise),
        ]
        limits.sort(key=lambda limit: -limit[1])
        reached = float(np.hypot(total[best], images.noise))
        advice = self._lines(size, periods, limits, reached, light)
        exposure = "" if setting.exposure_us is None else f" --exposure {setting.exposure_us:.0f}"
        if setting.gain is not None:
            exposure += f" --gain {setting.gain:g}"
        step = max(1, 3 * size // 8)
        shifts = ceil(size / step) + 2
        commands = [
            f"umbra scan checkerboard --checker {size} --shift {step} --shifts {shifts} "
            f"--average {images.checker_average}{exposure}",
            f"umbra scan sinusoid --periods {','.join(map(str, periods))} --phases {images.phases} "
            f"--average {images.sinusoid_average}{exposure}",
        ]
        facts = {
            "checker_px": size,
            "periods_px": periods,
            "shifts": shifts,
            "shift_px": step,
            "phases": images.phases,
            "average": {
                "checkerboard": images.checker_average,
                "sinusoid": images.sinusoid_average,
            },
            "exposure_us": round(exposure_us, 1),
            "gain": self._situation.settings.gain if setting.gain is None else setting.gain,
            "gain_unit": self._situation.settings.gain_unit,
            "level_factor": round(setting.level, 4),
            "wanted_error": self._situation.error,
            "expected_error": round(reached, 5),
            "noise_of_a_frame": round(noise, 6),
            "errors_by_size": {
                str(s): {"blur": round(float(x), 5), "local_scattering": round(float(y), 5)}
                for s, x, y in zip(self._sizes, blur, local, strict=True)
            },
            "limits": [{"what": what, "error": round(error, 5)} for what, error in limits],
            "projector_px_per_camera_px": round(scale, 3),
            "commands": commands,
            "figures": [
                ["checkers", f"{size} px"],
                ["sinusoid", f"{_named(periods)}, {images.phases} phases"],
                ["exposure", f"{exposure_us / 1e3:.4g} ms"],
                [
                    "gain",
                    "as it is" if setting.gain is None else f"{setting.gain:g} {unit}".strip(),
                ],
                ["expected error", f"{reached:.2%} of full scale"],
                ["limited by", str(limits[0][0])],
            ],
            "advice": advice,
        }
        curves = (
            Curve("blur", sizes, 100 * blur),
            Curve("local scattering", sizes, 100 * local),
            Curve("both", sizes, 100 * total),
        )
        plot = Plot(
            "What a checker's size costs",
            "side of a checker (projector px)",
            "error of direct and global (% of full scale)",
            curves,
            log_x=True,
        )
        return Measurement(facts, {"sizes": plot})

    def _direct(self, good: Mask) -> Mask:
        """Which of the good samples see enough direct light for a ratio of it. Raises NotYet."""
        largest = self._planes[-1][good]
        direct: Mask = largest > 0.1 * np.quantile(largest, 0.99)
        if not direct.any():
            raise NotYet("no pixel sees direct light of the projector: is it in focus?")
        return direct

    def _kept(self, good: Mask, direct: Mask) -> list[float]:
        """What each size keeps of the largest's contrast on most surfaces."""
        largest = self._planes[-1][good][direct]
        kept = [float(np.median(plane[good][direct] / largest)) for plane in self._planes]
        return [min(k, 1.0) for k in kept]

    def _periods(self, kept: list[float], period: int, level: float) -> list[int]:
        """One period where blur takes little of the direct light of a wave, or how much is known;
        else two, whose ratio tells it."""
        lost = 1.0 - of_wave(of_optics(dict(zip(self._sizes, kept, strict=True))), period, _WEAVE)
        if "optics_blur_px" in self._situation.known or lost * level < self._situation.error / 4:
            return [period]
        return [period, 5 * period // 3]

    def _errors(
        self, good: Mask, kept: list[float], full: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """RMS errors of each size over the good samples, of full scale: by blur, and by light that
        scatters over less than the size; and direct light itself."""
        finest = next(n for n, k in enumerate(kept) if k >= _RESOLVED)
        base = self._planes[finest][good] / kept[finest]
        scale = 1.0 / ((1.0 - self._situation.leakage) * full)
        level = float(np.sqrt(np.mean(np.square(base, dtype=np.float64)))) * scale
        blur = np.asarray([(1 - k) * level for k in kept])
        # What varies within the finest size that tells pixel from pixel is not known.
        local = [0.0] * (finest + 1)
        for plane, k in zip(self._planes[finest + 1 :], kept[finest + 1 :], strict=True):
            # Noise is as often below as above: what exceeds all but few of those below is counted.
            excess = (plane[good] / k - base).astype(np.float64)
            grown = excess[excess > np.quantile(np.abs(np.minimum(excess, 0)), 0.95)]
            local.append(float(np.sqrt(np.sum(grown**2) / excess.size)) * scale)
        return blur, np.asarray(local), level

    def _exposure(self, white: Plane, saturated: Mask, full: float) -> tuple[Setting, str]:
        """What lets the scene fill the scale, and what there is to say."""
        hot = float(np.mean(saturated))
        if hot > BRIGHTEST:
            factor, said = 0.5, f"{hot:.1%} of the pixels are saturated under white"
        else:
            peak = float(np.quantile(white, 1.0 - BRIGHTEST)) / full
            factor, said = TARGET / max(peak, 1e-3), f"white reaches {peak:.0%} of the scale"
        return filling(self._situation.settings, factor), said

    def _scale(self, sign: Plane, mask: Mask) -> float:
        """Projector pixels that a camera pixel spans, from how often large checkers change."""
        step = 2 if self._response.bayer else 1  # in a mosaic, from one colour to the same
        both = mask[:, step:] & mask[:, :-step]
        if not both.any():
            return 0.0
        changed = (sign[:, step:] != sign[:, :-step]) & both
        return float(changed.sum() / both.sum()) * self._sizes[-1] / step

    def _lines(
        self,
        size: int,
        periods: list[int],
        limits: list[tuple[str, float]],
        reached: float,
        light: str,
    ) -> list[str]:
        wanted = self._situation.error
        lines = [f"Checkers of {size} px, or sinusoids of {_named(periods)}; {light}."]
        largest, error = limits[0]
        if reached > wanted:
            remedy = {
                "projector blur": "focus the projector, or stop it down",
                "camera resolution": "bring the camera closer, or take one with more pixels",
                "local scattering": "only a finer pattern, in sharper focus, gets further",
                "noise": "average more",
            }[largest]
            lines.append(
                f"The wanted {wanted:.2%} is not reached: {largest} leaves {error:.2%}; {remedy}."
            )
        else:
            lines.append(f"The wanted {wanted:.2%} is reached; the largest part is {largest}.")
        if "leakage" not in self._situation.known:
            lines.append("Leakage is taken as 0: run `umbra calibrate leak` first.")
        if len(periods) > 1:
            lines.append(
                "Blur takes a part of a sinusoid's direct light: the second period measures it, as "
                "`umbra calibrate leak` does once for all scans."
            )
        if "tone" not in self._situation.known:
            lines.append("A sinusoid needs a linear projector: run `umbra calibrate tone`.")
        return lines

    def summary(self) -> dict[str, float]:
        """Sizes so far."""
        return {"sizes": float(len(self._planes))}


@dataclass(frozen=True, slots=True)
class _Images:
    """How many images: `noise` is the error that they leave, of full scale."""

    checker_average: int
    phases: int
    sinusoid_average: int
    noise: float


def _named(periods: list[int]) -> str:
    several = "s" if len(periods) > 1 else ""
    return f"period{several} {' and '.join(map(str, periods))} px"


def _images(noise: float, wanted: float, periods: int) -> _Images:
    """For half of the wanted variance; the rest is left to the pattern."""
    part = wanted / 2**0.5
    checker = max(1, ceil((_CHECKER_SD * noise / part) ** 2))
    frames = max(3, ceil(_SINUSOID * (noise / part) ** 2))
    average = ceil(frames / (_MOST_PHASES * periods))
    phases = max(3, ceil(frames / (average * periods)))
    taken = phases * average * periods
    left = max(_CHECKER_SD * noise / checker**0.5, noise * (_SINUSOID / taken) ** 0.5)
    return _Images(checker, phases, average, left)
