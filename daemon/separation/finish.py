"""From separated samples to what is kept: quality bits, figures, colours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import mosaic, noise
from daemon.separation.estimator import Components, Quality
from daemon.separation.radiometry import Plane, Response

SIGNIFICANT = 3.0
"""How many standard deviations tell a value from noise."""

_BINS = 64


def finish(
    direct: Plane,
    indirect: Plane,
    *,
    response: Response,
    saturated: NDArray[np.bool_],
    picture: Plane,
    brightest: Plane,
    facts: dict[str, Any],
    flags: NDArray[np.uint16] | None = None,
    planes: dict[str, NDArray[Any]] | None = None,
) -> Components:
    """Judge the samples' components, then make colours of a mosaic.

    `direct`, `indirect`, `saturated` have the shape of a frame; `picture` is one in which noise can
    be measured, `brightest` each sample's brightest light (both linear, ambient included); `flags`
    (H, W) are the method's own bits.
    """
    camera = measure_noise(picture, response)
    deviation = camera.deviation(brightest)
    quality = judge(direct, indirect, saturated, deviation)
    if flags is not None:
        quality |= flags
    if response.bayer:
        # A colour is interpolated from its neighbours: what is wrong with them is wrong with it.
        quality = spread(quality, Quality.SATURATED)
        direct, indirect = (mosaic.demosaic(x, response.bayer) for x in (direct, indirect))
    figures = {
        **facts,
        "noise_counts": round(camera.read, 4),
        "black_level": response.black,
        "tone": response.tone,
        "full_scale": response.full_scale,
        "saturated_from": response.saturated_from,
        "quality": count(quality),
        "exposure_histogram": histogram(brightest, response.linear_full_scale),
    }
    return Components(direct, indirect, quality, dict(planes or {}), figures)


def measure_noise(picture: Plane, response: Response) -> noise.Noise:
    """The camera's noise in linear counts, from the quietest channel of a picture."""
    quantum = float(np.median(response.slope(picture[::8, ::8])))
    if picture.ndim == 2:
        return noise.from_picture(picture, quantum, step=2 if response.bayer else 1)
    channels = [
        noise.from_picture(np.ascontiguousarray(picture[..., c]), quantum) for c in range(3)
    ]
    return max(channels, key=lambda one: one.read)


def judge(
    direct: Plane, indirect: Plane, saturated: NDArray[np.bool_], deviation: Plane
) -> NDArray[np.uint16]:
    """Quality bits of each pixel (H, W) uint16 that follow from values and noise alone.

    A pixel is dark or of low modulation when each of its channels is; saturated or negative when
    one of them is.
    """
    limit = np.float32(SIGNIFICANT) * deviation
    with np.errstate(invalid="ignore"):
        dark = _every(direct + indirect < limit)
        flat = _every(direct < limit)
        negative = _some((direct < -limit) | (indirect < -limit))
    quality = noise.bits(_some(saturated), Quality.SATURATED)
    quality |= noise.bits(dark, Quality.DARK)
    quality |= noise.bits(flat, Quality.LOW_MODULATION)
    quality |= noise.bits(negative, Quality.NEGATIVE)
    return quality


def spread(quality: NDArray[np.uint16], flag: Quality) -> NDArray[np.uint16]:
    """The same bits, with `flag` also at the eight neighbours of each pixel that has it."""
    padded = np.pad((quality & flag) != 0, 1)
    near = np.zeros(quality.shape, dtype=np.bool_)
    height, width = quality.shape
    for y in range(3):
        for x in range(3):
            near |= padded[y : y + height, x : x + width]
    return quality | noise.bits(near, flag)


def count(quality: NDArray[np.uint16]) -> dict[str, dict[str, float]]:
    """Pixels with each quality bit: their number and their fraction."""
    found: dict[str, dict[str, float]] = {}
    for flag in Quality:
        pixels = int(np.count_nonzero(quality & np.uint16(flag)))
        name = (flag.name or "").lower()
        found[name] = {"pixels": pixels, "fraction": round(pixels / quality.size, 6)}
    return found


def histogram(light: Plane, full_scale: float) -> dict[str, Any]:
    """Counts of samples in equal bins from 0 to full scale (both ends include what is beyond)."""
    scaled = np.clip(light * np.float32(_BINS / full_scale), 0, _BINS - 1)
    counts = np.bincount(scaled[np.isfinite(scaled)].astype(np.intp), minlength=_BINS)
    return {"bins": _BINS, "to": round(full_scale, 3), "counts": counts.tolist()}


def _every(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask if mask.ndim == 2 else np.logical_and.reduce(mask, axis=2)


def _some(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask if mask.ndim == 2 else np.logical_or.reduce(mask, axis=2)
