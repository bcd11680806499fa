"""Separation and correspondence from Gray code and its inverses (§4.3).

A bit's pattern P and inverse I light half of the source each, so that P + I = (1 + b)(L_d + L_g)
at every pixel and |P - I| = (1 - b) L_d where the pixel sees one stripe alone. A pixel at the edge
of a stripe, or one that the finest stripes' blur reaches, has less: of the stripes that are fine
enough, those that keep their contrast separate the pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.coordinates import mirrored_coordinates
from daemon.separation.deviation import stated
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.finish import SIGNIFICANT, Judgement, bits, finish
from daemon.separation.frameset import PairSums
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.scan_noise import ScanNoise
from daemon.separation.steadiness import compare
from daemon.separation.stripes import Resolved, resolved

FINE = 4
"""Bits whose stripes count as high frequency: 2, 4, 8 and 16 px wide."""
_SEEN = 2
"""The bit by whose stripes, 8 px wide, a mirror's finer ones are told."""

_DIRECT = 0.25
"""Of the light: with less that is direct, a pixel's coordinate says nothing of mirrors."""


@dataclass(frozen=True, slots=True)
class Coded:
    """What an image of the set shows."""

    axis: str
    bit: int
    inverted: bool


class GrayCodeDecoder:
    """Pairs of a pattern and its inverse -> direct, global, and the projector's coordinates.

    Planes: `column` and/or `row` (H, W) float32 in projector pixels, the middle of the finest
    stripe that was told from its neighbours, NaN where the code cannot be read; `stripe` (H, W)
    uint16, the width in projector pixels of the stripes that separated a pixel; `direct_std`,
    `global_std`.
    Memory: a few planes a bit of the code, whatever the number of frames.
    """

    def __init__(
        self, response: Response, *, images: Sequence[Coded], leakage: float, average: int = 1
    ) -> None:
        self._response = response
        self._images = tuple(images)
        self._leakage = leakage
        self._references = References(response)
        self._noise = ScanNoise(response, average)
        self._average = average
        self._mean = FrameMean(response)
        self._open: int | None = None
        self._waiting: dict[tuple[str, int], Plane] = {}  # P or I without its other, signed later
        self._codes = {axis: _Code() for axis in dict.fromkeys(one.axis for one in images)}
        self._difference: dict[tuple[str, int], Plane] = {}  # P - I of fine stripes
        self._whole: Plane | None = None  # sum of P + I over all pairs
        self._brightest: Plane | None = None
        self._pairs = 0
        self._sums = PairSums()
        self._saturated: NDArray[np.bool_] | None = None
        self._unused = 0

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`. Raises ValueError for an observation that cannot be respected."""
        if observation.strength != 1.0 or observation.warp is not None:
            raise ValueError("a Gray code is decoded from frames as they are: no warp, strength 1")
        if observation.lighting is not Lighting.PATTERN:
            if observation.used:
                self._references.add(pixels, observation.lighting)
                self._noise.add_reference(pixels, observation.lighting)
            else:
                self._unused += 1
            return
        if self._open is not None and self._open != observation.pattern:
            self._close()
        self._open = observation.pattern
        if observation.used:
            self._mean.add(pixels)
            if self._images[observation.pattern].bit < FINE:
                # half of a coarse pattern's picture is dark: bright light's noise is not in it
                self._noise.add(pixels, observation.pattern)
            if self._saturated is None:
                self._saturated = np.zeros(pixels.shape, dtype=np.bool_)
            self._saturated |= pixels >= self._response.saturated_from
        else:
            self._unused += 1
        if observation.last:
            self._close()

    def _close(self) -> None:
        pattern, self._open = self._open, None
        if self._mean.frames and pattern is not None:
            self._pair(self._images[pattern], self._mean.value())
        self._mean.clear()

    def _pair(self, image: Coded, light: Plane) -> None:
        key = image.axis, image.bit
        other = self._waiting.pop(key, None)
        if other is None:
            self._waiting[key] = light
            return
        shown, inverse = (other, light) if image.inverted else (light, other)
        difference = shown - inverse
        whole = shown + inverse
        self._codes[image.axis].add(image.bit, _grey(difference))
        if image.bit < FINE:
            self._difference[key] = difference
        self._sums.add(whole)
        brighter = np.maximum(shown, inverse)
        if self._whole is None or self._brightest is None:
            self._whole, self._brightest = whole, brighter
        else:
            self._whole += whole
            np.maximum(self._brightest, brighter, out=self._brightest)
        self._pairs += 1

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet before a fine pattern and its inverse are in."""
        if self._whole is None or self._brightest is None or self._saturated is None:
            raise NotYet("a Gray code needs a pattern and its inverse; no pair has come yet")
        if not self._difference:
            raise NotYet("the fine stripes of the Gray code have not come yet")
        b = self._leakage
        told = self._noise.told()
        deviation = told.deviation(self._brightest)
        pair: Plane = self._whole * np.float32(1.0 / self._pairs)
        fine = self._resolved(pair, deviation)
        contrast, stripe = fine.contrast, fine.width
        direct = contrast * np.float32(1.0 / (1.0 - b))
        half: Plane = pair * np.float32(0.5)
        total = self._references.total(half, b)
        moved, steady, advice = compare(self._references, half, deviation, b)
        indirect: Plane = total.light - direct
        step = contrast * np.float32(0.5)
        pair_var = np.square(told.deviation(half + step))
        pair_var += np.square(told.deviation(half - step))
        scatter, spread = (
            plane if pair_var.ndim == 2 else plane[..., None]
            for plane in (fine.scatter, fine.spread)
        )
        by = np.float32(1.0 / (1.0 - b))
        direct_std: Plane = np.sqrt(pair_var) * scatter * by
        global_var = total.of_references(told.deviation) * np.float32(self._average)
        global_var += pair_var * np.asarray(total.of_half * (0.25 / self._pairs), np.float32)
        global_std: Plane = np.sqrt(np.square(direct_std) + global_var)
        off: Plane = np.broadcast_to(spread * by, direct.shape)
        planes = {**stated(direct_std, global_std, off), "stripe": stripe}
        coordinates = self.coordinates(np.float32(SIGNIFICANT) * _grey(deviation))
        planes.update(coordinates)
        mirrors = mirrored_coordinates(
            coordinates,
            self._strength(contrast, pair, deviation),
            self._stripes(),
        )
        sums, unequal = self._sums.told(float(np.median(deviation)))
        flags = bits(mirrors.mirrored, Quality.RESIDUE)
        flags |= bits(fine.disagree, Quality.DISAGREE)
        if not mirrors.trusted:
            flags |= np.uint16(Quality.DISAGREE)
        if moved is not None:
            flags |= moved
        return finish(
            direct,
            indirect,
            response=self._response,
            brightest=self._brightest,
            saturated=self._saturated,
            judgement=Judgement(
                direct=np.float32(SIGNIFICANT) * direct_std,
                total=np.float32(SIGNIFICANT) * global_std,
                deviation=deviation,
            ),
            flags=flags,
            planes=planes,
            facts={
                "estimator": "finest stripes",
                "patterns": 2 * self._pairs,
                "unused_frames": self._unused,
                "lit_fraction": 0.5,
                "leakage": b,
                **told.facts(),
                "stripes": {
                    str(width): round(float(np.mean(stripe == width)), 4)
                    for width in np.unique(stripe).tolist()
                },
                **self._references.facts(total.source),
                **steady,
                **mirrors.facts,
                **sums,
                "advice": unequal + mirrors.advice + advice + told.advice(),
            },
        )

    def coordinates(self, limit: Plane) -> dict[str, Plane]:
        """`column` and `row` (H, W) in projector pixels, as far as they are coded; NaN where a
        coarse stripe differs from its inverse by less than `limit` (H, W, linear counts)."""
        return {
            "column" if axis == "x" else "row": code.decode(limit)
            for axis, code in self._codes.items()
        }

    def _strength(self, contrast: Plane, pair: Plane, deviation: Plane) -> Plane:
        """Contrast of the stripes by its noise; 0 where little light is direct, for there the
        coarse bits were told by global light."""
        strong = _grey(contrast) / np.maximum(_grey(deviation), np.float32(1e-6))
        return np.where(_grey(contrast) > np.float32(_DIRECT) * _grey(pair), strong, np.float32(0))

    def _stripes(self) -> Plane | None:
        """P - I of the stripes of each axis that are fine and yet resolved, multiplied."""
        found = [_grey(d) for key, d in self._difference.items() if key[1] == _SEEN]
        if len(found) < len(self._codes):
            return None
        return found[0] if len(found) == 1 else np.sign(found[0]) * found[1]

    def _resolved(self, pair: Plane, deviation: Plane) -> Resolved:
        keys = sorted(self._difference, key=lambda key: key[1])
        contrasts = [np.abs(self._difference[key]) for key in keys]
        return resolved(contrasts, [2 ** (bit + 1) for _, bit in keys], pair, deviation)

    def summary(self) -> dict[str, float]:
        """Pairs that are in, and frames not used."""
        return {"pairs": float(self._pairs), "unused": float(self._unused)}


class _Code:
    """The bits of one axis as they come, and how well each was told."""

    def __init__(self) -> None:
        self._bits: dict[int, tuple[NDArray[np.bool_], Plane]] = {}

    def add(self, bit: int, difference: Plane) -> None:
        self._bits[bit] = difference > 0, np.abs(difference)

    def decode(self, limit: Plane) -> Plane:
        """Coordinates (H, W), NaN where a coarser bit than the finest usable one is not told.

        Gray code's neighbours differ in one bit: one that is not told puts the pixel at that bit's
        edge, and the finer bits, which are symmetric about it, say how far from the edge it is. So
        an untold bit may be read either way but for the finest told one after it.
        """
        order = sorted(self._bits, reverse=True)
        value = np.zeros(limit.shape, dtype=np.int32)
        gray = np.zeros(limit.shape, dtype=np.bool_)
        finest = np.full(limit.shape, -1, dtype=np.int32)
        untold = np.zeros(limit.shape, dtype=np.int32)
        for bit in order:
            lit, strength = self._bits[bit]
            gray ^= lit  # binary bit = XOR of this Gray bit and all above it
            value |= gray.astype(np.int32) << bit
            told = strength > limit
            finest[told] = bit
            untold += ~told
        width = np.where(finest >= 0, np.left_shift(1, np.maximum(finest, 0)), 1)
        middle = (value // width * width + (width - 1) / 2).astype(np.float32)
        trailing = finest  # bits below the finest told one are untold by definition
        readable = (finest >= 0) & (untold - trailing <= 1)
        return np.where(readable, middle, np.float32(np.nan))


def _grey(plane: Plane) -> Plane:
    return plane if plane.ndim == 2 else np.asarray(plane.mean(axis=2), dtype=np.float32)
