"""Which pixels a mesh covered: in full light at some time, in the umbra at another (§4.2).

A circle of the wrong radius leaves islands of pixels that were never in full light, or never in the
umbra. There (L_max - L_min)/L_min falls below that of the pixels around, whatever the colour of the
surface; a grey closing over the mesh's pitch, as it appears in the picture, restores it from all
sides. But print falls short of what is around it, too, and so does a shadow of the scene's own that
is narrower than a pitch. Time tells them apart:

- a pixel that was in light for long, and in shade for long, is covered, however small the step;
- where noise hides the step, what is around it tells: from the rim of an island inwards the time in
  light goes to nothing; at the edge of print, or of a shadow, light falls and the time does not.
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

BRIEF = 0.5
"""A pixel that was in full light, or in the umbra, for a smaller part of the time that pixels
usually are was not covered, if it falls short ..."""

BRIEF_OF_LEAST = 0.25
"""... or, where it is known for which part of a turn the circle serves its worst point, for a
smaller part of that: in wax or in a mirror light comes and goes little by little, and stays but
briefly at either end."""

_TOLD = 4 * SIGNIFICANT
"""A smaller step, in deviations of a frame, does not tell light from shade frame by frame: noise
that is taken for too small, as that of rendered frames, parts the ends by half of it."""

_AROUND = np.ones((3, 3), np.uint8)

_RIM = 0.5
"""An island's rim is brief: in a larger part of its pixels (.95 around rendered islands, .08 to .36
around shadows)."""


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


def coverage_of_mosaic(
    levels: Levels, one: Plane, pitch: float, frames: int, least: float | None
) -> Coverage:
    """`coverage` of a mosaic, by colours, for the neighbours to be alike."""
    never_lit, never_unlit, single = (np.zeros(one.shape, np.bool_) for _ in range(3))
    rests_on = np.zeros(one.shape, np.uint16)
    count = lit = 0
    for row, column in np.ndindex(2, 2):
        part = np.s_[row::2, column::2]
        if not one[part].size:  # of a picture of a single row or column
            continue
        found = coverage(levels.of(part), one[part], max(pitch / 2, 3.0), frames, least)
        never_lit[part], never_unlit[part] = found.never_lit, found.never_unlit
        single[part], rests_on[part] = found.single, found.frames
        count, lit = count + found.covered, lit + found.lit
    return Coverage(never_lit, never_unlit, single, rests_on, count, lit)


def coverage(
    levels: Levels, one: Plane, pitch: float, frames: int, least: float | None
) -> Coverage:
    """Which pixels (H, W) were in full light and in the umbra, of so many `frames`.

    `one` is the deviation of a frame's light (float32, the levels' shape), `pitch` the mesh's in
    the picture, pixels, `least` the part of a turn that the circle has every point, at least, in
    full light, and in the umbra; None: that is not known.
    """
    bright, dark, noisy = (_grey(x) for x in (levels.bright, levels.dark, one))
    span = bright - dark
    kernel = _disc(pitch)
    dim = np.maximum(cv2.blur(dark, (3, 3) if pitch < 12 else (5, 5)), noisy)
    tone, tone_around = _closed(span / np.maximum(dark, noisy), kernel)
    level, level_around = _closed(span / dim, kernel)
    expected = np.maximum(level_around * dim, np.float32(1e-3))  # what the span should be
    least_span = np.maximum(np.float32(LEAST_MODULATION) * bright, 2 * SIGNIFICANT * noisy)
    lit = expected > least_span
    rests_on = np.minimum(_most(levels.lit), _most(levels.unlit))
    # Short of what? Of light, if the brightest is further from its neighbours' than the
    # darkest is.
    light = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, kernel)
    shade = cv2.morphologyEx(dark, cv2.MORPH_OPEN, kernel)
    too_dark = np.asarray(light - bright >= dark - shade)
    if not lit.any():
        nothing = np.zeros_like(rests_on)
        return Coverage(too_dark, ~too_dark, nothing > 0, nothing, 0, lit.size)

    enough = 1 - np.maximum(np.float32(SHORTFALL), np.float32(SIGNIFICANT) * noisy / expected)
    short = lit & (level < level_around * enough)
    vague = np.float32(SIGNIFICANT) * noisy > np.float32(2 * SHORTFALL) * dark
    short &= vague | (tone < tone_around * np.float32(1 - SHORTFALL))
    less = lit & (span < expected * enough)
    silent = span < np.maximum(np.float32(_TOLD) * noisy, np.float32(LEAST_MODULATION) * bright)
    brief = ~silent & _brief(levels, lit & ~short, frames, least)
    island = _within(less & silent, brief, ~silent)
    missed = island | (short & brief)
    # The rim of an island is thinner than what smoothing leaves of it.
    rim = cv2.dilate(missed.astype(np.uint8), _AROUND) > 0
    missed |= rim & less & (brief | silent)
    lit &= missed | (span >= least_span)  # the others lie in the scene's own shadow
    rests_on[missed] = 0
    single = lit & (rests_on == 1)
    wanted = int(np.count_nonzero(lit))
    covered = int(np.count_nonzero(lit & (rests_on >= LEAST_FRAMES)))
    return Coverage(missed & too_dark, missed & ~too_dark, single, rests_on, covered, wanted)


def _brief(
    levels: Levels, usual: NDArray[np.bool_], frames: int, least: float | None
) -> NDArray[np.bool_]:
    """Pixels that were in full light, or in the umbra, for less of the time than usual."""
    told = np.maximum(levels.told, np.float32(1e-3))
    lit, unlit = (_most(count) / told for count in (levels.lit, levels.unlit))
    found = np.zeros(usual.shape, np.bool_)
    for here, there in ((lit, unlit), (unlit, lit)):
        if least is not None:
            limit = BRIEF_OF_LEAST * least * frames
        else:
            limit = BRIEF * float(np.median(here[usual])) if usual.any() else 0.0
        limit = max(limit, float(LEAST_FRAMES))
        found |= (here < limit) | (frames - there < limit)
    return found


def _within(
    mask: NDArray[np.bool_], inside: NDArray[np.bool_], known: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The connected parts of a mask of which most neighbours, of those `known`, are `inside`."""
    parts, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    # of two parts next to a pixel it counts for one
    nearest = cv2.dilate(label.astype(np.float32), _AROUND).astype(np.intp)
    around = np.asarray((nearest > 0) & known)
    neighbours = np.bincount(nearest[around], minlength=parts)
    of_them = np.bincount(nearest[around & inside], minlength=parts)
    return np.asarray(mask & (of_them > _RIM * neighbours)[label])


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
