"""Separation of one image under fine stripes, at a lower resolution (§4.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.blur import of_stripes
from daemon.separation.deviation import stated
from daemon.separation.envelope import block_mean, envelope
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.fineness import astray
from daemon.separation.finish import Judgement, bits, finish
from daemon.separation.noise import Noise, from_frame
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.scan_noise import PICTURE, ReferenceNoise, Told, told
from daemon.separation.steadiness import leaks

_ASTRAY = 1.5  # times the change across stripes: along them there is no more
_OFF = 0.1  # of the light: peaks and valleys are off by less for blur and noise
_HALF = 0.1  # lit fractions so near to a half have their middle at ½(W + K)
_RESOLVED = 4.0  # samples of a colour a period: with fewer none need lie wholly in a stripe
_PIECE = 64  # pixels of a row, whose frequency is looked for
_CLEAR = 8.0  # times the power of other frequencies
_FAINT = 4.0  # deviations of white: a step of so many counts for half
_BEYOND = np.float32(0.25)  # of the step: noise takes no level further
_UNSURE, _TYPICAL = 0.5, 1.0  # of what so many projector px of blur take: it is not known
_LIT, _UNLIT = 0.8, 0.3  # typical levels of peaks and valleys
_PEAK = 0.82 * 0.9
"""Deviation of a row's peaks in a square over a pixel's: a peak is the larger of two pixels as
bright, and light interpolated between peaks is the mean of more than one."""
_LONE = 0.625**0.5  # the same of a mosaic, whose colours have one sample a stripe: 1½ and ½ of 2


class PeaksAndValleys:
    """The newest image -> direct, global at 1/`reduce` of its size.

    A pixel is a peak (valley) when it is the brightest (darkest) of `window` pixels across the
    stripes by `along` pixels along them. Light between peaks is interpolated across the stripes and
    averaged over `reduce` x `reduce` pixels; likewise between valleys; then Eq. 8. Each colour of a
    mosaic is a picture of its own, of half the size. Planes: those of `deviation.stated`, with what
    noise lifts peaks by and what blur may take from stripes of `stripe` projector pixels (None: not
    known), which nothing tells.

    With a black and a white frame peaks are those of (I - K)/(W - K), in which texture is no light:
    (L_d + α L_g)/(L_d + L_g) where lit, α L_g/(L_d + L_g) where not, whatever the leakage.

    Every image is separated on its own, so a stream is separated live; memory does not grow.
    """

    def __init__(
        self,
        response: Response,
        *,
        lit_fraction: float,
        leakage: float,
        window: int = 11,
        along: int = 1,
        reduce: int = 4,
        across: str = "x",
        stripe: float | None = None,
    ) -> None:
        if response.bayer and reduce % 2:
            raise ValueError(
                "a mosaic is reduced by an even number: its colours are 2 pixels apart"
            )
        self._response = response
        self._alpha = lit_fraction
        self._leakage = leakage
        self._window = window
        self._along = along
        self._reduce = reduce
        self._across = across
        self._blurred = 0.0 if stripe is None else _UNSURE * (1.0 - of_stripes(_TYPICAL, stripe))
        self._references = References(response)
        self._bounds = ReferenceNoise(response)
        self._mean = FrameMean(response)
        self._open: int | None = None
        self._picture: Plane | None = None
        self._saturated: NDArray[np.bool_] | None = None
        self._clipped: NDArray[np.bool_] | None = None  # of the frames being averaged
        self._images = 0
        self._frames = 0  # averaged into the picture
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that cannot be respected."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("a single image is taken as it is: no warp, strength 1")
        if not observation.used:
            self._unused += 1
        elif observation.lighting is not Lighting.PATTERN:
            self._references.add(pixels, observation.lighting)
            self._bounds.add(pixels, observation.lighting)
            return
        else:
            if self._open is not None and self._open != observation.pattern:
                self._close()
            self._open = observation.pattern
            self._mean.add(pixels)
            clipped = pixels >= self._response.saturated_from
            self._clipped = clipped if self._clipped is None else self._clipped | clipped
        if observation.last and observation.lighting is Lighting.PATTERN:
            self._close()

    def _close(self) -> None:
        if self._mean.frames:
            self._frames = self._mean.frames
            self._picture = self._mean.value()
            self._saturated = self._clipped
            self._images += 1
        self._mean.clear()
        self._clipped, self._open = None, None

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before an image is in."""
        if self._picture is None or self._saturated is None:
            raise NotYet("no image has come yet")
        picture = self._picture
        noise = self._noise(picture)
        scale = Scale.of(self._references, noise)
        lit, unlit = self._extremes(picture, scale)
        ambient, source = self._references.ambient(
            lit, unlit, self._alpha, self._leakage, self._reduced
        )
        brightest, darkest = lit, unlit
        if ambient is not None:
            lit, unlit = lit - ambient, unlit - ambient
        direct, indirect = light_model.from_extremes(lit, unlit, self._alpha, self._leakage)
        clipped = self._saturated
        if scale is not None and (white := self._references.white_saturated) is not None:
            clipped = clipped | white
        saturated = self._reduced(clipped.astype(np.float32)) > 0
        deviation = noise.deviation(brightest)
        most, least = deviation, noise.deviation(darkest)
        if scale is not None:
            most, least = (
                np.sqrt(np.square(sd) + self._reduced(scale.variance(level, self._frames)))
                for sd, level in ((most, _LIT), (least, _UNLIT))
            )
        noises = self._noises(noise, most, least)
        planes = stated(*noises, self._lifted(most, least), direct * np.float32(self._blurred))
        mirrored = self._mirrored(picture, noise)
        looked, advice = self._looked(picture, brightest, darkest)
        if scale is not None and (period := self._period(scale.levels(picture))) is not None:
            looked["stripes_px"] = round(period / 2.0, 3)
            resolved = _RESOLVED * (2.0 if self._response.bayer else 1.0)
            if period < resolved:
                advice.append(
                    f"stripes are {period / 2:.1f} camera pixels wide: most pixels see lit and "
                    "unlit at once, so that direct light is too small, and what it lacks counts "
                    f"as global: show wider ones (--stripe), or come closer, for {resolved / 2:g} "
                    "pixels and more"
                )
        plain = replace(self._response, bayer="")
        return finish(
            direct,
            indirect,
            planes=planes,
            response=plain,
            brightest=brightest,
            saturated=saturated,
            flags=None if mirrored is None else bits(mirrored, Quality.RESIDUE),
            judgement=Judgement.of_extremes(deviation, self._window * self._along),
            facts={
                "estimator": "peaks and valleys",
                "images": self._images,
                "unused_frames": self._unused,
                "lit_fraction": self._alpha,
                "leakage": self._leakage,
                "reduced_by": self._reduce,
                "texture_from": "none" if scale is None else "black and white frames",
                **noise.facts(),
                "mirrors_looked_for": mirrored is not None,
                **looked,
                **self._references.facts(source),
                "advice": advice + noise.advice(),
            },
        )

    def summary(self) -> dict[str, float]:
        """Images separated, and frames not used."""
        return {"images": float(self._images), "unused": float(self._unused)}

    def _looked(self, picture: Plane, lit: Plane, unlit: Plane) -> tuple[dict[str, Any], list[str]]:
        """Whether the picture can be that of the stripes, and of the scene of black and white."""
        lines = []
        step = 2 if self._response.bayer else 1  # to the next sample of a colour
        along, across = (
            float(np.mean(np.abs(np.diff(picture[::step, ::step], axis=axis)), dtype=np.float64))
            for axis in ((0, 1) if self._across == "x" else (1, 0))
        )
        if along > _ASTRAY * across:
            other = "y" if self._across == "x" else "x"
            lines.append(
                f"light changes {along / max(across, 1e-6):.1f} times more along the stripes than "
                f"across them: they are those of the other axis (--axis {other})"
            )
        facts: dict[str, Any] = {"change_along": round(along / max(across, 1e-6), 4)}
        black = self._references.mean(Lighting.BLACK)
        white = self._references.mean(Lighting.WHITE)
        if black is not None and white is not None and abs(self._alpha - 0.5) < _HALF:
            expected = self._reduced(white + black)
            ratio = float(np.median((lit + unlit) / np.maximum(expected, np.float32(1e-3))))
            facts["mean_ratio"] = round(ratio, 4)
            if abs(ratio - 1.0) > _OFF:
                lines.append(
                    f"peaks and valleys have {ratio:.2f} of the light of white and black, not 1: "
                    "the camera's tone curve is not the one given (--tone), or light or scene "
                    "changed since the black and white frames"
                )
            else:
                lines += leaks(self._references, self._leakage)
        return facts, lines

    def _period(self, levels: Plane) -> float | None:
        """Of the stripes, in camera pixels: a median over pieces of rows; None if there is none."""
        step = 2 if self._response.bayer else 1  # one colour of a mosaic
        rows = levels[::step, ::step] if levels.ndim == 2 else levels.mean(axis=2)
        if self._across == "y":
            rows = rows.T
        count = rows.shape[1] // _PIECE
        if not count:
            return None
        pieces = rows[:, : count * _PIECE].reshape(rows.shape[0], count, _PIECE)
        pieces = (pieces - pieces.mean(axis=2, keepdims=True)) * np.hanning(_PIECE)
        power = np.square(np.abs(np.fft.rfft(pieces, axis=2))).mean(axis=0)
        power[:, : _PIECE // 16] = 0.0  # light that changes so slowly is no stripes'
        peak = power.argmax(axis=1)
        clear = power.max(axis=1) > _CLEAR * np.median(power, axis=1)
        if not clear.any():
            return None
        return float(step * _PIECE / np.median(peak[clear]))

    def _mirrored(self, picture: Plane, told: Told) -> NDArray[np.bool_] | None:
        """Where the stripes run astray, at the lower resolution; None without black and white
        frames, which take the scene's own texture out."""
        black = self._references.mean(Lighting.BLACK)
        white = self._references.mean(Lighting.WHITE)
        if black is None or white is None or abs(self._alpha - 0.5) > _HALF:
            return None
        step, lit = white - black, picture - (white + black) * np.float32(0.5)
        noise = told.deviation(white) * np.float32(1.5**0.5)  # of the picture, ½(W + K)
        if lit.ndim == 3:
            step, lit = step.sum(axis=2), lit.sum(axis=2)
            noise = np.sqrt(np.square(noise).sum(axis=2))
        wave: Plane = lit / np.maximum(step * np.float32(0.5), noise)
        strong: Plane = np.abs(lit) / np.maximum(noise, np.float32(1e-6))
        found = astray(wave, strong, self._across)
        return None if found is None else block_mean(found.astype(np.float32), self._reduce) > 0.5

    def _lifted(self, most: Plane, least: Plane) -> Plane:
        """By how much noise makes direct light too large: a peak is the brightest of half of the
        window's pixels, a valley the darkest of the others, and no mean takes that off."""
        samples = max(self._window // (2 if self._response.bayer else 1) * self._along / 2, 1.0)
        first = NormalDist().inv_cdf((samples - 0.375) / (samples + 0.25))  # Blom's place
        by = np.float32(first / ((1.0 - self._leakage) * max(self._frames, 1) ** 0.5))
        lifted: Plane = (most + least) * by
        return lifted

    def _noises(self, told: Told, most: Plane, least: Plane) -> tuple[Plane, Plane]:
        """Deviations of the components by noise from those of one pixel's peaks and valleys.

        A peak is the largest of a few pixels as bright; it speaks for its row up to the next peak,
        so that a square of k x k averages k rows of about one peak each.
        """
        bayer = self._response.bayer
        rows = max(self._reduce // 2 if bayer else self._reduce, 1)
        sites = np.asarray((1.0, 2.0, 1.0) if bayer else 1.0, dtype=np.float32)  # of two green ones
        share = np.float32(_LONE if bayer else _PEAK) / np.sqrt(
            sites * np.float32(rows * max(self._frames, 1))
        )
        b, g = self._leakage, light_model.global_weight(self._alpha, self._leakage)
        high, low = most * share, least * share
        of_dark = np.square(low)
        for kind in (Lighting.AMBIENT, Lighting.BLACK):
            reference = self._references.mean(kind)
            if reference is not None:
                averaged = sites * np.float32(self._references.frames(kind) * rows**2)
                noise = told.deviation(self._reduced(reference))
                of_dark += np.square(noise) * (np.float32((1.0 - b) ** 2) / averaged)
                break
        of_lit = np.square(high) * np.float32(b * b)
        of_direct: Plane = np.hypot(high, low) * np.float32(1.0 / (1.0 - b))
        of_global: Plane = np.sqrt(of_dark + of_lit) * np.float32(1.0 / ((1.0 - b) * g))
        return of_direct, of_global

    def _noise(self, picture: Plane) -> Told:
        """That of one of the frames that were averaged."""
        counts = self._response.counts(picture)
        mean = from_frame(counts, self._response.full_scale, self._response.bayer)
        shown = Noise(mean.levels, tuple(d * self._frames**0.5 for d in mean.deviations))
        shown = self._bounds.of(shown)
        return told(self._response, shown, PICTURE, [shown])

    def _extremes(self, picture: Plane, scale: Scale | None) -> tuple[Plane, Plane]:
        """L_max and L_min at the lower resolution, RGB for a mosaic."""
        levels = picture if scale is None else scale.levels(picture)
        if not self._response.bayer:
            lit, unlit = self._both(levels, self._window, self._along)
        else:
            lit, unlit = np.empty_like(levels), np.empty_like(levels)
            window, along = (max(n // 2, 1) | 1 for n in (self._window, self._along))
            for y in range(2):
                for x in range(2):
                    colour = np.ascontiguousarray(levels[y::2, x::2])
                    lit[y::2, x::2], unlit[y::2, x::2] = self._both(colour, window, along)
        if scale is not None:
            lit, unlit = scale.light(lit), scale.light(unlit)
        return self._reduced(lit), self._reduced(unlit)

    def _both(self, picture: Plane, window: int, along: int) -> tuple[Plane, Plane]:
        if self._across == "y":
            turned = np.ascontiguousarray(np.swapaxes(picture, 0, 1))
            lit, unlit = envelope(turned, window, along), -envelope(-turned, window, along)
            return np.swapaxes(lit, 0, 1), np.swapaxes(unlit, 0, 1)
        return envelope(picture, window, along), -envelope(-picture, window, along)

    def _reduced(self, plane: Plane) -> Plane:
        """Means over squares; of a mosaic the means of each colour, as RGB."""
        k, bayer = self._reduce, self._response.bayer
        height, width = (n // k for n in plane.shape[:2])
        if height == 0 or width == 0:
            raise ValueError(f"an image of {plane.shape[1]} x {plane.shape[0]} cannot be 1/{k}")
        cropped = plane[: height * k, : width * k]
        if not bayer:
            return block_mean(plane, k)
        sites = cropped.reshape(height, k // 2, 2, width, k // 2, 2).mean(axis=(1, 4))
        below = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[bayer]
        rgb = np.zeros((height, width, 3), dtype=np.float32)
        for y, row in enumerate((bayer, below)):
            for x, colour in enumerate(row):
                share = np.float32(0.5 if colour == "G" else 1.0)
                rgb[..., "RGB".index(colour)] += share * sites[:, y, :, x]
        return rgb


@dataclass(frozen=True, slots=True)
class Scale:
    """The light of each pixel from black to white: levels of it are free of texture."""

    black: Plane
    step: Plane  # white less black
    sure: Plane  # 0 where the step is lost in noise, 1 where it is well above
    of_white: Plane  # variance of the white frames' mean ...
    of_black: Plane  # ... and of the black ones'

    @classmethod
    def of(cls, references: References, noise: Told) -> Scale | None:
        """None without both frames."""
        black, white = references.mean(Lighting.BLACK), references.mean(Lighting.WHITE)
        if black is None or white is None:
            return None
        deviation = noise.deviation(white)
        step: Plane = np.maximum(white - black, deviation)
        squared = np.square(step)
        return cls(
            black,
            step,
            squared / (squared + np.square(np.float32(_FAINT) * deviation)),
            np.square(deviation) * np.float32(1.0 / references.frames(Lighting.WHITE)),
            np.square(noise.deviation(black)) * np.float32(1.0 / references.frames(Lighting.BLACK)),
        )

    def levels(self, light: Plane) -> Plane:
        """0 for black, 1 for white; what is faint tends to a half, to be neither peak nor valley
        for its noise."""
        half = np.float32(0.5)
        level = np.clip((light - self.black) / self.step, -_BEYOND, 1 + _BEYOND)
        return np.asarray(half + (level - half) * self.sure, dtype=np.float32)

    def light(self, levels: Plane) -> Plane:
        """Light of these levels."""
        return np.asarray(self.black + levels * self.step, dtype=np.float32)

    def variance(self, level: float, frames: int) -> Plane:
        """What the references add to the variance of a peak or valley of about this level, each of
        one of `frames` frames that are averaged."""
        of = self.of_white * np.float32(level**2) + self.of_black * np.float32((1 - level) ** 2)
        return np.asarray(of * np.float32(frames), dtype=np.float32)
