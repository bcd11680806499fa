"""Contrast of stripes of several widths -> one, from those fine enough and yet whole at a pixel.

Blur takes from finer stripes and from a stripe's own edges; light that is global but comes from
near by (a crease, a translucent body) adds to the contrast of wider ones. Those that are as good as
the best are averaged. How much they differ beyond noise is stated, and how much more the widest
show than the finer ones do around the pixel, beyond what the scene's blur makes usual: that much
may be global.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

_KEPT = 0.95
"""A stripe resolves a pixel that has at least this part of the best contrast ..."""
_NOISE = np.float32(2.0)  # ... less so many deviations of a frame
_REACHES = np.linspace(0.0, 6.0, 25)
_AROUND = 9  # pixels
_LIT = np.float32(0.1)  # of the picture's strong contrast: with less a pixel says nothing of blur
_DIFFERENT = 5.0
"""Widths disagree when they differ by so many standard deviations ..."""
_PART = np.float32(0.1)  # ... and by this part of the light


@dataclass(frozen=True, slots=True)
class Resolved:
    """`contrast` of a frame's shape, a mean of stripes of which the finest is `width` (H, W) wide;
    `scatter` (H, W): its noise as a part of one stripe's; `spread` (H, W): how much stripes differ;
    `disagree` (H, W): by far too much."""

    contrast: Plane
    scatter: Plane
    width: NDArray[np.uint16]
    spread: Plane
    disagree: Mask


def resolved(
    contrasts: Sequence[Plane], widths: Sequence[int], whole: Plane, deviation: Plane
) -> Resolved:
    """`contrasts` are abs(P - I), finest first; `whole` P + I and `deviation` that of one of the
    two, all of a frame's shape; `widths` in projector pixels."""
    greys = [_grey(contrast) for contrast in contrasts]
    noise = _grey(deviation) / np.float32(1 if deviation.ndim == 2 else deviation.shape[2] ** 0.5)
    best: Plane = np.maximum.reduce(greys)
    enough = best * np.float32(_KEPT) - _NOISE * _grey(deviation)
    count, mean, square = (np.zeros_like(best) for _ in range(3))
    width = np.zeros(best.shape, dtype=np.uint16)
    total = np.zeros_like(contrasts[0])
    for contrast, grey, size in zip(contrasts, greys, widths, strict=True):
        take = grey >= enough
        width[take & (width == 0)] = size
        total += contrast * (take if contrast.ndim == 2 else take[..., None])
        count += take
        mean += np.where(take, grey, np.float32(0.0))
        square += np.where(take, np.square(grey), np.float32(0.0))
    apart = square / count - np.square(mean / count)
    apart = _around(apart - np.float32(2.0) * np.square(noise) * (1 - 1 / count))
    wider = _wider(greys, widths, best)
    of_wider = np.float32(2.0 / _AROUND) * noise  # that of a mean over the pixels around
    limit = np.maximum(np.float32(_DIFFERENT) * of_wider, _PART * _grey(whole))
    may = enough - _NOISE * _grey(deviation)
    among = np.add.reduce([(grey >= may).astype(np.intp) for grey in greys])
    reach = (best - enough) / np.maximum(np.float32(2**0.5) * noise, np.float32(1e-6))
    return Resolved(
        contrast=total / (count if total.ndim == 2 else count[..., None]),
        scatter=_scatter(among, reach),
        width=width,
        spread=np.hypot(np.sqrt(np.maximum(apart, np.float32(0.0))), wider),
        disagree=np.asarray(wider > limit),
    )


def _scatter(among: NDArray[np.intp], reach: Plane) -> Plane:
    """The noise of a mean of those of so many alike that lie within a reach, in deviations of one,
    of the best of them: noise chooses them, so that it is more than that of all."""
    found = np.ones(reach.shape, dtype=np.float32)
    for n in range(2, int(among.max()) + 1):
        at = among == n
        found[at] = np.interp(reach[at], _REACHES, _chosen(n))
    return found


@functools.lru_cache
def _chosen(count: int) -> NDArray[np.float64]:
    """By simulation, for each reach of `_REACHES`."""
    drawn = np.random.default_rng(0).standard_normal((20_000, count))
    short = drawn.max(axis=1, keepdims=True) - drawn
    means = [np.mean(drawn, axis=1, where=short <= reach) for reach in _REACHES]
    return np.asarray(np.std(means, axis=1))


def _wider(greys: Sequence[Plane], widths: Sequence[int], best: Plane) -> Plane:
    """How much the widest stripes add around a pixel to the best contrast of the others, over what
    they add to a quarter of the scene, which is blur's."""
    finer = [grey for grey, width in zip(greys, widths, strict=True) if width < max(widths)]
    if not finer:
        return np.zeros_like(best)
    level = np.maximum(_around(best), np.float32(1e-3))
    part = _around(best - np.maximum.reduce(finer)) / level
    lit = level > _LIT * np.quantile(level, 0.9)
    more: Plane = np.maximum(part - np.quantile(part[lit], 0.25), np.float32(0.0)) * level
    return more


def _around(plane: Plane) -> Plane:
    return np.asarray(cv2.blur(plane, (_AROUND, _AROUND)), dtype=np.float32)


def _grey(plane: Plane) -> Plane:
    return plane if plane.ndim == 2 else np.asarray(plane.mean(axis=2), dtype=np.float32)
