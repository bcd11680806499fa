"""From separated samples to what is kept: quality bits, figures, colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation import deviation
from daemon.separation.estimator import Components, Quality
from daemon.separation.mosaic import Mosaic
from daemon.separation.noise import noise_range
from daemon.separation.radiometry import Plane, Response
from daemon.separation.sampling import thinned

SIGNIFICANT = 3.0
"""How many standard deviations tell a component from noise."""

ADVICE: dict[Quality, tuple[float, str]] = {
    Quality.LOW_MODULATION: (
        0.9,
        "of the pixels show no pattern that is told from noise, so that no direct light is: see "
        "that the source lights what the camera sees, in focus, and each frame is its pattern's",
    ),
    Quality.SATURATED: (
        0.005,
        "of the pixels are saturated, and their components too small: expose more briefly "
        "(of a scan: --exposure), or lower the gain",
    ),
    Quality.NEGATIVE: (
        0.02,
        "of the pixels have a component below zero by more than noise: the leakage (--leakage), "
        "the black level (--black), a tone curve (--tone, `umbra calibrate tone`) or the lit "
        "fraction is not the one given; black and white frames would tell which",
    ),
    Quality.RESIDUE: (
        0.002,
        "of the pixels see the pattern by way of a mirror or of glass, and what they reflect "
        "counts as direct: don't trust them, or cover or powder the mirror",
    ),
    Quality.MOVED: (
        0.005,
        "of the pixels changed between the black and white frames and the patterns: keep scene "
        "and camera still, and scan again",
    ),
}
"""What to do where more than a part of the pixels has a bit: the part, and words."""

UNUSABLE = 0.5
"""Of the pixels that are lit at all, the part without components beyond which it is said."""

_LIT = 0.05
"""Of the light of the brightest hundredth: a pixel with less is not lit at all."""

_HIDDEN = 0.2
"""Of a pixel's light: where noise may pass for so much direct light, noise is what hides it."""

_BINS = 64


@dataclass(frozen=True, slots=True)
class Judgement:
    """What noise alone can make of a sample's components, as limits (float32, a frame's shape):
    direct below `direct` and total below `total` are not told from none; `deviation` is that of one
    frame's light."""

    direct: Plane
    total: Plane
    deviation: Plane

    @classmethod
    def of_extremes(cls, deviation: Plane, samples: int) -> Judgement:
        """For the largest and smallest of so many samples."""
        limit = np.float32(noise_range(samples)) * deviation
        return cls(limit, limit, deviation)


def finish(
    direct: Plane,
    indirect: Plane,
    *,
    response: Response,
    brightest: Plane,
    saturated: NDArray[np.bool_],
    judgement: Judgement,
    facts: dict[str, Any],
    flags: NDArray[np.uint16] | None = None,
    planes: dict[str, NDArray[Any]] | None = None,
) -> Components:
    """Judge the samples' components, then make colours of a mosaic.

    `direct`, `indirect`, `brightest` (linear light, ambient included) and `saturated` have the
    shape of a frame; `flags` (H, W) are the method's own bits, of which NEVER_LIT and NEVER_UNLIT
    make both components NaN. Of `planes`, deviations have a frame's shape and get colours too.
    """
    planes = dict(planes or {})
    quality = judge(direct, indirect, saturated, judgement)
    if flags is not None:
        quality |= flags
    unknown = quality & np.uint16(Quality.NEVER_LIT | Quality.NEVER_UNLIT) != 0
    direct[unknown] = np.nan
    indirect[unknown] = np.nan
    quality[unknown] &= np.uint16(~(Quality.LOW_MODULATION | Quality.NEGATIVE) & 0xFFFF)
    if response.bayer:
        # A colour is interpolated from its neighbours: what is wrong with them is wrong with it.
        quality = spread(quality, Quality.SATURATED)
        direct, indirect = _coloured(direct, indirect, planes, response.bayer)
        lost = np.isnan(direct + indirect)
        if lost.any():
            # Where none of them has a colour, the pixel is what they are.
            missed = ~unknown & lost.any(axis=2)
            around = spread(spread(quality, Quality.NEVER_LIT), Quality.NEVER_UNLIT)
            quality = np.where(missed, around, quality)
            unknown |= missed
            direct[unknown] = np.nan
            indirect[unknown] = np.nan
    counted = count(quality)
    figures = {
        **facts,
        "advice": [
            *facts.get("advice", ()),
            *_advice(counted),
            *_unusable(quality, counted, brightest, judgement, flags),
        ],
        "noise_counts": round(float(np.nanmedian(thinned(judgement.deviation))), 4),
        "black_level": response.black,
        "tone": response.tone,
        "full_scale": response.full_scale,
        "saturated_from": response.saturated_from,
        "quality": counted,
        "exposure_histogram": histogram(brightest, response.linear_full_scale),
    }
    return Components(direct, indirect, quality, planes, figures)


def _coloured(
    direct: Plane, indirect: Plane, planes: dict[str, NDArray[Any]], bayer: str
) -> tuple[Plane, Plane]:
    """The components' colours; those of their deviations, in place: with what a colour that is
    interpolated may be off by."""
    mosaic = Mosaic(np.isfinite(direct + indirect), bayer)
    coloured = []
    for component, name in zip((direct, indirect), deviation.NOISE, strict=True):
        colours = mosaic.colours(component)
        coloured.append(colours)
        if name in planes:
            noise, stated = deviation.of_noise(planes, name), planes[name]
            off = np.square(mosaic.error(component, noise, colours))
            off += np.square(mosaic.noise(stated))
            planes[name] = np.sqrt(off)
            planes[deviation.NOISE[name]] = mosaic.noise(noise)
    return coloured[0], coloured[1]


def judge(
    direct: Plane, indirect: Plane, saturated: NDArray[np.bool_], judgement: Judgement
) -> NDArray[np.uint16]:
    """Quality bits of each pixel (H, W) uint16 that follow from values and noise alone.

    A pixel is dark or of low modulation when each of its channels is; saturated or negative when
    one of them is.
    """
    with np.errstate(invalid="ignore"):
        dark = _every(direct + indirect < judgement.total)
        flat = _every(direct < judgement.direct)
        negative = _some((direct < -judgement.direct) | (indirect < -2 * judgement.total))
    quality = bits(_some(saturated), Quality.SATURATED)
    quality |= bits(dark, Quality.DARK)
    quality |= bits(flat, Quality.LOW_MODULATION)
    quality |= bits(negative, Quality.NEGATIVE)
    return quality


def spread(quality: NDArray[np.uint16], flag: Quality) -> NDArray[np.uint16]:
    """The same bits, with `flag` also at the eight neighbours of each pixel that has it."""
    there = (quality & np.uint16(flag)) != 0
    near = cv2.dilate(there.view(np.uint8), np.ones((3, 3), dtype=np.uint8))
    return quality | bits(near != 0, flag)


def bits(mask: NDArray[np.bool_], flag: Quality) -> NDArray[np.uint16]:
    """A mask as a plane of one quality bit (uint16)."""
    return mask.astype(np.uint16) * np.uint16(flag)


def count(quality: NDArray[np.uint16]) -> dict[str, dict[str, float]]:
    """Pixels with each quality bit: their number and their fraction."""
    found: dict[str, dict[str, float]] = {}
    for flag in Quality:
        pixels = int(np.count_nonzero(quality & np.uint16(flag)))
        name = (flag.name or "").lower()
        found[name] = {"pixels": pixels, "fraction": round(pixels / quality.size, 6)}
    return found


def _advice(counted: dict[str, dict[str, float]]) -> list[str]:
    lines = []
    for flag, (least, words) in ADVICE.items():
        part = counted[(flag.name or "").lower()]["fraction"]
        if part > least:
            lines.append(f"{part:.1%} {words}")
    return lines


def _unusable(
    quality: NDArray[np.uint16],
    counted: dict[str, dict[str, float]],
    brightest: Plane,
    judgement: Judgement,
    flags: NDArray[np.uint16] | None,
) -> list[str]:
    """A line where most of the pixels that are lit at all came to nothing, and no other says so:
    what most of them lack."""
    if counted["low_modulation"]["fraction"] > ADVICE[Quality.LOW_MODULATION][0]:
        return []
    nothing = Quality.DARK | Quality.LOW_MODULATION | Quality.NEVER_LIT | Quality.NEVER_UNLIT
    # By light and not by DARK: where noise is taken for more than it is, all is dark.
    lit = _some(brightest > np.float32(_LIT) * np.quantile(thinned(brightest), 0.99))
    lost = lit & (quality & np.uint16(nothing) != 0)
    count = int(np.count_nonzero(lost))
    part = count / max(int(np.count_nonzero(lit)), 1)
    if part <= UNUSABLE:
        return []
    said = f"{part:.1%} of the pixels that are lit at all cannot be separated"
    noisy = lost & _every(judgement.direct > np.float32(_HIDDEN) * brightest)
    if np.count_nonzero(noisy) > count / 2:
        return [
            f"{said}: noise hides what direct light they may have; expose longer, or average more "
            "frames (--average)"
        ]
    if flags is not None:
        at_edges = lost & (flags & np.uint16(Quality.LOW_MODULATION) != 0)
        if np.count_nonzero(at_edges) > count / 2:
            return [
                f"{said}: they lie at edges of the pattern, where no image shows them wholly lit "
                "(or the images are not of one pattern); shifts of a checkerboard light every pixel"
            ]
    return [
        f"{said} (low modulation, dark, never lit or never unlit): see that the frames are this "
        "method's, in order, and that patterns or shadow reach all that the camera sees"
    ]


def histogram(light: Plane, full_scale: float) -> dict[str, Any]:
    """Counts of samples in equal bins from 0 to full scale (both ends include what is beyond)."""
    scaled = np.clip(light * np.float32(_BINS / full_scale), 0, _BINS - 1)
    counts = np.bincount(scaled[np.isfinite(scaled)].astype(np.intp), minlength=_BINS)
    return {"bins": _BINS, "to": round(full_scale, 3), "counts": counts.tolist()}


def _every(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask if mask.ndim == 2 else np.logical_and.reduce(mask, axis=2)


def _some(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask if mask.ndim == 2 else np.logical_or.reduce(mask, axis=2)
