"""Which pixels a mesh covered: in full light at some time, in the umbra at another (§4.2).

A circle of the wrong radius leaves islands of pixels that were never in full light, or never in the
umbra. There (L_max - L_min)/L_min falls below that of the pixels around, whatever the colour of the
surface; a grey closing over the mesh's pitch, as it appears in the picture, restores it from all
sides. The scene's own shadows are larger than a pitch and stay as they are; ones that are smaller
are flagged with the islands.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.finish import SIGNIFICANT
from daemon.separation.levels import Levels
from daemon.separation.radiometry import Plane

LEAST_MODULATION = 0.05
"""A smaller part of the light comes and goes with interreflection while the mesh moves."""

SHORTFALL = 0.15
"""A pixel whose modulation is short of its surroundings' by more was not covered."""

LEAST_FRAMES = 2
"""Frames in full light, and in the umbra, of a pixel that is covered: one is SINGLE."""


@dataclass(frozen=True, slots=True)
class Coverage:
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


def coverage_of_mosaic(levels: Levels, one: Plane, pitch: float) -> Coverage:
    """`coverage` of a mosaic, by colours, for the neighbours to be alike."""
    never_lit, never_unlit, single = (np.zeros(one.shape, np.bool_) for _ in range(3))
    frames = np.zeros(one.shape, np.uint16)
    count = lit = 0
    for row, column in np.ndindex(2, 2):
        part = np.s_[row::2, column::2]
        if not one[part].size:  # of a picture of a single row or column
            continue
        found = coverage(levels.of(part), one[part], max(pitch / 2, 3.0))
        never_lit[part], never_unlit[part] = found.never_lit, found.never_unlit
        single[part], frames[part] = found.single, found.frames
        count, lit = count + found.covered, lit + found.lit
    return Coverage(never_lit, never_unlit, single, frames, count, lit)


def coverage(levels: Levels, one: Plane, pitch: float) -> Coverage:
    """Which pixels (H, W) were in full light and in the umbra, as far as those around tell.

    `one` is the deviation of a frame's light (float32, the levels' shape), `pitch` the mesh's in
    the picture, pixels.
    """
    bright, dark, noisy = (_grey(x) for x in (levels.bright, levels.dark, one))
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
    return Coverage(short & too_dark, short & ~too_dark, single, frames, covered, wanted)


def _grey(light: Plane) -> Plane:
    """One plane of a frame's light."""
    return light if light.ndim == 2 else np.asarray(light.mean(axis=2), dtype=np.float32)


def _closed(plane: NDArray[Any], kernel: NDArray[np.uint8]) -> tuple[Plane, Plane]:
    """A plane without its specks, and its grey closing."""
    smooth = cv2.medianBlur(np.asarray(plane, dtype=np.float32), 3)
    closed = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, kernel)
    return np.asarray(smooth, dtype=np.float32), np.asarray(closed, dtype=np.float32)


def _disc(diameter: float) -> NDArray[np.uint8]:
    side = max(3, round(diameter)) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), dtype=np.uint8)


def _most(counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Of the channels the one that rests on most frames."""
    return counts.copy() if counts.ndim == 2 else np.asarray(counts.max(axis=2), dtype=np.uint16)
