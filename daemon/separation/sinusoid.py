"""Separation from sinusoids in time, by least squares in constant memory (§4.3).

A pixel that sees a source element of brightness b + (1 - b)(½ + ½ sin(φ + δ)) has, over the phases
δ, the mean M = ½(1 + b)(L_d + L_g) and the amplitude B = ½(1 - b) L_d. Three sums a frequency
(I, I cos δ, I sin δ) hold all that a fit of M, B and φ needs, whatever the number of frames, and
whichever are missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import correspondence
from daemon.separation.blur import of_wave
from daemon.separation.coordinates import other_axis
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.handedness import STRONG, Wave, strength
from daemon.separation.radiometry import Plane, Response
from daemon.separation.references import References
from daemon.separation.residue import mirrored
from daemon.separation.ripple import Ripple, ripple
from daemon.separation.scan_noise import ResidualNoise, Told
from daemon.separation.steadiness import compare
from daemon.separation.straddling import Split, as_neighbours, between_phases, edges
from daemon.separation.weave import Woven

_LEAST_ECCENTRIC = 0.02
"""Least ratio of the fit's eigenvalues: phases that nearly coincide don't tell M, B, φ apart."""

_DISAGREE = 5.0
"""Frequencies disagree when their direct components differ by so many standard deviations ..."""
_DISAGREE_PART = 0.1
"""... and by this part of the light: a smaller difference is a bend of the projector's curve."""


_MISFIT = 5.0
"""So far above a picture's noise, what the fit leaves is not noise."""
_DOUBTFUL = 2.0
"""Above this it is none where it is also a part of the wave: ..."""
_DISTORTED = 0.05
_BENT = 0.03  # of the wave: with more of it in its amplitude thrice a period, light was no sinusoid
_ODD = 0.05  # with more of it in mean or amplitude once a period, frames are not of these phases
_MANY = 0.2  # of the pixels
_BLURRED = 0.03  # of direct light


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
        self._fits = [_Fit() for _ in range(1 + max(f for f, _ in phases))]
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
        blur, blur_from = self._blur(ready)
        solved = [
            self._separate(fit, noise, self._gain(fit, index, blur))
            for index, fit in enumerate(ready)
        ]
        direct, indirect, direct_var, global_var = _combine(solved)
        brightest = np.maximum.reduce([fit.brightest() for fit in ready])
        quality = np.zeros(direct.shape[:2], dtype=np.uint16)
        between: dict[str, Any] = {}
        if self._patches:
            split = self._between_patches(ready[0], noise, direct, indirect, np.sqrt(direct_var))
            total: Plane = direct + indirect
            direct, indirect = split.direct, total - split.direct
            total_std = np.sqrt(np.maximum(global_var - direct_var, np.float32(0.0)))
            direct_std, global_std = split.stated(
                np.sqrt(direct_var), np.sqrt(global_var), total, total_std
            )
            direct_var, global_var = np.square(direct_std), np.square(global_std)
            quality |= bits(split.known, Quality.EDGE)
            between["edges"] = round(float(np.mean(split.known)), 4)
        if len(solved) > 1:
            quality |= bits(_disagree(solved), Quality.DISAGREE)
        reflected, told = self._mirrored(ready[0], noise)
        rippled = self._ripple(ready, noise)
        if reflected is not None:
            quality |= bits(reflected, Quality.RESIDUE)
        doubt = self._doubt(blur)
        of_blur = np.square(direct * np.float32(doubt))
        planes: dict[str, NDArray[Any]] = {
            "direct_std": np.sqrt(direct_var + of_blur),
            "global_std": np.sqrt(global_var + of_blur),
        }
        planes.update(self._correspondence(ready))
        mean = np.add.reduce([fit.solve()[0] for fit in ready]) * np.float32(1.0 / len(ready))
        moved, steady, advice = compare(
            self._references, mean, self._level(ready[0], noise), self._leakage
        )
        if moved is not None:
            quality |= moved
        misfit = self._noise.misfit
        disagreeing = float(np.mean((quality & np.uint16(Quality.DISAGREE)) != 0))
        facts: dict[str, Any] = {
            "estimator": "lsq",
            "patterns": sum(fit.frames for fit in self._fits),
            "frequencies": len(ready),
            "blur_px": None if blur is None else round(blur, 3),
            "blur_from": blur_from,
            "blur_unsure": round(doubt, 4),
            "unused_frames": self._unused,
            "lit_fraction": 0.5,
            "leakage": self._leakage,
            **noise.facts(),
            **self._references.facts(
                self._references.total(ready[0].solve()[0], self._leakage).source
            ),
            **told,
            **steady,
            **between,
            "misfit": None if misfit is None else round(misfit, 3),
            "ripple": [[round(one.tone, 4), round(one.frames, 4)] for one in rippled],
            "advice": [
                *_advice(misfit, self._noise.distortion, disagreeing, rippled),
                *self._unknown(blur),
                *other_axis({n: planes[n] for n in ("column", "row") if n in planes}),
                *advice,
                *noise.advice(),
            ],
        }
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=brightest,
            saturated=self._saturated,
            judgement=Judgement(
                direct=np.float32(SIGNIFICANT) * np.sqrt(direct_var),
                total=np.float32(SIGNIFICANT) * np.sqrt(global_var),
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

    def _blur(self, ready: list[_Fit]) -> tuple[float | None, str]:
        """The blur of projector and camera together, in projector pixels, and how it is known: from
        several periods, else as calibrated, else from the weave of one, else (None) it is not.

        Blur of standard deviation s takes exp(-2π²s²f²) from a wave of frequency f, so the ratio of
        two waves' amplitudes tells s. The median over the scene is taken: scattering within the
        scene, which is global light, differs from place to place and stays in the amplitudes. A
        weave has many frequencies in one wave; of plain stripes blur and global light look alike.
        """
        if len(ready) != len(self._periods) or not self._periods:
            return None, ""
        if len(ready) == 1:
            if self._known_blur is not None:
                return self._known_blur, "calibration"
            woven = self._woven(ready[0], 0)
            found = None if woven is None else woven.blur(ready[0].grey()[0])
            return found, "" if found is None else "weave"
        squares = np.asarray([-4.0 * log(of_wave(0.5, p, self._weave)) for p in self._periods])
        logs = []
        first = None
        for fit in ready:
            _, cosine, sine = fit.solve()
            power = (cosine * cosine + sine * sine)[::2, ::2]
            first = power if first is None else first
            bright = first >= np.quantile(first, 0.5)  # all where there is no light at all
            ratio = power[bright] / np.maximum(first[bright], np.float32(1e-12))
            logs.append(0.5 * float(np.log(np.maximum(np.median(ratio), 1e-6))))
        slope = np.polyfit(squares, logs, 1)[0] if np.ptp(squares) else 0.0
        return float(np.sqrt(max(-slope, 0.0))), "scan"

    def _doubt(self, blur: float | None) -> float:
        """The part of direct light that the blur leaves unsure, as a deviation: a quarter of what
        it took, for it is one figure for all the scene; unknown, half of what 1 px of it takes."""
        if not self._periods:
            return 0.0
        part, sigma = (0.5, 1.0) if blur is None else (0.25, blur)
        kept = [of_wave(sigma, period, self._weave) for period in self._periods]
        return part * (1.0 - sum(kept) / len(kept))

    def _unknown(self, blur: float | None) -> list[str]:
        """A line where blur may matter and is not known."""
        if blur is not None or not self._periods:
            return []
        taken = 1.0 - min(of_wave(1.0, period, self._weave) for period in self._periods)
        if taken < _BLURRED:
            return []
        return [
            "the blur of projector and camera is not known, for one period of plain stripes does "
            f"not tell it: 1 px of it makes direct light {taken:.0%} too small, which counts as "
            "global; take the pattern with its weave (--weave 1) or a second period "
            "(--periods 16,24), or run `umbra calibrate leak`"
            if self._weave == 0.0
            else "the blur of projector and camera is not known, for too little of the picture "
            f"tells it, or with too much noise: 1 px of it makes direct light {taken:.0%} too "
            "small, which counts as global; run `umbra calibrate leak`, or take a second period "
            "(--periods 16,24)"
        ]

    def _woven(self, fit: _Fit, index: int) -> Woven | None:
        if self._weave == 0.0:
            return None
        return Woven.of(fit.grey()[1], period=self._periods[index], weave=self._weave)

    def _gain(self, fit: _Fit, index: int, blur: float | None) -> float | Plane:
        """What gives a wave its amplitude back, of the shape of a frame or one for all."""
        if not blur or not self._periods:
            return 1.0
        woven = self._woven(fit, index)
        if woven is None:
            return 1.0 / of_wave(blur, self._periods[index], self._weave)
        gain = woven.gain(blur)
        return gain if fit.solve()[0].ndim == 2 else gain[..., None]

    def _separate(
        self, fit: _Fit, noise: Told, gain: float | Plane
    ) -> tuple[Plane, Plane, Plane, Plane]:
        """Direct, global and their variances from one frequency."""
        mean, cosine, sine = fit.solve()
        b = self._leakage
        power = cosine * cosine + sine * sine
        of_mean, of_wave = noise.wave_deviations(mean, np.sqrt(power))
        mean_var, wave_var = fit.variances()
        if noise.measured:
            # |B| of noise alone is not 0: to first order its square is too large by one variance.
            power = np.maximum(power - np.float32(wave_var) * of_wave * of_wave, 0)
        amplitude: Plane = np.sqrt(power)
        of_amplitude = np.asarray(gain, np.float32) * np.float32(2.0 / (1.0 - b))
        direct: Plane = amplitude * of_amplitude
        total = self._references.total(mean, b)
        indirect: Plane = total.light - direct
        direct_var: Plane = np.square(of_wave * of_amplitude) * np.float32(wave_var)
        total_var = total.of_references(noise.deviation)
        total_var += np.square(of_mean) * np.asarray(mean_var * total.of_half, dtype=np.float32)
        return direct, indirect, direct_var, direct_var + total_var

    def _between_patches(
        self, fit: _Fit, noise: Told, direct: Plane, indirect: Plane, deviation: Plane
    ) -> Split:
        """Random phases: what the edges of patches have too little of, see `straddling`."""
        mean, wave = fit.grey()
        light: Plane = np.maximum(mean, np.float32(1e-3))
        contrast: Plane = np.asarray(np.abs(wave) / light, dtype=np.float32)
        between = between_phases(wave)
        mosaic = bool(self._response.bayer)
        edge = edges(contrast, self._grey_noise(fit, noise) / light, between, mosaic=mosaic)
        return as_neighbours(direct, direct + indirect, deviation, edge, mosaic=mosaic)

    def _grey_noise(self, fit: _Fit, noise: Told) -> Plane:
        """Of the wave's amplitude (H, W), colours added."""
        one = self._level(fit, noise) * np.float32(fit.variances()[1] ** 0.5)
        return one if one.ndim == 2 else np.asarray(np.sqrt(np.square(one).sum(axis=2)), np.float32)

    def _mirrored(self, fit: _Fit, noise: Told) -> tuple[NDArray[np.bool_] | None, dict[str, Any]]:
        """Where the phase runs against the picture's, or changes faster: see `residue`."""
        _, wave = fit.grey()
        deviation = self._level(fit, noise) * np.float32(np.sqrt(2.0 * fit.variances()[1]))
        even = bool(self._periods)
        return mirrored([wave], strength([wave], deviation), turning=even, smooth=even)

    def _ripple(self, ready: list[_Fit], noise: Told) -> list[Ripple]:
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

    def _level(self, fit: _Fit, noise: Told) -> Plane:
        mean, _, _ = fit.solve()
        return noise.deviation(mean)

    def _correspondence(self, ready: list[_Fit]) -> dict[str, NDArray[Any]]:
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


class _Fit:
    """Sums of one frequency: ΣI, ΣI cos δ, ΣI sin δ, and those of the design."""

    def __init__(self) -> None:
        self._sums: Plane | None = None
        self._scaled: Plane | None = None
        self._normal = np.zeros((3, 3))
        self.frames = 0

    def add(self, light: Plane, delta: float) -> None:
        if self._sums is None or self._scaled is None:
            self._sums = np.zeros((3, *light.shape), dtype=np.float32)
            self._scaled = np.empty_like(light)
        row = np.array([1.0, np.cos(delta), np.sin(delta)])
        self._sums[0] += light
        for index in (1, 2):
            np.multiply(light, np.float32(row[index]), out=self._scaled)
            self._sums[index] += self._scaled
        self._normal += np.outer(row, row)
        self.frames += 1

    @property
    def solvable(self) -> bool:
        if self.frames < 3:
            return False
        values = np.linalg.eigvalsh(self._normal)
        return bool(values[0] > _LEAST_ECCENTRIC * values[-1])

    def solve(self) -> tuple[Plane, Plane, Plane]:
        """M, and the factors of cos δ and sin δ: B sin φ, B cos φ."""
        assert self._sums is not None, "only a solvable fit is solved"
        inverse = np.linalg.inv(self._normal).astype(np.float32)
        found = np.tensordot(inverse, self._sums, axes=1)
        return found[0], found[1], found[2]

    def grey(self) -> tuple[Plane, Wave]:
        """M and the wave as a complex number (H, W), colours added."""
        mean, cosine, sine = self.solve()
        wave = np.asarray(cosine + 1j * sine, dtype=np.complex64)
        if wave.ndim == 3:
            return mean.sum(axis=2), np.asarray(wave.sum(axis=2), dtype=np.complex64)
        return mean, wave

    def variances(self) -> tuple[float, float]:
        """Variance of M and of one factor of the wave for samples of variance 1."""
        inverse = np.linalg.inv(self._normal)
        return float(inverse[0, 0]), float((inverse[1, 1] + inverse[2, 2]) / 2)

    def brightest(self) -> Plane:
        """Light at the crest of the fitted wave."""
        mean, cosine, sine = self.solve()
        crest: Plane = mean + np.hypot(cosine, sine)
        return crest


def _combine(solved: list[tuple[Plane, Plane, Plane, Plane]]) -> tuple[Plane, Plane, Plane, Plane]:
    """The mean over frequencies; their frames are independent and equally many."""
    if len(solved) == 1:
        return solved[0]
    direct, indirect, direct_var, global_var = (
        np.add.reduce(planes) * np.float32(1.0 / len(solved))
        for planes in zip(*solved, strict=True)
    )
    share = np.float32(1.0 / len(solved))
    return direct, indirect, direct_var * share, global_var * share


def _disagree(solved: list[tuple[Plane, Plane, Plane, Plane]]) -> NDArray[np.bool_]:
    """Where the direct components of any two frequencies differ by more than noise explains."""
    directs = np.stack([one[0] for one in solved])
    variance = np.maximum.reduce([one[2] for one in solved])
    total = np.maximum.reduce([one[0] + one[1] for one in solved])
    apart = directs.max(axis=0) - directs.min(axis=0)
    limit = np.maximum(
        np.float32(_DISAGREE * np.sqrt(2.0)) * np.sqrt(variance), np.float32(_DISAGREE_PART) * total
    )
    differ = apart > limit
    return differ if differ.ndim == 2 else np.asarray(np.logical_or.reduce(differ, axis=2))


def _advice(
    misfit: float | None, distortion: float | None, disagreeing: float, rippled: list[Ripple]
) -> list[str]:
    """What to do about frames that are no sinusoids in time; [] where they are."""
    lines = []
    if misfit is not None and (
        misfit > _MISFIT or (misfit > _DOUBTFUL and (distortion or 0.0) > _DISTORTED)
    ):
        lines.append(
            f"the frames are {misfit:.0f} times further from a sinusoid than noise takes them: "
            "they are not the phases that were declared (--phases, --periods), the tone curve is "
            "not linear, or something moved"
        )
    if (bent := max((one.tone for one in rippled), default=0.0)) > _BENT:
        lines.append(
            f"the wave's amplitude goes up and down three times a period, by {bent:.0%}: the "
            "projector's or the camera's tone curve is not linear (run `umbra calibrate tone`, or "
            "give the camera's curve with --tone)"
        )
    elif (odd := max((one.frames for one in rippled), default=0.0)) > _ODD:
        lines.append(
            f"the pattern itself shows in the components, by {odd:.0%} of the wave: the frames are "
            "not thirds of a turn apart (--phases), or not of one exposure"
        )
    if disagreeing > _MANY:
        lines.append(
            f"the periods give different direct light in {disagreeing:.0%} of the pixels: the "
            "frames are not the phases and periods that were declared (--phases, --periods), or "
            "the coarser patterns are too coarse for this scene"
        )
    return lines
