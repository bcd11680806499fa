"""The contrast of checkers, free of what noise adds to the largest of several samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import FrameMean, Plane, Response


class CheckerContrast:
    """Pairs of a pattern and its complement -> lit less unlit light where a sample resolves best.

    Of all pairs, one half of the frames chooses the one with the greatest difference at each
    sample, the other half measures it: else noise would choose, and be measured with the light.
    """

    def __init__(self, response: Response) -> None:
        self._halves = (FrameMean(response), FrameMean(response))
        self._taken = 0
        self._shown: tuple[Plane, Plane] | None = None  # a pattern, until its complement comes
        self._best: tuple[Plane, Plane] | None = None
        self.sign: Plane | None = None  # of the first pair: which samples its pattern lit

    def add(self, pixels: NDArray[Any]) -> None:
        """Take in a frame of the pattern under way."""
        self._halves[self._taken % 2].add(pixels)
        self._taken += 1

    def end_of_pattern(self) -> None:
        """The pattern's frames have all come; its complement is next, or another pattern."""
        first, second = self._halves
        if self._taken:
            choosing = first.value()
            measuring = second.value() if second.frames else choosing
            if self._shown is None:
                self._shown = choosing, measuring
            else:
                self._compare(self._shown[0] - choosing, self._shown[1] - measuring)
                self._shown = None
        first.clear()
        second.clear()
        self._taken = 0

    def take(self) -> Plane:
        """The contrast over all pairs, and begin again. Raises ValueError without a pair."""
        if self._best is None:
            raise ValueError("no pattern has come with its complement")
        contrast = self._best[1]
        self._best = None
        return contrast

    def _compare(self, choosing: Plane, measuring: Plane) -> None:
        size, contrast = np.abs(choosing), np.sign(choosing) * measuring
        if self._best is None:
            self.sign = np.sign(choosing)
        else:
            better = size > self._best[0]
            size = np.where(better, size, self._best[0])
            contrast = np.where(better, contrast, self._best[1])
        self._best = size, contrast
