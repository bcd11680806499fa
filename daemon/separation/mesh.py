"""Separation behind a moving mesh (§4.2).

A mesh passes a fraction β of the source: L_max = L_d + βL_g + A and L_min = βL_g + A, with A the
light that is not the source's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.islands import LEAST_MODULATION, coverage, coverage_of_mosaic
from daemon.separation.levels import Levels, split_behind
from daemon.separation.noise import Noise
from daemon.separation.pitch import pitch_px
from daemon.separation.plateau import BAND, MEMBERS, NEAR, WHOLE, Part, Plateaus, noise_at
from daemon.separation.radiometry import Plane, Response
from daemon.separation.references import References
from daemon.separation.still import StillPlaces
from daemon.separation.warping import without

_SAMPLE = 4  # noise is measured on every fourth row and column
_FOLLOWED = 40_000  # pixels on which coverage is followed
_EVERY = 4  # frames from one look at coverage to the next
_PULLED = 0.05  # of direct: noise that pulls by more is worth a line of advice
_UNLIKE = (
    0.3  # of β: a mesh that is another one, or no mesh, lights places for so much more or less
)
_TELLING = 0.2  # of a place's light, that comes and goes with the mesh


class MeshOccluder:
    """Frames of a scene behind a moving mesh -> direct, global, coverage.

    `hole_fraction` is β; None: it is measured, by the part of the time that places are lit. With an
    open frame (no mesh) ambient light and global are told apart pixel by pixel (`split_behind`).
    `averaged` takes the mean of all samples in full light and in the umbra and states what noise
    leaves in it (`planes` direct_std, global_std); without it the single brightest and darkest (the
    paper's) are taken, whose error is a bias. `planes["coverage"]` (uint16) counts the frames in
    full light or in the umbra, whichever are fewer; 0: not covered; `least` as in `coverage`.
    """

    def __init__(
        self,
        response: Response,
        *,
        hole_fraction: float | None,
        averaged: bool = True,
        least: float | None = None,
    ) -> None:
        self._response = response
        self._least = least
        self._beta = hole_fraction
        self._averaged = averaged
        self._references = References(response)
        self._unused = 0
        self._begin()

    def _begin(self) -> None:
        self._plateaus = Plateaus()
        self._noise = StillPlaces(self._response)
        self._table: Plane | None = None
        self._mean: NDArray[np.float64] | None = None  # of the sampled pixels' linear light
        self._last: NDArray[Any] | None = None
        self._left_out: NDArray[np.uint16] | None = None  # frames that tell nothing of a pixel
        self._followed = 0  # frames when coverage was last looked at
        self._share = 0.0

    def update(
        self,
        pixels: NDArray[Any],
        observation: Observation,
        left_out: NDArray[np.bool_] | None = None,
    ) -> None:
        """See `Extremes`."""
        if not observation.used:
            self._unused += 1
        elif observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
        else:
            if observation.fresh and self._last is not None:
                self._unused += self._plateaus.frames
                self._begin()
            high, low = self._plateaus.high, self._plateaus.low
            known = (high.extreme, low.extreme) if self._plateaus.frames else None
            pixels = self._response.scaled(pixels, 1.0 / observation.strength)
            told = without(pixels, left_out, known)
            self._take(pixels, told, observation.warp is not None)
            if left_out is not None:
                if self._left_out is None:
                    self._left_out = np.zeros(left_out.shape, np.uint16)
                self._left_out += left_out

    def _take(self, pixels: NDArray[Any], told: NDArray[Any], moved: bool) -> None:
        """A frame, and what it tells of each pixel."""
        part = self._sampled(_SAMPLE)
        sample = pixels[part]
        light = self._response.linear(sample).astype(np.float64)
        if self._last is None or self._mean is None:
            self._mean = light
            self._last = pixels.copy()
        else:
            self._mean += light
            self._last[...] = pixels
        self._noise.add(pixels, interpolated=moved)
        frames = self._plateaus.frames + 1
        if frames & (frames - 1) == 0 and (noise := self.noise()) is not None:
            self._table = self._deviations(noise)
        self._plateaus.add(told, self._table)

    def _sampled(self, step: int) -> Part:
        """Every so many rows and columns; of a mosaic, of one colour."""
        even = 2 * step if self._response.bayer else step
        return np.s_[::even, ::even]

    def brightest(self) -> NDArray[Any] | None:
        """See `Extremes`."""
        return self._plateaus.high.extreme if self._plateaus.frames else None

    def noise(self) -> Noise | None:
        """See `Extremes`."""
        return self._noise.noise()

    def _deviations(self, noise: Noise) -> Plane:
        return noise.deviation(np.arange(self._response.full_scale + 1))

    # ------------------------------------------------------------ results

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before two frames are in."""
        frames = self._plateaus.frames
        if frames < 2:
            raise NotYet(f"a mesh's circle needs 2 frames, {frames} came so far")
        noise = self.noise()
        levels = self._levels(noise, WHOLE)
        one = self._response.deviation(noise, self._plateaus.high.extreme)
        beta = self._beta or self._lit_of_the_time(levels)
        split = split_behind(levels, beta, self._references, self._response, noise)
        known = split.source != "none"
        pull = self._pull(noise, levels, split.other) if self._averaged else {}
        pitch = self._pitch(beta)
        of_picture = coverage_of_mosaic if self._response.bayer else coverage
        covered = of_picture(levels, one, pitch, frames, self._least)
        seen = self._lit_of_the_time(levels, covered.frames > 0)
        judged = Judgement.of_extremes(one, frames)
        if self._averaged:
            # Of a pixel that nothing happens to, noise alone parts the ends by 2 deviations.
            sure = np.float32(SIGNIFICANT) * np.sqrt(1.0 / levels.lit + 1.0 / levels.unlit)
            limit = one * (np.float32(2.0) + sure.astype(np.float32))
            judged = Judgement(limit, limit, one)
        flags = bits(covered.never_lit, Quality.NEVER_LIT)
        flags |= bits(covered.never_unlit, Quality.NEVER_UNLIT)
        flags |= bits(covered.single, Quality.SINGLE)
        planes: dict[str, NDArray[Any]] = {"coverage": covered.frames}
        if self._averaged:
            planes |= {"direct_std": split.direct_std, "global_std": split.global_std}
        return finish(
            split.direct,
            split.indirect,
            response=self._response,
            brightest=levels.bright,
            saturated=self._plateaus.high.extreme >= self._response.saturated_from,
            flags=flags,
            planes=planes,
            judgement=judged,
            facts={
                "estimator": "plateau" if self._averaged else "maxmin",
                "frames": frames,
                "unused_frames": self._unused,
                "hole_fraction": round(beta, 5),
                "hole_fraction_from": "frames" if self._beta is None else "the scan",
                "lit_of_the_time": round(seen, 4),
                "leakage": 0.0,
                "coverage": round(covered.share, 5),
                "pitch_px": round(pitch, 2),
                **({} if known else {"ambient_in_global": round(1.0 / beta, 3)}),
                **({"noise_pulls_at_most": pull} if pull else {}),
                "advice": [*_unlike(self._beta, seen), *_advice(None if known else beta, pull)],
                **self._references.facts(split.source),
            },
        )

    def _levels(self, noise: Noise | None, part: Part) -> Levels:
        """The light of a part of the picture, in full light and in the umbra."""
        table = None if noise is None else self._deviations(noise)
        ends = (self._plateaus.high, self._plateaus.low)
        brightest, darkest = (end.extreme[part] for end in ends)
        span = brightest.astype(np.float32) - darkest
        (high, lit), (low, unlit) = (end.level(table, span, part) for end in ends)
        missed = np.zeros(high.shape[:2]) if self._left_out is None else self._left_out[part]
        told = (1.0 - missed / max(self._plateaus.frames, 1)).astype(np.float32)
        if not self._averaged:
            high, low = brightest, darkest
        return Levels.of_counts(self._response, noise, (high, lit), (low, unlit), told, MEMBERS)

    def _pull(self, noise: Noise | None, levels: Levels, other: Plane) -> dict[str, float]:
        """How far, at most, what is averaged pulls the levels together: medians of what that takes
        of direct and adds to global, each as a part of it. In a place that is in full light, or in
        the umbra, only for a moment a mean over the band of noise is off by half of it; and of the
        frames of penumbra, evenly spread from one level to the other, some are averaged. {}:
        nothing tells."""
        table = None if noise is None else self._deviations(noise)
        span, rest = levels.bright - levels.dark, levels.dark - other
        between = self._plateaus.frames - levels.lit.astype(np.float32) - levels.unlit
        in_reach = np.float32(NEAR / (1 - 2 * NEAR)) * np.maximum(between, 0)  # of penumbra
        ends = (self._plateaus.high, levels.lit), (self._plateaus.low, levels.unlit)
        high, low = (
            np.float32(BAND / 2) * noise_at(end.extreme, table) * self._response.slope(end.extreme)
            + np.float32(NEAR / 2) * span * np.minimum(in_reach / there, 1)
            for end, there in ends
        )
        tells = (span > 2 * high) & (rest > low)
        if not tells.any():
            return {}
        return {
            "direct": round(float(np.median((high + low)[tells] / span[tells])), 4),
            "global": round(float(np.median(low[tells] / rest[tells])), 4),
        }

    def _lit_of_the_time(self, levels: Levels, covered: NDArray[np.bool_] | None = None) -> float:
        """The part of the time that places are behind a hole: β, whatever the light of the room.

        By what the mean of all frames is of the way from the umbra to full light, where the mesh's
        shadow tells (and that is known: of `covered` pixels). Where places were never lit, too
        large.
        """
        assert self._mean is not None
        part = self._sampled(_SAMPLE)
        bright, dark = (x[part].astype(np.float64) for x in (levels.bright, levels.dark))
        tells = bright - dark > _TELLING * bright
        if covered is not None:
            there = covered[part]
            tells &= there if bright.ndim == 2 else there[..., None]
        passed = (self._mean / self._plateaus.frames - dark)[tells].sum()
        sent = (bright - dark)[tells].sum()
        return float(np.clip(passed / sent, 1e-3, 0.999)) if sent > 0 else 0.5

    def _pitch(self, beta: float) -> float:
        """The mesh's pitch in the picture, pixels."""
        assert self._last is not None
        noise = self.noise()
        least = 1.0 if noise is None else 4 * SIGNIFICANT * noise.typical
        ends = self._plateaus.high.extreme, self._plateaus.low.extreme
        return pitch_px(self._last, *ends, beta, 4 * LEAST_MODULATION, least)

    def summary(self) -> dict[str, float]:
        """Frames, those not used, and the share of the lit pixels that are covered."""
        frames = self._plateaus.frames
        if frames >= self._followed + _EVERY and self._last is not None:
            self._followed = frames
            step = max(1, math.isqrt(self._last.shape[0] * self._last.shape[1] // _FOLLOWED))
            part = self._sampled(step)
            noise = self.noise()
            levels = self._levels(noise, part)
            one = self._response.deviation(noise, self._plateaus.high.extreme[part])
            pitch = self._pitch(self._beta or 0.3) / (part[0].step or 1)
            self._share = coverage(levels, one, max(pitch, 3.0), frames, self._least).share
        return {"frames": float(frames), "unused": float(self._unused), "coverage": self._share}


def _unlike(beta: float | None, seen: float) -> list[str]:
    """Whether places are lit for as much of the time as behind the mesh that was told."""
    if beta is None or abs(seen - beta) < _UNLIKE * beta:
        return []
    return [
        f"places are lit for {seen:.0%} of the time, and behind this mesh they would be for "
        f"{beta:.0%}: the frames are not a mesh's, or not this one's, or it did not move far "
        "enough; see --method and --hole-fraction, or leave that away to have it measured"
    ]


def _advice(beta: float | None, pull: dict[str, float]) -> list[str]:
    """What to know of the components: `beta` where ambient light is not known, what noise does."""
    lines = []
    if beta is not None:
        lines.append(
            f"light that is not the source's (sky, room) or reaches the scene past the mesh, if "
            f"any, counts {1.0 / beta:.2g} times in global: a frame with the source off takes out "
            "the first (of a scan: --references ambient; of a recording: --ambient-frame), with "
            "one without the mesh (--open-frame) both"
        )
    if pull.get("direct", 0.0) > _PULLED:
        lines.append(
            "noise, and penumbra that it hides, may make direct up to "
            f"{pull['direct']:.0%} too small and global up to {pull['global']:.0%} too large "
            "(medians), where a place is in full light or in the umbra only for a moment: expose "
            "longer, move more slowly (--feed-mm-s), or take a coarser mesh or one that is nearer"
        )
    return lines
