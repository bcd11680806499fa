"""Separation from a pattern and its complement (§3.3, Eq. 8)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.deviation import stated
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.fading import HALVES, fading
from daemon.separation.finish import Judgement, bits, finish
from daemon.separation.handedness import strength
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.residue import mirrored
from daemon.separation.scan_noise import ScanNoise, Told
from daemon.separation.steadiness import compare
from daemon.separation.straddling import as_neighbours, between_halves, edges


class ComplementPair:
    """Two images -> direct, global. Frames of pattern 0 and of its complement, pattern 1, are
    averaged in linear light; both have come when there is a result."""

    def __init__(
        self, response: Response, *, lit_fraction: float, leakage: float, average: int = 1
    ) -> None:
        self._response = response
        self._alpha = lit_fraction
        self._leakage = leakage
        self._references = References(response)
        self._means = (FrameMean(response), FrameMean(response))
        self._noise = ScanNoise(response, average)
        self._average = average
        self._saturated: NDArray[np.bool_] | None = None
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that cannot be respected."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("a complement pair is taken as it is: no warp, strength 1")
        if not observation.used:
            self._unused += 1
        elif observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
            self._noise.add_reference(pixels, observation.lighting)
        else:
            self._means[observation.pattern].add(pixels)
            self._noise.add(pixels, observation.pattern)
            if self._saturated is None:
                self._saturated = np.zeros(pixels.shape, dtype=np.bool_)
            self._saturated |= pixels >= self._response.saturated_from

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before both images are in."""
        missing = [
            n
            for n, mean in zip(("pattern", "complement"), self._means, strict=True)
            if not mean.frames
        ]
        if missing or self._saturated is None:
            raise NotYet(f"two images are needed: the {' and the '.join(missing)} is missing")
        first, second = (mean.value() for mean in self._means)
        ambient, source = self._ambient(first, second)
        lit, unlit = (first, second) if ambient is None else (first - ambient, second - ambient)
        brightest = np.maximum(first, second)
        told = self._noise.told()
        deviation = told.deviation(brightest)
        moved, steady, advice = compare(
            self._references, (first + second) * np.float32(0.5), deviation, self._leakage
        )
        direct, indirect = light_model.from_complement_pair(lit, unlit, self._alpha, self._leakage)
        darker = told.deviation(np.minimum(first, second))
        direct_std, global_std = self._deviations(told, deviation, darker)
        wave, part, noise = self._seen(lit, unlit, deviation)
        mosaic = bool(self._response.bayer)
        between = between_halves(wave, noise)
        contrast = np.abs(wave) * part
        edge = edges(contrast, noise * part, between, mosaic=mosaic)
        total: Plane = direct + indirect
        of_part = self._of_part(np.maximum(lit, unlit), np.minimum(lit, unlit), deviation, darker)
        split = as_neighbours(direct, total, of_part, edge, mosaic=mosaic)
        direct, indirect = split.direct, total - split.direct
        noises = split.noise(direct_std, global_std, total, direct_std)
        waves = [wave.astype(np.complex64)]
        fade = fading(waves[0], contrast, noise * part, direct, total, noises[0], blur=HALVES)
        planes = stated(*noises, split.deviation, fade.off)
        flags = bits(split.known, Quality.EDGE) | bits(edge & ~split.known, Quality.LOW_MODULATION)
        flags |= fade.flags
        strong = strength(waves, noise)
        reflected, mirrors = mirrored(waves, strong, turning=False, smooth=False)
        if reflected is not None:
            flags |= bits(reflected, Quality.RESIDUE)
        if moved is not None:
            flags |= moved
        share = float(np.mean(edge))
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=brightest,
            saturated=self._saturated,
            flags=flags,
            planes=planes,
            judgement=Judgement.of_extremes(deviation, 2),
            facts={
                "estimator": "complement pair",
                "patterns": 2,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": self._leakage,
                **told.facts(),
                **self._references.facts(source),
                **steady,
                **mirrors,
                "edges": round(share, 4),
                **self._residual(first, second),
                "advice": fade.advice + advice + told.advice(),
            },
        )

    def _seen(self, lit: Plane, unlit: Plane, deviation: Plane) -> tuple[Plane, Plane, Plane]:
        """Lit less unlit light of both images (H, W), which is h P - g I; what makes it a part of
        all the light; and its noise. Colours are added."""
        g = light_model.global_weight(self._alpha, self._leakage)
        h = light_model.global_weight(1.0 - self._alpha, self._leakage)
        wave: Plane = np.float32(h) * lit - np.float32(g) * unlit
        whole: Plane = lit + unlit
        noise: Plane = deviation * np.float32(np.hypot(g, h))
        if wave.ndim == 3:
            wave, whole = wave.sum(axis=2), whole.sum(axis=2)
            noise = np.asarray(np.sqrt(np.square(noise).sum(axis=2)), dtype=np.float32)
        part: Plane = np.reciprocal(np.maximum(whole, np.float32(1e-3)))
        return wave, part, noise

    def _deviations(self, told: Told, most: Plane, least: Plane) -> tuple[Plane, Plane]:
        """Standard deviations of direct and global from noise where lit and unlit."""
        b, g = self._leakage, light_model.global_weight(self._alpha, self._leakage)
        h = light_model.global_weight(1.0 - self._alpha, b)
        singular = min(light_model.complement_determinants(self._alpha, b))
        unlit_var = np.square(least)  # in L_g = (I_unlit - A - b(I_lit - A))/det
        for kind in (Lighting.AMBIENT, Lighting.BLACK):
            reference = self._references.mean(kind)
            if reference is not None:
                share = self._average * (1.0 - b) ** 2 / self._references.frames(kind)
                unlit_var += np.square(told.deviation(reference)) * np.float32(share)
                break
        by = np.float32(1.0 / singular)
        of_direct: Plane = np.hypot(most * np.float32(h), least * np.float32(g)) * by
        of_global: Plane = np.sqrt(unlit_var + np.square(most * np.float32(b))) * by
        return of_direct, of_global

    def _of_part(self, bright: Plane, dark: Plane, most: Plane, least: Plane) -> Plane:
        """The deviation of direct light's part of all the light, times all the light, by noise in
        (bright - dark)/(bright + dark)."""
        whole = np.maximum(bright + dark, most + least)
        by = np.float32(2.0 / (1.0 - self._leakage)) / np.maximum(whole, np.float32(1e-3))
        of_part: Plane = np.hypot(dark * most, bright * least) * by
        return of_part

    def _ambient(self, first: Plane, second: Plane) -> tuple[Plane | None, str]:
        """Ambient light; a black frame's leakage is (L_d + L_g) b, and P + I = 2A + (1 + b) times
        the same whole, so that A = K - b(P + I - 2K)/(1 - b) whatever α is."""
        off = self._references.mean(Lighting.AMBIENT)
        if off is not None:
            return off, "ambient frame"
        black = self._references.mean(Lighting.BLACK)
        if black is None:
            return None, "none"
        b = self._leakage
        whole: Plane = (first - black) + (second - black)
        ambient: Plane = black - whole * np.float32(b / (1.0 - b))
        return ambient, "black frame and the pair"

    def _residual(self, first: Plane, second: Plane) -> dict[str, Any]:
        """Median of (P + I - W - K)/(W + K): not 0 for a wrong tone curve."""
        black = self._references.mean(Lighting.BLACK)
        white = self._references.mean(Lighting.WHITE)
        if black is None or white is None:
            return {}
        whole = white + black
        bright = whole > 0.1 * float(np.max(whole))
        if not bright.any():
            return {}
        residual = (first + second - whole)[bright] / whole[bright]
        return {"complement_residual": round(float(np.median(residual)), 5)}

    def summary(self) -> dict[str, float]:
        """Frames of both images, and those not used."""
        frames = sum(mean.frames for mean in self._means)
        return {"frames": float(frames), "unused": float(self._unused)}
