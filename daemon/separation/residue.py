"""Where a pattern came by way of a mirror: what each method's waves tell, by two signs.

A pattern that lies the other way round (`handedness`) needs waves of one or two coordinates; one
that lies finer than elsewhere (`fineness`) any pattern that the camera resolves. A flat mirror is
told by the first alone, the rim of a ball by the second alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.fineness import finer_pattern
from daemon.separation.handedness import Wave, WaveSums, imbalance, reversed_pattern, strength
from daemon.separation.radiometry import Plane
from daemon.separation.sampling import Mask

_UNLIKE = 0.1
"""Imbalance of a checkerboard's waves from which the frames are not its shifts."""


def mirrored(
    waves: Sequence[Wave], strength: Plane, *, turning: bool, smooth: bool
) -> tuple[Mask | None, dict[str, Any]]:
    """Where a mirror shows the pattern, (H, W) bool or None where the frames cannot tell; facts.

    `waves` and `strength` are those of `handedness.reversed_pattern`; `turning`: phases rise with
    the projector's coordinates, so that they have a way round; `smooth`: they rise evenly, not
    from patch to patch.
    """
    found: list[Mask] = []
    by = []
    if turning:
        by.append("way round")
        found.append(reversed_pattern(waves, strength))
    finer = [finer_pattern(wave, strength, smooth=smooth) for wave in waves]
    if all(mask is not None for mask in finer):
        by.append("fineness")
        found += [mask for mask in finer if mask is not None]
    facts = {"mirrors_looked_for": bool(by), "mirrors_by": by}
    return (np.logical_or.reduce(found) if found else None), facts


@dataclass(frozen=True, slots=True)
class Mirrors:
    """Where a mirror shows the pattern, (H, W) bool or None where the frames cannot tell; facts;
    and whether the frames can be the patterns that were declared, in their order."""

    mask: Mask | None
    facts: dict[str, Any]
    as_declared: bool = True


def misfit_of(sums: WaveSums | None, deviation: Plane) -> float | None:
    """`handedness.imbalance` of a checkerboard's sums; None where they do not tell. `deviation`: a
    sample's by noise alone, and not by frames that are of other shifts."""
    waves = None if sums is None else sums.waves()
    if sums is None or waves is None:
        return None
    return imbalance(waves, strength(waves, deviation * np.float32(sums.gain)))


def in_order(misfit: float | None) -> bool:
    """Whether frames with such a misfit are a checkerboard's shifts."""
    return misfit is not None and misfit <= _UNLIKE


def of_shifts(sums: WaveSums | None, deviation: Plane, unlike: float | None) -> Mirrors:
    """`mirrored` of a scan's sums, `deviation` that of a sample, `unlike` the sums' misfit.

    Two waves are a checkerboard's x + y and x - y, one wave that of random patches, of which
    nothing tells the order.
    """
    waves = None if sums is None else sums.waves()
    if sums is None or waves is None:
        return Mirrors(None, {"mirrors_looked_for": False})
    strong = strength(waves, deviation * np.float32(sums.gain))
    if len(waves) == 1:
        return Mirrors(*mirrored(waves, strong, turning=False, smooth=False))
    misfit = {"pattern_misfit": None if unlike is None else round(unlike, 4)}
    if unlike is not None and not in_order(unlike):
        return Mirrors(None, {"mirrors_looked_for": False, **misfit}, as_declared=False)
    mask, facts = mirrored(waves, strong, turning=True, smooth=True)
    return Mirrors(mask, {**facts, **misfit})


NOT_SHIFTS = (
    "the frames are not the shifts of a checkerboard that were declared, in their order "
    "(--checker, --shift, --shifts), or something moved: see that the folder holds this scan "
    "alone, and that its names sort in the order of the shifts"
)
"""Advice where `of_shifts` says that the frames are not those declared."""


def patch_weights(patterns: int) -> NDArray[np.complex128]:
    """Weights of `WaveSums` (patterns, 1) that give each patch of a random set a phase; those of
    the last fifth are 0, for the others tell enough."""
    needed = patterns - patterns // 5
    turn = 2.0 * np.pi * np.arange(needed) / needed
    weights = np.zeros((patterns, 1), dtype=np.complex128)
    weights[:needed, 0] = np.exp(1j * turn)
    return weights
