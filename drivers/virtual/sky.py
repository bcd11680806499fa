"""Weather: how much of its light a source gives at a time, and how the wind shakes a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

KNOT_S = 15.0  # between two random strengths
WAVES = 6  # that a sway is the sum of


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


@dataclass(frozen=True)
class Sway:
    """Where the wind pushes a camera's picture: a sum of waves around `hertz` in x and y, of the
    standard deviation that the schedule of (second, px) says; a function of time and seed."""

    gusts: tuple[tuple[float, float], ...] = ()
    hertz: float = 1.5
    seed: int = 1

    def at(self, seconds: float) -> tuple[float, float]:
        """The shift in px, x and y."""
        if not self.gusts:
            return 0.0, 0.0
        moments, strengths = zip(*self.gusts, strict=True)
        strength = float(np.interp(seconds, moments, strengths))
        if not strength:
            return 0.0, 0.0
        rng = np.random.default_rng([self.seed, WAVES])
        hertz = self.hertz * rng.uniform(0.5, 1.5, (2, WAVES))
        phase = rng.uniform(0.0, 2 * np.pi, (2, WAVES))
        waves = np.sin(2 * np.pi * hertz * seconds + phase).sum(1) * np.sqrt(2.0 / WAVES)
        return strength * float(waves[0]), strength * float(waves[1])
