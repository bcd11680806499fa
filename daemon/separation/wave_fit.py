"""A wave in time at each pixel, fitted in constant memory, whatever the number of phases."""

from __future__ import annotations

import numpy as np

from daemon.separation.handedness import Wave
from daemon.separation.radiometry import Plane

_LEAST_ECCENTRIC = 0.02
"""Least ratio of the fit's eigenvalues: phases that nearly coincide don't tell M, B, φ apart."""


class WaveFit:
    """Sums of one frequency: ΣI, ΣI cos δ, ΣI sin δ, and those of the design."""

    def __init__(self) -> None:
        self._sums: Plane | None = None
        self._scaled: Plane | None = None
        self._normal = np.zeros((3, 3))
        self._solved: Plane | None = None
        self.frames = 0

    def add(self, light: Plane, delta: float) -> None:
        """Take in the linear light of a frame of phase δ, radians."""
        if self._sums is None or self._scaled is None:
            self._sums = np.zeros((3, *light.shape), dtype=np.float32)
            self._scaled = np.empty_like(light)
        row = np.array([1.0, np.cos(delta), np.sin(delta)])
        self._sums[0] += light
        for index in (1, 2):
            np.multiply(light, np.float32(row[index]), out=self._scaled)
            self._sums[index] += self._scaled
        self._normal += np.outer(row, row)
        self._solved = None
        self.frames += 1

    @property
    def solvable(self) -> bool:
        """Whether there are three phases that tell M, B and φ apart."""
        if self.frames < 3:
            return False
        values = np.linalg.eigvalsh(self._normal)
        return bool(values[0] > _LEAST_ECCENTRIC * values[-1])

    def solve(self) -> tuple[Plane, Plane, Plane]:
        """M, and the factors of cos δ and sin δ: B sin φ, B cos φ."""
        assert self._sums is not None, "only a solvable fit is solved"
        if self._solved is None:
            inverse = np.linalg.inv(self._normal).astype(np.float32)
            self._solved = np.tensordot(inverse, self._sums, axes=1)
            self._solved.flags.writeable = False  # it is asked for many times a result
        return self._solved[0], self._solved[1], self._solved[2]

    def grey(self) -> tuple[Plane, Wave]:
        """M and the wave as a complex number (H, W), colours added."""
        mean, cosine, sine = self.solve()
        wave = np.asarray(cosine + 1j * sine, dtype=np.complex64)
        if wave.ndim == 3:
            return mean.sum(axis=2), np.asarray(wave.sum(axis=2), dtype=np.complex64)
        return mean, wave

    def variances(self) -> tuple[float, float]:
        """Variance of M and of one factor of the wave for samples of variance 1."""
        inverse = np.linalg.inv(self._normal)
        return float(inverse[0, 0]), float((inverse[1, 1] + inverse[2, 2]) / 2)

    def brightest(self) -> Plane:
        """Light at the crest of the fitted wave."""
        mean, cosine, sine = self.solve()
        crest: Plane = mean + np.hypot(cosine, sine)
        return crest
