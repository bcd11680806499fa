"""What the projector's coordinates, as decoded, tell of mirrors and of a wrong declaration.

Of right ones neighbours differ by little, and one axis' coordinate changes mostly along it, as a
camera sees it that stands upright beside its projector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.fineness import finer_pattern
from daemon.separation.handedness import Wave, reversed_pattern

Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

_PERIOD = 64.0
"""Projector pixels of the wave that a coordinate is made into; finer than this lies no mirror."""

_TORN = 0.25  # of neighbours: so many are far from each other where frames are in a wrong order
_FAR = 24.0  # projector pixels
_ACROSS = 3.0  # times the change along an axis: the other one's coordinate
_ENOUGH = 400


@dataclass(frozen=True, slots=True)
class Told:
    """`mirrored` (H, W), figures for quality.json, and lines of advice."""

    mirrored: Mask
    facts: dict[str, Any]
    advice: list[str]


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
        torn, along, across = _steps(plane, 1 if name == "column" else 0)
        if torn is None:
            continue
        facts[f"{name}_torn"] = round(torn, 4)
        if torn > _TORN:
            advice.append(
                f"the decoded {name}s of {torn:.0%} of the neighbouring pixels are far from each "
                "other: the frames are not a Gray code's in the declared order, each bit's pattern "
                "then its inverse, the coarsest first (--bits, --axes), or some are missing; "
                f"direct light may be a coarse stripe's and the {name} is not to be trusted"
            )
        elif across > _ACROSS * along:
            other = "row" if name == "column" else "column"
            advice.append(
                f"the decoded {name}s change {across / max(along, 1e-6):.0f} times faster along "
                f"the picture's {'columns' if name == 'column' else 'rows'} than along its "
                f"{'rows' if name == 'column' else 'columns'}: if the camera is not turned on its "
                f"side, the stripes were those of the other axis (--axes), and it is the {other}"
            )
    if advice and any(value > _TORN for value in facts.values()):
        return Told(np.zeros(known.shape, np.bool_), {**facts, "mirrors_looked_for": False}, advice)
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


def _steps(plane: Plane, axis: int) -> tuple[float | None, float, float]:
    """The part of neighbours that are far from each other, and the mean change along the picture's
    `axis` and along the other; None where too few are known."""
    found = [np.abs(np.diff(plane, axis=a)) for a in (axis, 1 - axis)]
    steps = [step[np.isfinite(step)] for step in found]
    if min(step.size for step in steps) < _ENOUGH:
        return None, 0.0, 0.0
    torn = max(float(np.mean(step > _FAR)) for step in steps)
    along, across = (float(np.mean(np.minimum(step, _FAR))) for step in steps)
    return torn, along, across
