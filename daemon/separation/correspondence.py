"""Where the projector lit each camera pixel: wrapped phases of several periods -> coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

import numpy as np

from daemon.separation.radiometry import Plane


def unwrap(phases: Sequence[Plane], periods: Sequence[float], size: int) -> Plane:
    """Absolute projector coordinates (H, W) float32 in pixels from wrapped phases (radians, 0..2π).

    Every candidate that the first period allows over the projector's `size` is judged by how far
    the other periods' phases are from what they would be there, in pixels; the nearest one wins,
    and the periods' own coordinates are averaged around it with the weight of their precision
    (1/period²).
    """
    first = phases[0] * np.float32(periods[0] / (2 * np.pi))
    best = np.full(first.shape, np.inf, dtype=np.float32)
    found = first.copy()
    weights = 1.0 / np.square(np.asarray(periods))
    for turn in range(ceil(size / periods[0])):
        candidate = first + np.float32(turn * periods[0])
        cost = np.zeros_like(first)
        shift = np.zeros_like(first)
        for phase, period, weight in zip(phases[1:], periods[1:], weights[1:], strict=True):
            own = phase * np.float32(period / (2 * np.pi))
            apart = (own - candidate + np.float32(period / 2)) % np.float32(period)
            apart -= np.float32(period / 2)
            cost += np.float32(weight) * apart * apart
            shift += np.float32(weight) * apart
        better = cost < best
        best[better] = cost[better]
        found[better] = (candidate + shift * np.float32(1.0 / weights.sum()))[better]
    return found
