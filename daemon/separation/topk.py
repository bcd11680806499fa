"""Separation by the k brightest and k darkest samples of each pixel, k and bias from noise.

The brightest of n samples is too bright by its own noise (§4.1's max/min: 2.7 σ too much direct
light with 25 patterns). The mean of several is less so, and what is left, with what blur takes
away, is known from the pattern set (`order_model`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.handedness import WaveSums
from daemon.separation.noise import Noise
from daemon.separation.order import Ranked
from daemon.separation.order_model import BLURS, RATIOS, OrderErrors, fit, simulate
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.residue import NOT_SHIFTS, of_shifts
from daemon.separation.scan_noise import ScanNoise
from daemon.separation.steadiness import HALF, compare

KEEP = 5
"""Samples kept at each end; a checkerboard's 25 shifts light every pixel wholly in 9 or more."""

_GROUPS = 8
_FINE = 64  # steps between tabulated ratios
_TINY = np.float32(1e-6)
_SAMPLE = 4


class TopK:
    """Means of the brightest and darkest samples, less what noise and blur do -> direct, global.

    `levels(blur)` gives the levels of the pattern set for `order_model.simulate`. Planes:
    `direct_std`, `global_std`. An update is 18 in-place maxima and minima; with `weights` (of
    `handedness.WaveSums`), by which a mirror is found, 4 products and sums more.
    """

    def __init__(
        self,
        response: Response,
        *,
        lit_fraction: float,
        leakage: float,
        levels: Callable[[float], Plane],
        average: int = 1,
        weights: NDArray[np.complex128] | None = None,
    ) -> None:
        self._response = response
        self._alpha = lit_fraction
        self._leakage = leakage
        self._references = References(response)
        self._noise = ScanNoise(response, average)
        self._mean = FrameMean(response) if average > 1 else None
        self._average = average
        self._open: int | None = None
        self._low = Ranked(KEEP, largest=False)
        self._high = Ranked(KEEP, largest=True)
        self._saturated: NDArray[np.bool_] | None = None
        self._waves = None if weights is None else WaveSums(weights)
        self._models = simulate(levels, KEEP)
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that ranking cannot respect."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("ranking compares frames as they are: no warp, strength 1")
        if not observation.used:
            self._unused += 1
        elif observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
            return
        elif self._mean is None:
            if self._low.frames == 0:
                self._noise.add(pixels, observation.pattern)
            self._rank(pixels, observation.pattern)
        else:
            if self._open is not None and self._open != observation.pattern:
                self._close(self._mean)
            self._open = observation.pattern
            self._mean.add(pixels)
            self._noise.add(pixels, observation.pattern)
            clipped = pixels >= self._response.saturated_from
            self._saturated = clipped if self._saturated is None else self._saturated | clipped
        if self._mean is not None and observation.last:
            self._close(self._mean)

    def _close(self, mean: FrameMean) -> None:
        if mean.frames and self._open is not None:
            self._rank(mean.value(), self._open)
        mean.clear()
        self._open = None

    def _rank(self, samples: NDArray[Any], pattern: int) -> None:
        self._low.add(samples)
        self._high.add(samples)
        if self._waves is not None:
            self._waves.add(samples, pattern)

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before two patterns are in; with fewer than two ranks of
        `KEEP` the brightest and the darkest are taken as they are."""
        patterns = self._low.frames
        if patterns < 2:
            raise NotYet(f"ranking needs 2 patterns, {patterns} came so far")
        low, high = self._light(self._low.planes), self._light(self._high.planes)
        raw = high[:2].mean(axis=0) - low[:2].mean(axis=0)
        if patterns < 2 * KEEP:
            blur, model = None, None
            deviation = self._deviation(None, high[0])
            lit, unlit, covariance = high[0], low[0], np.zeros_like(raw)
            step_std, unlit_std = np.float32(np.sqrt(2.0)) * deviation, deviation
        else:
            blur, noise = self._explain(self._models, low, high, raw)
            model = self._models[blur]
            deviation = self._deviation(noise, (high[0] + low[0]) * np.float32(0.5))
            deviation = np.minimum(deviation, _local_limit(low, high))
            lit, unlit, step_std, unlit_std, covariance = _corrected(
                model, low, high, raw, deviation
            )
        rounding = self._response.deviation(None, self._response.counts(high[0]))
        b = self._leakage
        g = light_model.global_weight(self._alpha, b)
        moved: NDArray[np.uint16] | None = None
        steady: dict[str, Any] = {}
        advice: list[str] = []
        if abs(self._alpha - 0.5) < HALF:
            middle = (lit + unlit) * np.float32(0.5)
            moved, steady, advice = compare(self._references, middle, deviation, b, ranked=True)
        ambient, source = self._references.ambient(lit, unlit, self._alpha, b)
        if ambient is not None:
            lit, unlit = lit - ambient, unlit - ambient
        direct, indirect = light_model.from_extremes(lit, unlit, self._alpha, b)
        # L_g = (unlit - b lit)/((1-b) g) = unlit/g - b step/((1-b) g); ambient light adds its own
        share = b / ((1.0 - b) * g)
        reference = 0.0 if ambient is None else self._references.share(source) / g**2
        global_var = (
            np.square(unlit_std) * np.float32(1 / g**2)
            + np.square(step_std) * np.float32(share**2)
            - covariance * np.float32(2 * share / g)
            + np.square(deviation) * np.float32(reference * self._average)
        )
        direct_std = step_std * np.float32(1.0 / (1.0 - b))
        whole, clipped = self._references.whole(b), self._references.white_saturated
        if whole is not None and clipped is not None:
            # W - K holds half as much noise of the references as the darkest samples less K
            source = whole.source
            alone = direct_std**2 + deviation**2 * np.float32(whole.of_frame * self._average)
            np.copyto(indirect, whole.light - direct, where=~clipped)
            np.copyto(global_var, alone, where=~clipped)
        planes: dict[str, NDArray[Any]] = {
            "direct_std": direct_std,
            "global_std": np.sqrt(np.maximum(global_var, 0)),
        }
        saturated = self._saturated
        if saturated is None:
            saturated = self._high.planes[0] >= self._response.saturated_from
        # ranks hold counts, averages light: near enough for a limit
        mirrored, told, as_declared = of_shifts(self._waves, deviation)
        flags = np.zeros(direct.shape[:2], dtype=np.uint16) if moved is None else moved
        if mirrored is not None:
            flags |= bits(mirrored, Quality.RESIDUE)
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=high[0],
            saturated=saturated,
            flags=flags,
            judgement=Judgement(
                direct=np.float32(SIGNIFICANT) * np.maximum(planes["direct_std"], rounding),
                total=np.float32(SIGNIFICANT) * np.maximum(planes["global_std"], rounding),
                deviation=deviation,
            ),
            planes=planes,
            facts={
                "estimator": "topk",
                "patterns": patterns,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": b,
                "blur_px": None if blur is None else BLURS[blur],
                "samples_averaged": {
                    str(ratio): int(k)
                    for ratio, k in zip(RATIOS, () if model is None else model.k, strict=False)
                },
                "noise_from": "repeated frames" if self._noise.measured else "ranks",
                **told,
                **steady,
                "advice": ([] if as_declared else [NOT_SHIFTS]) + advice,
                **self._references.facts(source),
            },
        )

    def _light(self, samples: NDArray[Any]) -> Plane:
        return self._response.linear(samples) if self._mean is None else samples

    def _explain(
        self, models: tuple[OrderErrors, ...], low: Plane, high: Plane, raw: Plane
    ) -> tuple[int, Noise | None]:
        """The blur and the noise that explain how far apart the ranks are."""
        low, high = low[:, ::_SAMPLE, ::_SAMPLE], high[:, ::_SAMPLE, ::_SAMPLE]
        step = raw[::_SAMPLE, ::_SAMPLE].reshape(-1)
        gaps = ((high[:1] - high[1:]) + (low[1:] - low[:1])).reshape(KEEP - 1, -1) * 0.5
        level = ((high[0] + low[0]) * 0.5).reshape(-1)
        lit = step > np.quantile(step, 0.1)
        order = np.argsort(level[lit], kind="stable")
        groups = [g for g in np.array_split(np.flatnonzero(lit)[order], _GROUPS) if g.size >= 32]
        if not groups:
            return 0, None
        # medians: an edge of the scene, or a mirror, is in the minority
        steps = np.array([float(np.median(step[g])) for g in groups])
        seen = np.stack([np.mean(gaps[:, g] / np.maximum(step[g], 1e-6), axis=1) for g in groups])
        light = np.array([float(np.median(level[g])) for g in groups], dtype=np.float32)
        pictured = self._noise.deviation(light) / np.maximum(steps, 1e-6)
        blur, ratios = fit(models, seen.astype(np.float64), pictured.astype(np.float64))
        if self._noise.measured:
            return blur, None
        sigma = ratios * steps / np.interp(np.log(ratios), np.log(RATIOS), models[blur].step)
        slope = self._response.slope(self._response.counts(light))
        levels = self._response.counts(light).astype(np.float64)
        return blur, Noise(
            tuple(levels.tolist()),
            tuple(np.maximum(sigma / np.maximum(slope, 1e-9), 12.0**-0.5).tolist()),
        )

    def _deviation(self, noise: Noise | None, light: Plane) -> Plane:
        if noise is None:
            return self._noise.deviation(light)
        return self._response.deviation(noise, self._response.counts(light))

    def summary(self) -> dict[str, float]:
        """Patterns ranked and frames not used."""
        return {"patterns": float(self._low.frames), "unused": float(self._unused)}


def _local_limit(low: Plane, high: Plane) -> Plane:
    """The most noise that the ranks around a pixel allow.

    Noise parts the first of the kept ranks from the last; where it does not, as in black where
    every count is 0, there is none to correct. The least distance that so many ranks have is 1.2
    deviations (of 25 samples); half as much again is allowed.
    """
    apart = ((high[0] - high[-1]) + (low[-1] - low[0])) * np.float32(0.5)
    around = cv2.blur(apart, (9, 9), borderType=cv2.BORDER_REFLECT)
    return np.asarray(around, dtype=np.float32).reshape(apart.shape) * np.float32(1.5 / 1.2)


def _corrected(
    model: OrderErrors, low: Plane, high: Plane, raw: Plane, deviation: Plane
) -> tuple[Plane, Plane, Plane, Plane, Plane]:
    """Lit and unlit light without bias; deviations of their difference and of the latter, and the
    two's covariance."""
    seen = np.array(RATIOS) / model.step  # what σ over the raw step would be at each ratio
    fine = np.arange((len(RATIOS) - 1) * _FINE + 1) / _FINE
    ratio = deviation / np.maximum(raw, _TINY)
    np.log(np.maximum(ratio, np.float32(seen[0])), out=ratio)
    place = np.interp(ratio, np.log(seen), np.arange(len(RATIOS)) * _FINE).astype(np.uint16)

    def at(values: NDArray[Any]) -> Plane:
        table = np.interp(fine, np.arange(len(RATIOS)), values).astype(np.float32)
        return np.take(table, place)

    # beyond the table noise is all there is: its effect grows with it, not with the step
    step = np.maximum(raw / at(model.step), deviation * np.float32(1.0 / RATIOS[-1]))
    which = np.take(model.k[np.rint(fine).astype(np.intp)].astype(np.uint8), place)
    lit, unlit = np.zeros_like(raw), np.zeros_like(raw)
    brighter, darker = np.zeros_like(raw), np.zeros_like(raw)
    for k in range(1, int(which.max()) + 1):
        brighter += high[k - 1]
        darker += low[k - 1]
        chosen = which == k
        if chosen.any():
            of = np.float32(1.0 / k)
            np.copyto(lit, brighter * of - at(model.lit[:, k - 1]) * step, where=chosen)
            np.copyto(unlit, darker * of - at(model.unlit[:, k - 1]) * step, where=chosen)
    # corrected past each other: there is no step to be told from noise
    crossed = lit < unlit
    middle = (lit + unlit) * np.float32(0.5)
    np.copyto(lit, middle, where=crossed)
    np.copyto(unlit, middle, where=crossed)
    return (
        lit,
        unlit,
        at(model.spread_step) * step,
        at(model.spread_unlit) * step,
        at(model.covariance) * step * step,
    )
