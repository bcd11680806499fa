"""Clouds: how much of its light a source gives at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

KNOT_S = 15.0  # between two random strengths


@dataclass(frozen=True)
class Clouds:
    """A schedule of (second, strength), times random clouds that take up to `depth`; both repeat
    exactly, being functions of time and seed."""

    schedule: tuple[tuple[float, float], ...] = ()
    depth: float = 0.0
    seed: int = 1

    def strength(self, seconds: float) -> float:
        """Part of its full light, 0..1 and more if the schedule says so."""
        scheduled = 1.0
        if self.schedule:
            at, levels = zip(*self.schedule, strict=True)
            scheduled = float(np.interp(seconds, at, levels))
        if not self.depth:
            return scheduled
        knot, part = divmod(max(seconds, 0.0) / KNOT_S, 1)
        a, b = (np.random.default_rng([self.seed, int(knot) + k]).random() for k in (0, 1))
        smooth = part * part * (3 - 2 * part)
        return scheduled * float(1 - self.depth * (a + (b - a) * smooth))
