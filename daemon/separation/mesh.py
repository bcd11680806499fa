"""Separation behind a moving mesh, and which pixels it covered (§4.2).

A mesh passes a fraction β of the source: L_max = L_d + βL_g + A and L_min = βL_g + A, with A the
light that is not the source's. A circle of the wrong radius leaves islands of pixels that were
never in full light, or never in the umbra. There (L_max - L_min)/L_min falls below that of the
pixels around, whatever the colour of the surface; a grey closing over the mesh's pitch, as it
appears in the picture, restores it from all sides. The scene's own shadows are larger than a pitch
and stay as they are; ones that are smaller are flagged with the islands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.noise import Noise
from daemon.separation.plateau import BAND, WHOLE, Part, Plateaus, spread
from daemon.separation.radiometry import Plane, Response
from daemon.separation.references import References
from daemon.separation.still import StillPlaces
from daemon.separation.warping import without

LEAST_MODULATION = 0.05
"""A smaller part of the light comes and goes with interreflection while the mesh moves."""

SHORTFALL = 0.15
"""A pixel whose modulation is short of its surroundings' by more was not covered."""

LEAST_FRAMES = 2
"""Frames in full light, and in the umbra, of a pixel that is covered: one is SINGLE."""

_SAMPLE = 4  # noise is measured on every fourth row and column
_FOLLOWED = 40_000  # pixels on which coverage is followed
_EVERY = 4  # frames from one look at coverage to the next
_PULLED = 0.05  # of direct: noise that pulls by more is worth a line of advice
_UNLIKE = (
    0.3  # of β: a mesh that is another one, or no mesh, lights places for so much more or less
)
_TELLING = 0.2  # of a place's light, that comes and goes with the mesh
_FINEST, _COARSEST = 5.0, 201.0  # pitches in pixels that are believed


class MeshOccluder:
    """Frames of a scene behind a moving mesh -> direct, global, coverage.

    `hole_fraction` is β; None: it is measured, by the part of the time that places are lit. With an
    open frame (no mesh) ambient light and global are told apart pixel by pixel. `averaged` takes
    the mean of all samples in full light and in the umbra, without it the single brightest and
    darkest (the paper's). `planes["coverage"]` (uint16) counts the frames in full light or in the
    umbra, whichever are fewer; 0: not covered.
    """

    def __init__(
        self, response: Response, *, hole_fraction: float | None, averaged: bool = True
    ) -> None:
        self._response = response
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
            high, low = self._plateaus.high, self._plateaus.low
            known = (high.extreme, low.extreme) if self._plateaus.frames else None
            if observation.fresh and self._last is not None:
                self._unused += self._plateaus.frames
                self._begin()
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
        brightest, darkest = levels.bright, levels.dark
        one = self._response.deviation(noise, self._plateaus.high.extreme)
        ambient = self._references.mean(Lighting.AMBIENT)
        whole = self._references.mean(Lighting.OPEN)
        beta = self._beta or self._lit_of_the_time(levels)
        if whole is not None and ambient is None:
            direct, indirect, other = light_model.from_mesh_and_open(
                brightest, darkest, whole, beta
            )
        else:
            other = np.zeros_like(brightest) if ambient is None else ambient
            direct, indirect = light_model.from_extremes(brightest - other, darkest - other, beta)
        known = ambient is not None or whole is not None
        pull = self._pull(noise, levels, other) if self._averaged else {}
        pitch = self._pitch(beta)
        covered = self._coverage(levels, one, pitch)
        seen = self._lit_of_the_time(levels, covered.frames > 0)
        judged = Judgement.of_extremes(one, frames)
        if self._averaged:
            # Of a pixel that nothing happens to, noise alone parts the ends by 2 deviations.
            sure = np.float32(SIGNIFICANT) * np.sqrt(1.0 / levels.on_bright + 1.0 / levels.on_dark)
            limit = one * (np.float32(2.0) + sure.astype(np.float32))
            judged = Judgement(limit, limit, one)
        flags = bits(covered.never_lit, Quality.NEVER_LIT)
        flags |= bits(covered.never_unlit, Quality.NEVER_UNLIT)
        flags |= bits(covered.single, Quality.SINGLE)
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=brightest,
            saturated=self._plateaus.high.extreme >= self._response.saturated_from,
            flags=flags,
            planes={"coverage": covered.frames},
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
                **self._references.facts(_source(ambient, whole)),
            },
        )

    def _levels(self, noise: Noise | None, part: Part) -> _Levels:
        """The light of a part of the picture, in full light and in the umbra."""
        table = None if noise is None else self._deviations(noise)
        ends = (self._plateaus.high, self._plateaus.low)
        brightest, darkest = (end.extreme[part] for end in ends)
        span = brightest.astype(np.float32) - darkest
        (high, on_high, lit), (low, on_low, unlit) = (end.level(table, span, part) for end in ends)
        missed = np.zeros(high.shape[:2]) if self._left_out is None else self._left_out[part]
        told = (1.0 - missed / max(self._plateaus.frames, 1)).astype(np.float32)
        if not self._averaged:
            linear = self._response.linear
            return _Levels(linear(brightest), linear(darkest), on_high, on_low, lit, unlit, told)
        between = self._response.linear_between
        return _Levels(between(high), between(low), on_high, on_low, lit, unlit, told)

    def _pull(self, noise: Noise | None, levels: _Levels, other: Plane) -> dict[str, float]:
        """How far, at most, the bands that are averaged pull the levels together: medians of what
        that takes of direct and adds to global, each as a part of it. In a place that is in full
        light, or in the umbra, only for a moment a mean over a band is off by half of it. {}:
        nothing tells."""
        table = None if noise is None else self._deviations(noise)
        brightest, darkest = (x.extreme for x in (self._plateaus.high, self._plateaus.low))
        apart = brightest.astype(np.float32) - darkest
        high, low = (
            np.float32(BAND / 2) * spread(x, apart, table) * self._response.slope(x)
            for x in (brightest, darkest)
        )
        span, rest = levels.bright - levels.dark, levels.dark - other
        tells = (span > 2 * high) & (rest > low)
        if not tells.any():
            return {}
        return {
            "direct": round(float(np.median((high + low)[tells] / span[tells])), 4),
            "global": round(float(np.median(low[tells] / rest[tells])), 4),
        }

    def _lit_of_the_time(self, levels: _Levels, covered: NDArray[np.bool_] | None = None) -> float:
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

    # ------------------------------------------------------------ coverage

    def _coverage(self, levels: _Levels, one: Plane, pitch: float) -> _Coverage:
        """`_covered` of a whole picture: of a mosaic by colours, for the neighbours to be alike."""
        if not self._response.bayer:
            return self._covered(levels, one, pitch)
        never_lit, never_unlit, single = (np.zeros(one.shape, np.bool_) for _ in range(3))
        frames = np.zeros(one.shape, np.uint16)
        count = lit = 0
        for row, column in np.ndindex(2, 2):
            part = np.s_[row::2, column::2]
            if not one[part].size:  # of a picture of a single row or column
                continue
            found = self._covered(levels.of(part), one[part], max(pitch / 2, 3.0))
            never_lit[part], never_unlit[part] = found.never_lit, found.never_unlit
            single[part], frames[part] = found.single, found.frames
            count, lit = count + found.covered, lit + found.lit
        return _Coverage(never_lit, never_unlit, single, frames, count, lit)

    def _covered(self, levels: _Levels, one: Plane, pitch: float) -> _Coverage:
        """Which pixels (H, W) were in full light and in the umbra, as far as those around tell."""
        bright, dark, noisy = (self._grey(x) for x in (levels.bright, levels.dark, one))
        span = bright - dark
        kernel = _disc(pitch)
        dim = np.maximum(cv2.blur(dark, (3, 3) if pitch < 12 else (5, 5)), noisy)
        tone, tone_around = _closed(span / np.maximum(dark, noisy), kernel)
        level, level_around = _closed(span / dim, kernel)
        expected = np.maximum(level_around * dim, np.float32(1e-3))  # what the span should be
        doubt = np.float32(SIGNIFICANT) * noisy / expected
        lit = expected > np.maximum(np.float32(LEAST_MODULATION) * bright, 2 * SIGNIFICANT * noisy)
        vague = np.float32(SIGNIFICANT) * noisy > np.float32(2 * SHORTFALL) * dark
        short = lit & (level < level_around * (1 - np.maximum(np.float32(SHORTFALL), doubt)))
        short &= vague | (tone < tone_around * np.float32(1 - SHORTFALL))
        if not lit.any():
            short = lit = np.ones_like(lit)
        # Short of what? Of light, if the brightest is further from its neighbours' than the
        # darkest is.
        light = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, kernel)
        shade = cv2.morphologyEx(dark, cv2.MORPH_OPEN, kernel)
        too_dark = np.asarray(light - bright >= dark - shade)
        # In full light, or umbra, a pixel stays a while; at the rim of an island it comes near.
        flat = span < np.maximum(2 * SIGNIFICANT * noisy, np.float32(0.3) * expected)
        rests_on = np.where(too_dark, _most(levels.lit), _most(levels.unlit))
        rests_on = rests_on / np.maximum(levels.told, np.float32(1e-3))
        briefly = flat
        for side in (too_dark, ~too_dark):
            usual = rests_on[lit & ~short & side]
            if usual.size:
                briefly = briefly | (side & (rests_on < np.median(usual) / 2))
        short &= briefly
        # The rim of an island is thinner than what smoothing leaves of it.
        rim = cv2.dilate(short.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        short |= (
            rim & lit & briefly & (span < expected * (1 - np.maximum(np.float32(SHORTFALL), doubt)))
        )
        frames = np.minimum(_most(levels.lit), _most(levels.unlit))
        frames[short] = 0
        single = lit & (frames == 1)
        wanted = int(np.count_nonzero(lit))
        covered = int(np.count_nonzero(lit & (frames >= LEAST_FRAMES)))
        return _Coverage(
            short & too_dark,
            short & ~too_dark,
            single,
            frames,
            covered,
            wanted,
        )

    def _grey(self, light: Plane) -> Plane:
        """One plane of a frame's light."""
        return light if light.ndim == 2 else np.asarray(light.mean(axis=2), dtype=np.float32)

    def _pitch(self, beta: float) -> float:
        """The mesh's pitch in the picture, pixels, from the lengths of light and shade in a frame.

        A line across holes of diameter d and pitch p meets one every p²/d, and d/p follows from β
        (square grid); the mean of rows and columns.
        """
        assert self._last is not None
        rows = np.s_[::7]  # in no step with a pitch
        spacings = []
        noise = self.noise()
        least = 1.0 if noise is None else 4 * SIGNIFICANT * noise.typical
        ends = self._plateaus.high.extreme, self._plateaus.low.extreme
        pictures = [_green(x) for x in (self._last, *ends)]
        for turned in (pictures, [x.T for x in pictures]):
            now, high, low = (x[rows].astype(np.float32) for x in turned)
            tells = high - low > np.maximum(4 * LEAST_MODULATION * high, least)
            lit = now > (high + low) / 2
            edges = (lit[:, 1:] != lit[:, :-1]) & tells[:, 1:] & tells[:, :-1]
            if edges.any():
                spacings.append(2.0 * np.count_nonzero(tells) / np.count_nonzero(edges))
        if not spacings:
            return _FINEST
        diameter = math.sqrt(4.0 * beta / math.pi)  # of the pitch
        return float(np.clip(np.mean(spacings) * min(diameter, 1.0), _FINEST, _COARSEST))

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
            self._share = self._covered(levels, one, max(pitch, 3.0)).share
        return {"frames": float(frames), "unused": float(self._unused), "coverage": self._share}


@dataclass(frozen=True, slots=True)
class _Levels:
    """Linear light in full light and in the umbra (float32), the samples that each rests on, how
    many frames were there, and the part of all frames that told of each pixel (H, W)."""

    bright: Plane
    dark: Plane
    on_bright: NDArray[np.uint16]
    on_dark: NDArray[np.uint16]
    lit: NDArray[np.uint16]
    unlit: NDArray[np.uint16]
    told: Plane

    def of(self, part: Part) -> _Levels:
        """Of a part of the picture."""
        return _Levels(*(getattr(self, field.name)[part] for field in fields(self)))


@dataclass(frozen=True, slots=True)
class _Coverage:
    """Masks (H, W), the frames that a pixel's components rest on, the pixels that are lit at all,
    and those of them which rest on LEAST_FRAMES or more."""

    never_lit: NDArray[np.bool_]
    never_unlit: NDArray[np.bool_]
    single: NDArray[np.bool_]
    frames: NDArray[np.uint16]
    covered: int
    lit: int

    @property
    def share(self) -> float:
        """Part of the lit pixels that is covered."""
        return self.covered / max(self.lit, 1)


def _closed(plane: NDArray[Any], kernel: NDArray[np.uint8]) -> tuple[Plane, Plane]:
    """A plane without its specks, and its grey closing."""
    smooth = cv2.medianBlur(np.asarray(plane, dtype=np.float32), 3)
    closed = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, kernel)
    return np.asarray(smooth, dtype=np.float32), np.asarray(closed, dtype=np.float32)


def _disc(diameter: float) -> NDArray[np.uint8]:
    side = max(3, round(diameter)) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), dtype=np.uint8)


def _green(picture: NDArray[Any]) -> NDArray[Any]:
    """The channel with most light, of a colour picture."""
    return picture if picture.ndim == 2 else picture[..., 1]


def _most(counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Of the channels the one that rests on most frames."""
    return counts.copy() if counts.ndim == 2 else np.asarray(counts.max(axis=2), dtype=np.uint16)


def _source(ambient: Plane | None, whole: Plane | None) -> str:
    """Where the ambient light is known from, for the facts."""
    if ambient is not None:
        return "ambient frame"
    return "none" if whole is None else "open frame"


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
            f"light that is not the source's (sky, room), if any, counts {1.0 / beta:.2g} times in "
            "global: a frame with the source off takes it out (of a scan: --references ambient; of "
            "a recording: --ambient-frame, or --open-frame for one without the mesh)"
        )
    if pull.get("direct", 0.0) > _PULLED:
        lines.append(
            "noise, and penumbra that it hides, may make direct up to "
            f"{pull['direct']:.0%} too small and global up to {pull['global']:.0%} too large "
            "(medians), where a place is in full light or in the umbra only for a moment: expose "
            "longer, move more slowly (--feed-mm-s), or take a coarser mesh or one that is nearer"
        )
    return lines
