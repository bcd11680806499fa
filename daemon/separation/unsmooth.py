"""What light that is not smooth leaves unsure of components, whatever has shown it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Quality
from daemon.separation.finish import bits
from daemon.separation.radiometry import Plane

_DEVIATIONS = np.float32(3.0)  # of noise, and ...
_PART = np.float32(0.1)  # of the light: an error of more than both is flagged
_MANY = 0.08  # of the pixels: it is said


@dataclass(frozen=True, slots=True)
class Unsmooth:
    """`off`: how far components may be off for it, as a deviation, of a frame's shape; `flags`
    (H, W), uint16: where that is much; `advice`: a line where it is in many pixels."""

    off: Plane
    flags: NDArray[np.uint16]
    advice: list[str]

    @classmethod
    def unknown(cls, plane: Plane) -> Unsmooth:
        """Of a plane's shape, where nothing tells."""
        return cls(np.zeros_like(plane), np.zeros(plane.shape[:2], dtype=np.uint16), [])

    @classmethod
    def judged(cls, off: Plane, noise: Plane, light: Plane, words: str) -> Unsmooth:
        """Against a component's deviation by `noise` and all of the `light`; `words`, with a place
        for the part of the pixels, is the line of advice."""
        much = off > np.maximum(_DEVIATIONS * noise, _PART * light)
        pixels = much if much.ndim == 2 else by_light(much, light)
        part = float(np.mean(pixels))
        return cls(off, bits(pixels, Quality.DISAGREE), [words.format(part)] * (part > _MANY))


def by_light(much: NDArray[np.bool_], light: Plane) -> NDArray[np.bool_]:
    """Where colours (H, W, 3) that hold a third of the light are concerned: (H, W). A fainter one
    may be what a camera's correction of colours leaves of the others."""
    return np.asarray((much * light).sum(axis=2) * 3 >= light.sum(axis=2))
