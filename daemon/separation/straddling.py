"""Pixels at an edge of the pattern, which see two parts of it at once: found, and split anew.

A pixel between a lit and an unlit checker, or between patches of two phases, is partly lit in every
image. Too little of it comes and goes, so that a part of its direct light counts as global, and at
half and half all of it. No further image says by how much, but the neighbours do, whose contrast is
whole. All of the light is known at the edge as elsewhere; it is the neighbours' part of it that is
taken for direct.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.handedness import Wave

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

_NEAR = 5  # pixels across: parts of a pattern so near to each other leave an edge between
_WHOLE = 0.93  # of the contrast nearby: less is an edge's
_TOLD = 3.0  # deviations of noise
_LIFTED = 1.0  # deviations, at least, by which noise lifts the largest of so many contrasts
_ALIKE = 0.95  # length of the mean of phases that are alike
_NOISE = 1.3  # times what noise makes of a neighbourhood's variance, which is told to a fifth
_REACHES = (5, 9, 17)  # pixels across, within which whole neighbours are looked for
_SHARED = 1.5  # times the noise of neighbours that samples share which a colour is made from
_SOME = 0.1  # of the weight there must be theirs


def between_halves(wave: Plane, noise: Plane) -> Mask:
    """Pixels (H, W) with both lit and unlit ones nearby: `wave` is above and below 0 there."""
    limit = np.float32(_TOLD) * noise
    return _near(wave > limit) & _near(wave < -limit)


def between_phases(wave: Wave) -> Mask:
    """Pixels (H, W) with different phases of a complex wave nearby."""
    phase = wave / np.maximum(np.abs(wave), np.float32(1e-6))
    parts = (
        cv2.blur(np.ascontiguousarray(part), (_NEAR, _NEAR)) for part in (phase.real, phase.imag)
    )
    return np.asarray(np.hypot(*parts) < np.float32(_ALIKE))


def edges(contrast: Plane, noise: Plane, between: Mask, *, mosaic: bool) -> Mask:
    """Of pixels `between`, those whose contrast, a part of the light of deviation `noise` (both
    (H, W)), is less than it is nearby, in a mosaic in the same colour, by more than noise."""
    kernel = np.ones((_NEAR, _NEAR), np.uint8)
    if mosaic:
        kernel[1::2, :] = kernel[:, 1::2] = 0
    most = np.asarray(cv2.dilate(contrast, kernel))
    short = most * np.float32(_WHOLE) - contrast
    return np.asarray(between & (short > np.float32(_TOLD + _LIFTED) * noise))


@dataclass(frozen=True, slots=True)
class Split:
    """`direct` of a frame's shape with the neighbours' part of the light at edges, and how much of
    their noise is in it (`brought`, elsewhere 0); `deviation`: how much neighbours differ in that,
    beyond noise; `known`: the edges (H, W) that have neighbours."""

    direct: Plane
    brought: Plane
    deviation: Plane
    known: Mask

    def noise(
        self, direct_std: Plane, global_std: Plane, total: Plane, total_std: Plane
    ) -> tuple[Plane, Plane]:
        """Deviations of both components by noise: at edges those of parts of the total, and what
        the neighbours brought, elsewhere as given."""
        part: Plane = np.clip(self.direct / np.maximum(total, np.float32(1e-3)), 0.0, 1.0)
        known = _as(self.known, part)
        of_direct: Plane = np.where(known, part * total_std, direct_std)
        of_global: Plane = np.where(known, (np.float32(1.0) - part) * total_std, global_std)
        return np.hypot(of_direct, self.brought), np.hypot(of_global, self.brought)


def as_neighbours(direct: Plane, total: Plane, noise: Plane, edge: Mask, *, mosaic: bool) -> Split:
    """Give edges (H, W) the part of `total` that is direct in the nearest pixels which are none.

    `noise` is the standard deviation of `direct` at a given `total`, that is of its part. The
    deviation is that of the pixels beside edges too, for a contrast that is a little short is not
    told from a whole one.
    """
    light: Plane = np.maximum(total, np.float32(0.0))
    weight: Plane = light * _as(~edge, light).astype(np.float32)
    by = np.float32(1.0) / np.maximum(light, np.float32(1e-3))
    part: Plane = np.clip(direct * by, 0.0, 1.0)
    of_noise = np.float32(_NOISE) * np.square(np.minimum(noise * by, np.float32(1.0)))
    square: Plane = np.square(part) - of_noise
    found, brought, deviation = direct.copy(), np.zeros_like(direct), np.zeros_like(direct)
    own = np.square(noise * _as(~edge, light))
    left = _near(edge)
    for reach in _REACHES:
        kernel, wider = (_bell(size, mosaic=mosaic) for size in (reach, 2 * reach - 1))
        here = left & (cv2.filter2D((~edge).astype(np.float32), -1, kernel) > np.float32(_SOME))
        mean = _mean(part, weight, kernel)
        spread = _mean(square, weight, wider) - np.square(_mean(part, weight, wider))
        at = _as(here, light) & np.ones(light.shape, np.bool_)
        deviation[at] = (np.sqrt(np.maximum(spread, np.float32(0.0))) * light)[at]
        at &= _as(edge, light)
        found[at] = (mean * light)[at]
        sums = np.maximum(cv2.filter2D(weight, -1, kernel), np.float32(1e-3))
        error = np.sqrt(np.maximum(cv2.filter2D(own, -1, np.square(kernel)), 0)) / sums
        brought[at] = (error * light * np.float32(_SHARED if mosaic else 1.0))[at]
        left &= ~here
    return Split(found, brought, deviation, edge & ~left)


def _mean(plane: Plane, weight: Plane, kernel: Plane) -> Plane:
    sums = np.maximum(cv2.filter2D(weight, -1, kernel), np.float32(1e-3))
    return np.asarray(cv2.filter2D(weight * plane, -1, kernel) / sums, dtype=np.float32)


def _as(mask: Mask, plane: Plane) -> Mask:
    return mask if plane.ndim == 2 else mask[..., None]


def _bell(size: int, *, mosaic: bool) -> Plane:
    """A Gaussian's kernel, of a mosaic at the samples of the same colour alone."""
    line = cv2.getGaussianKernel(size, size / 4.0)
    kernel = np.asarray(line @ line.T, dtype=np.float32)
    if mosaic:
        odd = (size // 2 + 1) % 2
        kernel[odd::2, :] = kernel[:, odd::2] = 0.0
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def _near(mask: Mask) -> Mask:
    kernel = np.ones((_NEAR, _NEAR), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel)) > 0
