"""The contrast of checkers, free of what noise adds to the largest of several samples; and a sweep
of their sizes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Lighting, NotYet, Observation
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.references import References
from daemon.separation.sampling import Mask, Turns, bright


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


class CheckerSweep:
    """References, then checkers of one size after the other, each followed by its complement.

    Patterns are numbered through; size k has `images[k]` of them. When its last has come,
    `on_size(k, contrast)` is called. Memory: eight planes, and one a kind of reference.
    """

    def __init__(
        self, response: Response, images: tuple[int, ...], on_size: Callable[[int, Plane], None]
    ) -> None:
        self.references = References(response)
        self._contrast = CheckerContrast(response)
        self._turns = Turns()
        self._ends = np.cumsum(images)
        self._on_size = on_size

    @property
    def sign(self) -> Plane | None:
        """Of the first pattern of the size under way, or of the last: which samples it lit."""
        return self._contrast.sign

    def lit(self) -> tuple[Plane, Plane, Mask]:
        """Ambient light, light under white, and which samples tell the two well apart: see
        `bright`. Raises NotYet without such references."""
        ambient, white = (self.references.mean(k) for k in (Lighting.AMBIENT, Lighting.WHITE))
        saturated = self.references.white_saturated
        if ambient is None or white is None or saturated is None:
            raise NotYet("checkers are measured against source-off and white frames: none came")
        return ambient, white, bright(ambient, white, saturated)

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        if observation.lighting is not Lighting.PATTERN:
            if observation.used:
                self.references.add(pixels, observation.lighting)
            return
        if (overdue := self._turns.overdue(observation)) is not None:
            self._end(overdue)
        if observation.used:
            self._contrast.add(pixels)
        if observation.last:
            self._end(observation.pattern)

    def _end(self, pattern: int) -> None:
        self._contrast.end_of_pattern()
        if pattern + 1 in self._ends:
            number = int(np.searchsorted(self._ends, pattern, side="right"))
            self._on_size(number, self._contrast.take())
