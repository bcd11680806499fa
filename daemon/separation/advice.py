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

from daemon.separation.contrast import CheckerContrast
from daemon.separation.estimator import (
    Curve,
    Lighting,
    Measurement,
    NotYet,
    Observation,
    Plot,
)
from daemon.separation.radiometry import Plane, Response
from daemon.separation.sampling import Mask, Moments, Turns, bright

_RESOLVED = 0.95  # of the largest size's contrast: a size that has it tells pixel from pixel
_PEAK = 0.85  # of full scale: where the brightest part of the scene should be
_CHECKER_SD = 1.9  # of a frame's noise: error of 25 shifts by their largest and smallest samples
_SINUSOID = 12.0  # variance of global, in a frame's, times the number of phases
_MOST_PHASES = 25
_FULL_SECOND = 1e6


@dataclass(frozen=True, slots=True)
class Situation:
    """What is wanted and what the rig can do. `error` is of full scale, `known` the names of the
    calibration's values."""

    error: float
    exposure_us: float
    exposure_range_us: tuple[float, float]
    refresh_hz: float
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
        self._ends = np.cumsum(images)
        self._situation = situation
        self._references = {kind: Moments() for kind in Lighting}
        self._turns = Turns()
        self._contrast = CheckerContrast(response)
        self._saturated: Mask | None = None
        self._planes: list[Plane] = []
        self._sign: Plane | None = None

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        if observation.lighting is not Lighting.PATTERN:
            if observation.used:
                self._references[observation.lighting].add(self._response.linear(pixels))
                if observation.lighting is Lighting.WHITE:
                    saturated = pixels >= self._response.saturated_from
                    known = self._saturated
                    self._saturated = saturated if known is None else known | saturated
            return
        if (overdue := self._turns.overdue(observation)) is not None:
            self._end(overdue)
        if observation.used:
            self._contrast.add(pixels)
        if observation.last:
            self._end(observation.pattern)

    def _end(self, pattern: int) -> None:
        self._contrast.end_of_pattern()
        if pattern + 1 in self._ends:
            self._planes.append(self._contrast.take())
            self._sign = self._contrast.sign

    # ------------------------------------------------------------ results

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet before all sizes are in."""
        if len(self._planes) < len(self._sizes) or self._saturated is None or self._sign is None:
            raise NotYet(f"{len(self._planes)} of {len(self._sizes)} sizes have been taken")
        ambient = self._references[Lighting.AMBIENT].mean()
        white = self._references[Lighting.WHITE].mean()
        good = bright(ambient, white, self._saturated)
        full = self._response.linear_full_scale
        sizes = np.asarray(self._sizes, dtype=np.float64)
        blur, local = self._errors(good, full)
        factor, exposure_us, light = self._exposure(white, full)
        variance = self._references[Lighting.WHITE].variance()[good]
        noise = float(np.sqrt(variance.mean(dtype=np.float64))) / full  # of a frame, full scale
        total = np.sqrt(blur**2 + local**2)
        # Of sizes that are about as good the finest: what is too coarse is not always seen.
        enough = max(1.1 * float(total.min()), self._situation.error / 2)
        best = int(np.argmax(total <= enough))
        size = self._sizes[best]
        later = noise * factor**0.5  # shot noise at the exposure that is advised
        images = _images(later, self._situation.error)
        scale = self._scale(good)
        limits = [
            ("camera resolution" if scale > size / 4 else "projector blur", float(blur[best])),
            ("local scattering", float(local[best])),
            ("noise", images.noise),
        ]
        limits.sort(key=lambda limit: -limit[1])
        reached = float(np.hypot(total[best], images.noise))
        advice = self._lines(size, limits, reached, light)
        exposure = "" if factor == 1.0 else f" --exposure {exposure_us:.0f}"
        step = max(1, 3 * size // 8)
        shifts = ceil(size / step) + 2
        commands = [
            f"umbra scan checkerboard --checker {size} --shift {step} --shifts {shifts} "
            f"--average {images.checker_average}{exposure}",
            f"umbra scan sinusoid --periods {2 * size} --phases {images.phases} "
            f"--average {images.sinusoid_average}{exposure}",
        ]
        facts = {
            "checker_px": size,
            "period_px": 2 * size,
            "shifts": shifts,
            "shift_px": step,
            "phases": images.phases,
            "average": {
                "checkerboard": images.checker_average,
                "sinusoid": images.sinusoid_average,
            },
            "exposure_us": round(exposure_us, 1),
            "exposure_factor": round(factor, 4),
            "gain": "as it is; lower it before exposing more briefly",
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
                ["sinusoid", f"period {2 * size} px, {images.phases} phases"],
                ["exposure", f"{exposure_us / 1e3:.4g} ms"],
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

    def _errors(self, good: Mask, full: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """RMS errors of each size over the good samples, of full scale: by blur, and by light that
        scatters over less than the size. Raises NotYet where no size is resolved."""
        largest = self._planes[-1][good]
        direct = largest > 0.1 * np.quantile(largest, 0.99)  # else ratios are noise
        if not direct.any():
            raise NotYet("no pixel sees direct light of the projector: is it in focus?")
        kept = [float(np.median(plane[good][direct] / largest[direct])) for plane in self._planes]
        kept = [min(k, 1.0) for k in kept]
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
        return blur, np.asarray(local)

    def _exposure(self, white: Plane, full: float) -> tuple[float, float, str]:
        """Factor, exposure (µs) and what there is to say, for the scene to fill the scale."""
        now = self._situation.exposure_us
        low, high = self._situation.exposure_range_us
        assert self._saturated is not None
        hot = float(np.mean(self._saturated))
        if hot > 0.001:
            wanted, said = now / 2, f"{hot:.1%} of the pixels are saturated under white"
        else:
            peak = float(np.quantile(white, 0.999)) / full
            wanted, said = now * _PEAK / max(peak, 1e-3), f"white reaches {peak:.0%} of the scale"
        wanted = min(max(wanted, low), high, max(now, _FULL_SECOND))
        period = 1e6 / self._situation.refresh_hz
        if wanted >= period:
            wanted = wanted // period * period
        if abs(wanted / now - 1) < 0.1:
            wanted = now
        return wanted / now, wanted, said

    def _scale(self, good: Mask) -> float:
        """Projector pixels that a camera pixel spans, from how often large checkers change."""
        assert self._sign is not None
        sign, mask = self._sign, good
        step = 2 if self._response.bayer else 1  # in a mosaic, from one colour to the same
        both = mask[:, step:] & mask[:, :-step]
        if not both.any():
            return 0.0
        changed = (sign[:, step:] != sign[:, :-step]) & both
        return float(changed.sum() / both.sum()) * self._sizes[-1] / step

    def _lines(
        self, size: int, limits: list[tuple[str, float]], reached: float, light: str
    ) -> list[str]:
        wanted = self._situation.error
        lines = [f"Checkers of {size} px, or a sinusoid of period {2 * size} px; {light}."]
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


def _images(noise: float, wanted: float) -> _Images:
    """For half of the wanted variance; the rest is left to the pattern."""
    part = wanted / 2**0.5
    checker = max(1, ceil((_CHECKER_SD * noise / part) ** 2))
    frames = max(3, ceil(_SINUSOID * (noise / part) ** 2))
    average = ceil(frames / _MOST_PHASES)
    phases = max(3, ceil(frames / average))
    left = max(_CHECKER_SD * noise / checker**0.5, noise * (_SINUSOID / (phases * average)) ** 0.5)
    return _Images(checker, phases, average, left)
