"""Contrast that fades from the middle of a pattern's patches to their edges otherwise than blur
makes it: light that is scattered, or reflected, over less than a patch.

Such light goes with the pattern and counts as direct, most of it in the middle of a patch. Blur
takes from edges, too, but as much of the contrast all over the picture, so that what most of it
shows is blur's, and more or less than that is not. Texture does not lie as the pattern does. How
contrast goes with the pattern is found by regression around each pixel, on the pattern itself as it
would be if it were scattered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.handedness import Wave
from daemon.separation.sampling import gathered
from daemon.separation.unsmooth import Unsmooth

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

_CHANGE = np.float32(0.5)  # of a turning pointer from a pixel to the next: an edge lies between
_LEAST = 2.5  # pixels to a patch: finer ones have no middle
_REACH = 0.35  # of a patch: the Gaussian that scatters
_ACROSS = 2  # patches, of a box: ...
_BOXES = 3  # ... so many times over nothing is left of where in the pattern it began
_PATCHES = 12.0  # that are looked at so, by their weight
_SOME = 0.2  # of a neighbourhood must be whole
_QUIET = 0.1  # of the light: a pixel of more noise tells little
_EVEN = np.float32(0.005)  # variance of the scattered pattern: where it has less nothing is told
_BRIGHT = 0.8  # of the strongest contrast: where light is direct the usual fading is looked for
_SURE = 1.5  # times the usual spread: less says nothing
_VARIES = 0.25  # of the usual fading: blur is not the same all over a scene
_CORE = 3.14  # deviations of a Gaussian over the quarter of it that lies nearest to the middle
_TINY = np.float32(1e-3)
_SAID = (
    "in {:.1%} of the pixels the pattern fades from the middle of its patches to their edges as no "
    "blur makes it: light is scattered or reflected over less than a patch there, and direct may "
    "be too large by about the stated deviation; finer patterns (--checker, --patch) tell"
)


@dataclass(frozen=True, slots=True)
class Blurred:
    """What is usual in a picture and leaves the middles of patches whole (`harmless`), and the part
    of direct light that they have `lost` by the square of what it is beyond, by simulation."""

    harmless: float
    lost: float


HALVES = Blurred(harmless=1.5, lost=0.01)  # lit and unlit
PHASES = Blurred(harmless=0.5, lost=0.4)


def fading(
    wave: Wave,
    contrast: Plane,
    noise: Plane,
    direct: Plane,
    total: Plane,
    direct_std: Plane,
    *,
    blur: Blurred,
) -> Unsmooth:
    """What fading leaves unsure of `direct` light, a part of the `total`, whose deviation by noise
    is `direct_std`, all of a frame's shape; the rest as in `_faded`.

    Of light that goes with the pattern so anything up to all of it may be direct. Where blur fades
    the pattern all over the picture, pixels that are taken for whole lack some, too.
    """
    part, usual = _faded(wave, contrast, noise)
    part *= np.float32(3**-0.5)
    off: Plane = (part if direct.ndim == 2 else part[..., None]) * direct
    judged = Unsmooth.judged(off, direct_std, total, _SAID)
    short = blur.lost * max(usual - blur.harmless, 0.0) ** 2
    return replace(judged, off=np.hypot(off, direct * np.float32(short)))


def _faded(wave: Wave, contrast: Plane, noise: Plane) -> tuple[Plane, float]:
    """The part of each pixel's contrast (H, W), 0 to 1, that may not be direct light's; and the
    usual fading, by blur: the part of a contrast that it loses where the scattered pattern is 0.

    `wave` (H, W) complex: the pattern as seen, of any amplitude; `contrast`, a part of the light of
    deviation `noise`.
    """
    none = np.zeros_like(contrast)
    seen = np.asarray(noise < np.float32(_QUIET))  # whatever its contrast
    turn = np.where(seen, wave / np.maximum(np.abs(wave), np.float32(1e-6)), 0)
    size = _patch(turn, seen)
    if size is None:
        return none, 0.0
    scattered = _scattered(turn, seen, _REACH * size)
    weight = seen.astype(np.float32)
    border = int(2.0 * _REACH * size) + 1  # what would be scattered into it is not in the picture
    for end in (np.s_[:border], np.s_[-border:]):
        weight[end] = weight[:, end] = 0.0
    window = (int(_ACROSS * size) // 2 * 2 + 1,) * 2
    count = _around(weight, window)

    def mean(plane: Plane) -> Plane:
        return np.asarray(_around(plane * weight, window) / np.maximum(count, _TINY))

    level, middle = mean(contrast), mean(scattered)
    spread = mean(np.square(scattered)) - np.square(middle)
    told = (count > np.float32(_SOME)) & (spread > _EVEN)
    lit = told & seen & (level > np.float32(_BRIGHT) * np.quantile(level, 0.9))
    if not lit.any():
        return none, 0.0
    spread[~told], level[~told] = 1.0, 1.0
    going = mean(contrast * scattered) - level * middle
    slope = going / (spread * level)
    # what lies otherwise than the pattern may do so by chance, in as many ways as there are patches
    other = mean(np.square(contrast)) - np.square(level) - np.square(going) / spread
    of_chance = np.maximum(other, 0) / (np.square(level) * spread * np.float32(_PATCHES))
    usual = gathered(slope[lit])
    more = slope - np.float32(usual)
    usual_spread = _SURE * _CORE * float(np.quantile(np.abs(more[lit]), 0.25))
    least = np.float32(max(usual_spread, _VARIES * usual) ** 2)
    beyond = np.square(np.maximum(more, 0)) - np.maximum(least, of_chance)
    part: Plane = np.where(told, np.sqrt(np.clip(beyond, 0, 1)), np.float32(0))
    return part, max(usual, 0.0)


def _patch(turn: Wave, seen: Mask) -> float | None:
    """How many pixels wide a patch is; None where too little of the pattern is seen, or patches are
    too narrow."""
    changes = pairs = 0
    for one, other, both in (
        (turn[:, 1:], turn[:, :-1], seen[:, 1:] & seen[:, :-1]),
        (turn[1:], turn[:-1], seen[1:] & seen[:-1]),
    ):
        changes += int(np.count_nonzero((np.abs(one - other) > _CHANGE) & both))
        pairs += int(np.count_nonzero(both))
    if not changes or pairs < _LEAST * changes:
        return None
    return min(pairs / changes, float(min(turn.shape)) / (_ACROSS * _BOXES))


def _around(plane: Plane, window: tuple[int, int]) -> Plane:
    found = plane
    for _ in range(_BOXES):
        found = np.asarray(cv2.blur(found, window), dtype=np.float32)
    return found


def _scattered(turn: Wave, seen: Mask, sigma: float) -> Plane:
    """Of each pixel's pattern, what a Gaussian leaves of it: 1 amidst its like."""
    known = np.asarray(cv2.GaussianBlur(seen.astype(np.float32), (0, 0), sigma))
    real, imaginary = (
        np.asarray(cv2.GaussianBlur(np.ascontiguousarray(p, dtype=np.float32), (0, 0), sigma))
        for p in (turn.real, turn.imag)
    )
    along = real * turn.real + imaginary * turn.imag
    return np.asarray(along / np.maximum(known, _TINY), dtype=np.float32)
