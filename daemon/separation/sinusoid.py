"""Separation from sinusoids in time, by least squares in constant memory (§4.3).

A pixel that sees a source element of brightness b + (1 - b)(½ + ½ sin(φ + δ)) has, over the phases
δ, the mean M = ½(1 + b)(L_d + L_g) and the amplitude B = ½(1 - b) L_d. Three sums a frequency
(I, I cos δ, I sin δ) hold all that a fit of M, B and φ needs, whatever the number of frames, and
whichever are missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import correspondence
from daemon.separation.coordinates import other_axis
from daemon.separation.deviation import stated
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.fading import PHASES, fading
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.handedness import STRONG, strength
from daemon.separation.periods import agreed
from daemon.separation.radiometry import Plane, Response
from daemon.separation.references import References
from daemon.separation.residue import mirrored
from daemon.separation.ripple import Ripple, ripple
from daemon.separation.scan_noise import ResidualNoise, Told
from daemon.separation.steadiness import compare
from daemon.separation.straddling import Split, as_neighbours, between_phases, edges
from daemon.separation.unsmooth import Unsmooth
from daemon.separation.wave_blur import WaveBlur
from daemon.separation.wave_fit import WaveFit

_MISFIT = 5.0
"""So far above a picture's noise, what the fit leaves is not noise."""
_DOUBTFUL = 2.0
"""Above this it is none where it is also a part of the wave: ..."""
_DISTORTED = 0.05
_REFUSED = 0.1  # of direct light: if it may be off by so much, all of it is flagged
_BENT = 0.03  # of the wave: with more of it in its amplitude thrice a period, light was no sinusoid
_ODD = 0.05  # with more of it in mean or amplitude once a period, frames are not of these phases
_MANY = 0.1  # of the pixels

_DIFFER = (
    "the periods give different direct light in {:.0%} of the pixels: light is scattered or "
    "reflected over less than a period there, and direct may be too large by about the stated "
    "deviation (finer --periods tell), or the frames are not the phases and periods that were "
    "declared (--phases, --periods)"
)


class LeastSquares:
    """Frames of N >= 3 phases of one or several sinusoids -> direct, global, φ.

    `phases[i]` is pattern i's (frequency, δ in radians). Planes: `direct_std`, `global_std` (as the
    components), `phase` (H, W) in 0..2π of the first frequency, and `column` or `row` (H, W) in
    projector pixels where `periods` say how to get it. `blur_px`: the optics' as calibrated, for
    where the frames do not tell it. `patches`: phases are even within patches, and jump between.
    """

    def __init__(
        self,
        response: Response,
        *,
        phases: Sequence[tuple[int, float]],
        leakage: float,
        periods: Sequence[float] = (),
        size: int | None = None,
        weave: float = 0.0,
        axis: str = "x",
        blur_px: float | None = None,
        patches: bool = False,
    ) -> None:
        self._response = response
        self._phases = tuple(phases)
        self._leakage = leakage
        self._periods = tuple(periods)
        self._size = size
        self._weave = weave
        self._axis = axis
        self._known_blur = blur_px
        self._patches = patches
        self._references = References(response)
        self._fits = [WaveFit() for _ in range(1 + max(f for f, _ in phases))]
        self._noise = ResidualNoise(response)
        self._saturated: NDArray[np.bool_] | None = None
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that cannot be respected."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("a sinusoid is fitted to frames as they are: no warp, strength 1")
        if not observation.used:
            self._unused += 1
            return
        if observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
            self._noise.add_reference(pixels, observation.lighting)
            return
        frequency, delta = self._phases[observation.pattern]
        light = self._response.linear(pixels)
        self._fits[frequency].add(light, delta)
        self._noise.add(pixels, light, frequency, delta)
        if self._saturated is None:
            self._saturated = np.zeros(pixels.shape, dtype=np.bool_)
        self._saturated |= pixels >= self._response.saturated_from

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before a frequency has three phases."""
        ready = [fit for fit in self._fits if fit.solvable]
        if not ready or self._saturated is None:
            raise NotYet("a sinusoid needs 3 phases; they have not all come yet")
        noise = self._noise.told()
        blur = WaveBlur.of(ready, self._periods, self._weave, self._known_blur)
        total, total_var, source = self._total(ready, noise)
        directs = [self._direct(fit, noise, blur.gain(fit, n)) for n, fit in enumerate(ready)]
        solved = agreed(directs, self._periods, total)
        direct, direct_var = solved.direct, solved.direct_var
        quality = bits(solved.disagree, Quality.DISAGREE)
        noises = np.sqrt(direct_var), np.sqrt(direct_var + total_var)
        off = [solved.left, direct * np.float32(blur.doubt)]
        between: dict[str, Any] = {}
        faded: list[str] = []
        if self._patches:
            split, fade = self._between_patches(
                ready[0], noise, direct, total, noises[0], np.sqrt(total_var)
            )
            direct = split.direct
            noises = split.noise(*noises, total, np.sqrt(total_var))
            off += [split.deviation, fade.off]
            quality |= bits(split.known, Quality.EDGE) | fade.flags
            between["edges"] = round(float(np.mean(split.known)), 4)
            faded = fade.advice
        misfit, rippled = self._noise.misfit, self._ripple(ready, noise)
        wrong, lines = _wrong(misfit, self._noise.distortion, rippled)
        if wrong:
            off.append(direct * np.float32(wrong))
        if wrong > _REFUSED:
            quality |= np.uint16(Quality.DISAGREE)
        planes = stated(*noises, *off)
        reflected, told = self._mirrored(ready[0], noise)
        if reflected is not None:
            quality |= bits(reflected, Quality.RESIDUE)
        planes.update(self._correspondence(ready))
        moved, steady, advice = compare(
            self._references, _mean(ready), self._level(ready[0], noise), self._leakage
        )
        if moved is not None:
            quality |= moved
        disagreeing = float(np.mean(solved.disagree))
        facts: dict[str, Any] = {
            "estimator": "lsq",
            "patterns": sum(fit.frames for fit in self._fits),
            "frequencies": len(ready),
            **blur.facts(),
            "scattering_looked_for": len(ready) > 1 or self._patches,
            "unused_frames": self._unused,
            "lit_fraction": 0.5,
            "leakage": self._leakage,
            **noise.facts(),
            **self._references.facts(source),
            **told,
            **steady,
            **between,
            "misfit": None if misfit is None else round(misfit, 3),
            "ripple": [[round(one.tone, 4), round(one.frames, 4)] for one in rippled],
            "advice": [
                *lines,
                *([_DIFFER.format(disagreeing)] if disagreeing > _MANY else []),
                *blur.advice(),
                *faded,
                *other_axis({n: planes[n] for n in ("column", "row") if n in planes}),
                *advice,
                *noise.advice(),
            ],
        }
        return finish(
            direct,
            total - direct,
            response=self._response,
            brightest=np.maximum.reduce([fit.brightest() for fit in ready]),
            saturated=self._saturated,
            judgement=Judgement(
                direct=np.float32(SIGNIFICANT) * noises[0],
                total=np.float32(SIGNIFICANT) * noises[1],
                deviation=self._level(ready[0], noise),
            ),
            flags=quality,
            planes=planes,
            facts=facts,
        )

    def summary(self) -> dict[str, float]:
        """Frames fitted, frequencies that have a fit, frames not used."""
        return {
            "frames": float(sum(fit.frames for fit in self._fits)),
            "frequencies": float(sum(fit.solvable for fit in self._fits)),
            "unused": float(self._unused),
        }

    def _direct(self, fit: WaveFit, noise: Told, gain: float | Plane) -> tuple[Plane, Plane]:
        """Direct light and its variance from one frequency."""
        mean, cosine, sine = fit.solve()
        power = cosine * cosine + sine * sine
        _, of_wave = noise.wave_deviations(mean, np.sqrt(power))
        _, wave_var = fit.variances()
        if noise.measured:
            # |B| of noise alone is not 0: to first order its square is too large by one variance.
            power = np.maximum(power - np.float32(wave_var) * of_wave * of_wave, 0)
        of_amplitude = np.asarray(gain, np.float32) * np.float32(2.0 / (1.0 - self._leakage))
        direct: Plane = np.sqrt(power) * of_amplitude
        variance: Plane = np.square(of_wave * of_amplitude) * np.float32(wave_var)
        return direct, variance

    def _total(self, ready: list[WaveFit], noise: Told) -> tuple[Plane, Plane, str]:
        """L_d + L_g and its variance from all frequencies and references, and what they are."""
        mean = _mean(ready)
        total = self._references.total(mean, self._leakage)
        variance = total.of_references(noise.deviation)
        for fit in ready:
            own, cosine, sine = fit.solve()
            of_mean, _ = noise.wave_deviations(own, np.hypot(cosine, sine))
            by = fit.variances()[0] / len(ready) ** 2 * total.of_half
            variance += np.square(of_mean) * np.asarray(by, dtype=np.float32)
        return total.light, variance, total.source

    def _between_patches(
        self,
        fit: WaveFit,
        noise: Told,
        direct: Plane,
        total: Plane,
        direct_std: Plane,
        total_std: Plane,
    ) -> tuple[Split, Unsmooth]:
        """Random phases: what the edges of patches have too little of, and what scattering leaves
        unsure, see `straddling` and `fading`."""
        mean, wave = fit.grey()
        light: Plane = np.maximum(mean, np.float32(1e-3))
        contrast: Plane = np.asarray(np.abs(wave) / light, dtype=np.float32)
        between = between_phases(wave)
        mosaic = bool(self._response.bayer)
        own = self._grey_noise(fit, noise) / light
        edge = edges(contrast, own, between, mosaic=mosaic)
        part = np.clip(direct / np.maximum(total, np.float32(1e-3)), 0, 1)
        of_part = np.hypot(direct_std, part * total_std)
        split = as_neighbours(direct, total, of_part, edge, mosaic=mosaic)
        fade = fading(wave, contrast, own, split.direct, total, direct_std, blur=PHASES)
        return split, fade

    def _grey_noise(self, fit: WaveFit, noise: Told) -> Plane:
        """Of the wave's amplitude (H, W), colours added."""
        one = self._level(fit, noise) * np.float32(fit.variances()[1] ** 0.5)
        return one if one.ndim == 2 else np.asarray(np.sqrt(np.square(one).sum(axis=2)), np.float32)

    def _mirrored(
        self, fit: WaveFit, noise: Told
    ) -> tuple[NDArray[np.bool_] | None, dict[str, Any]]:
        """Where the phase runs against the picture's, or changes faster: see `residue`."""
        _, wave = fit.grey()
        deviation = self._level(fit, noise) * np.float32(np.sqrt(2.0 * fit.variances()[1]))
        even = bool(self._periods)
        return mirrored([wave], strength([wave], deviation), turning=even, smooth=even)

    def _ripple(self, ready: list[WaveFit], noise: Told) -> list[Ripple]:
        """How much of the wave shows in its own mean and amplitude, where three phases leave no
        residuals to say so."""
        found = []
        for fit in ready:
            if fit.frames > 3:
                continue
            mean, wave = fit.grey()
            deviation = self._level(fit, noise) * np.float32(np.sqrt(2.0 * fit.variances()[1]))
            known = ripple(mean, wave, strength([wave], deviation) > np.float32(STRONG))
            if known is not None:
                found.append(known)
        return found

    def _level(self, fit: WaveFit, noise: Told) -> Plane:
        mean, _, _ = fit.solve()
        return noise.deviation(mean)

    def _correspondence(self, ready: list[WaveFit]) -> dict[str, NDArray[Any]]:
        """Wrapped phase of the first frequency, and where the projector lit each pixel."""
        waves = []
        for fit in ready:
            _, cosine, sine = fit.solve()
            if cosine.ndim == 3:
                cosine, sine = cosine.sum(axis=2), sine.sum(axis=2)
            wave: Plane = np.arctan2(cosine, sine) % np.float32(2 * np.pi)
            waves.append(wave)
        planes: dict[str, NDArray[Any]] = {"phase": waves[0]}
        if len(ready) == len(self._periods) > 1 and self._size is not None and self._weave == 0.0:
            name = "column" if self._axis == "x" else "row"
            planes[name] = correspondence.unwrap(waves, self._periods, self._size)
        return planes


def _mean(fits: list[WaveFit]) -> Plane:
    """Light under half of the source."""
    mean: Plane = np.add.reduce([fit.solve()[0] for fit in fits]) * np.float32(1.0 / len(fits))
    return mean


def _wrong(
    misfit: float | None, distortion: float | None, rippled: list[Ripple]
) -> tuple[float, list[str]]:
    """How large a part of direct light both components may be off by where frames are no sinusoids
    in time, and what to do about it; 0 and [] where they are."""
    off, lines = 0.0, []
    if misfit is not None and (
        misfit > _MISFIT or (misfit > _DOUBTFUL and (distortion or 0.0) > _DISTORTED)
    ):
        # A curve of the second order shifts the mean by as much as its harmonic's amplitude.
        off = math.sqrt(2.0) * (distortion or 0.0)
        lines.append(
            f"the frames are {misfit:.0f} times further from a sinusoid than noise takes them: "
            "they are not the phases that were declared (--phases, --periods), the tone curve is "
            "not linear, or something moved: don't trust the components"
        )
    if (bent := max((one.tone for one in rippled), default=0.0)) > _BENT:
        off = max(off, bent)
        lines.append(
            f"the wave's amplitude goes up and down three times a period, by {bent:.0%}: the "
            "projector's or the camera's tone curve is not linear (run `umbra calibrate tone`, or "
            "give the camera's curve with --tone): don't trust the components"
        )
    elif (odd := max((one.frames for one in rippled), default=0.0)) > _ODD:
        off = max(off, odd)
        lines.append(
            f"the pattern itself shows in the components, by {odd:.0%} of the wave: the frames are "
            "not thirds of a turn apart (--phases), or not of one exposure: don't trust the "
            "components"
        )
    return off, lines
