"""What a pattern and its complement tell of the pattern in the picture: edges, and mirrors.

A pixel at the edge of a checker is partly lit in both images. Eq. 8 does not know by how much, so
that a part of its direct light counts as global, and at half and half all of it: no third image
says otherwise, but the neighbours do, whose contrast is whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.handedness import strength
from daemon.separation.residue import mirrored

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

_NEAR = 5  # pixels across: lit and unlit checkers so near to each other leave an edge between
_WHOLE = 0.85  # of the contrast nearby: less is an edge's
_TOLD = 3.0  # deviations of noise


@dataclass(frozen=True, slots=True)
class Straddling:
    """`straddling` (H, W) pixels see lit and unlit checkers at once; `mirrored` as in `residue`."""

    straddling: Mask
    mirrored: Mask | None
    facts: dict[str, Any]

    @classmethod
    def of_pair(
        cls, first: Plane, second: Plane, alpha: float, leakage: float, deviation: Plane, bayer: str
    ) -> Straddling:
        """Of a pattern of lit fraction α and its complement, ambient light removed, of one sample's
        `deviation`; all of a frame's shape. Colours of a mosaic are compared with their own."""
        g = light_model.global_weight(alpha, leakage)
        h = light_model.global_weight(1.0 - alpha, leakage)
        wave: Plane = np.float32(h) * first - np.float32(g) * second
        whole: Plane = first + second
        noise: Plane = deviation * np.float32(np.hypot(g, h))
        if wave.ndim == 3:
            wave, whole = wave.sum(axis=2), whole.sum(axis=2)
            noise = np.asarray(np.sqrt(np.square(noise).sum(axis=2)), dtype=np.float32)
        waves = np.asarray(wave, dtype=np.complex64)
        mask, facts = mirrored([waves], strength([waves], noise), turning=False, smooth=False)
        edges = _edges(wave, np.maximum(whole, np.float32(1e-3)), noise, mosaic=bool(bayer))
        share = round(float(np.mean(edges)), 4)
        return cls(edges, mask, {**facts, "straddling": share})


def _edges(wave: Plane, whole: Plane, noise: Plane, *, mosaic: bool) -> Mask:
    kernel = np.ones((_NEAR, _NEAR), np.uint8)
    limit = np.float32(_TOLD) * noise
    between = _near(wave > limit, kernel) & _near(wave < -limit, kernel)
    if mosaic:
        kernel[1::2, :] = kernel[:, 1::2] = 0
    contrast = np.abs(wave) / whole
    most = np.asarray(cv2.dilate(contrast, kernel))
    edge = contrast + limit / whole < most * np.float32(_WHOLE)
    return np.asarray(between & edge)


def _near(mask: Mask, kernel: NDArray[np.uint8]) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel)) > 0
