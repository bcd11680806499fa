"""What the projector's coordinates, as decoded, tell of mirrors and of a wrong declaration.

Of right ones neighbours differ by little, and one axis' coordinate changes mostly along it, as a
camera sees it that stands upright beside its projector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from daemon.separation.fineness import finer_pattern
from daemon.separation.handedness import Wave, reversed_pattern
from daemon.separation.radiometry import Plane
from daemon.separation.sampling import Mask

_PERIOD = 64.0
"""Projector pixels of the wave that a coordinate is made into; finer than this lies no mirror."""

_TORN = 0.15  # of neighbours: so many are far from each other where frames are in a wrong order
_FAR = 24.0  # projector pixels
_LAGS = (8, 32)  # pixels to farther ones
_CLEAR = 2.0  # projector pixels
_ACROSS = 3.0  # times the change along an axis: the other one's coordinate
_ENOUGH = 400  # neighbours to compare


@dataclass(frozen=True, slots=True)
class Told:
    """`mirrored` (H, W), figures for quality.json, and lines of advice; `trusted`: whether the
    frames are a code's at all."""

    mirrored: Mask
    facts: dict[str, Any]
    advice: list[str]
    trusted: bool = True


def mirrored_coordinates(
    planes: Mapping[str, Plane], strength: Plane, stripes: Plane | None
) -> Told:
    """Of planes `column` and/or `row` (H, W), projector pixels, NaN where they are not known.

    `strength` (H, W): the contrast of the stripes in standard deviations of its noise, 0 where
    coarse stripes may have told light that is not direct. `stripes` (H, W): lit less unlit light
    of fine ones (of both axes: their product).
    """
    known = np.logical_and.reduce([np.isfinite(plane) for plane in planes.values()])
    advice: list[str] = []
    facts: dict[str, Any] = {}
    for name, plane in planes.items():
        torn = _torn(plane, 1 if name == "column" else 0)
        if torn is None:
            continue
        facts[f"{name}_torn"] = round(torn, 4)
        if torn > _TORN:
            advice.append(
                f"the decoded {name}s of {torn:.0%} of the neighbouring pixels jump or run back: "
                "the frames are not a Gray code's in the declared order, each bit's pattern then "
                "its inverse, the coarsest first (--bits, --axes), or some are missing: the "
                f"{name}s are not to be trusted, and direct light may be a coarse stripe's"
            )
    if not advice:
        advice = other_axis(planes)
    if advice and any(value > _TORN for value in facts.values()):
        facts["mirrors_looked_for"] = False
        return Told(np.zeros(known.shape, np.bool_), facts, advice, trusted=False)
    waves = [_wave(plane, known) for plane in planes.values()]
    strong = np.where(known, strength, np.float32(0.0))
    mask = reversed_pattern(waves, strong)
    by = ["way round"]
    finer = None
    if stripes is not None:
        finer = finer_pattern(np.asarray(stripes, dtype=np.complex64), strength)
    if finer is not None:
        mask |= finer
        by.append("fineness")
    return Told(mask, {**facts, "mirrors_looked_for": True, "mirrors_by": by}, advice)


def _wave(plane: Plane, known: Mask) -> Wave:
    turn = np.where(known, plane, np.float32(0.0)) * np.float32(2.0 * np.pi / _PERIOD)
    return np.asarray(np.where(known, np.exp(1j * turn), 0.0), dtype=np.complex64)


def other_axis(planes: Mapping[str, Plane]) -> list[str]:
    """A line for each coordinate that changes along the other axis of the picture."""
    lines = []
    for name, plane in planes.items():
        axis = 1 if name == "column" else 0
        along, across = (_change(plane, a) for a in (axis, 1 - axis))
        if along is None or across is None or across <= _ACROSS * along:
            continue
        other = "row" if name == "column" else "column"
        lines.append(
            f"the decoded {name}s change along the picture's {name}s, not from one to the next: if "
            "the camera is not turned on its side, the stripes were those of the other axis "
            f"(--axes, --axis), and each is a {other}"
        )
    return lines


def _change(plane: Plane, axis: int) -> float | None:
    """The mean change from a pixel to the next along an axis; None where too few are known."""
    step = np.abs(np.diff(plane, axis=axis))
    step = step[np.isfinite(step)]
    return None if step.size < _ENOUGH else float(np.mean(np.minimum(step, _FAR)))


def _torn(plane: Plane, axis: int) -> float | None:
    """The part of the pixels that are far from their neighbours, or of those on the way to a
    farther one where the coordinate runs back; None where too few are known."""
    parts = []
    for a in (0, 1):
        step = np.abs(np.diff(plane, axis=a))
        step = step[np.isfinite(step)]
        if step.size < _ENOUGH:
            return None
        parts.append(float(np.mean(step > _FAR)))
    for lag in _LAGS:
        here: list[slice] = [slice(None), slice(None)]
        there: list[slice] = [slice(None), slice(None)]
        here[axis], there[axis] = slice(None, -lag), slice(lag, None)
        step = plane[tuple(there)] - plane[tuple(here)]
        step = step[np.isfinite(step) & (np.abs(step) > _CLEAR)]
        if step.size >= _ENOUGH:
            forward = float(np.mean(step > 0))
            parts.append(min(forward, 1.0 - forward))
    return max(parts)
