"""The k smallest and k largest samples of each pixel, kept in order, in the camera's own type."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Ranked:
    """The `keep` most extreme samples so far: planes[0] the most extreme.

    An update is 2 `keep` - 1 in-place minima and maxima over a frame, whatever came before; the
    result does not depend on the order of frames. Before `keep` frames the last planes repeat the
    least extreme sample.
    """

    def __init__(self, keep: int, *, largest: bool) -> None:
        self.keep = keep
        self.frames = 0
        self._outer: np.ufunc = np.maximum if largest else np.minimum
        self._inner: np.ufunc = np.minimum if largest else np.maximum
        self._planes: NDArray[Any] | None = None
        self._carried: NDArray[Any] | None = None
        self._next: NDArray[Any] | None = None

    @property
    def planes(self) -> NDArray[Any]:
        """(keep, ...) samples, the most extreme first. Raises ValueError with no frames."""
        if self._planes is None:
            raise ValueError("no frame has come yet")
        return self._planes

    def add(self, samples: NDArray[Any]) -> None:
        """Take in a frame; it is not kept."""
        if self._planes is None or self._carried is None or self._next is None:
            self._planes = np.repeat(samples[None], self.keep, axis=0)
            self._carried = np.empty_like(samples)
            self._next = np.empty_like(samples)
            self.frames = 1
            return
        filled = min(self.frames, self.keep)  # places that hold a sample of their own
        carried = samples
        for rank in range(self.keep):
            plane = self._planes[rank]
            if rank == filled:
                plane[...] = carried
                for beyond in range(rank + 1, self.keep):
                    self._planes[beyond][...] = carried
                break
            if rank < self.keep - 1:
                self._inner(plane, carried, out=self._next)
            self._outer(plane, carried, out=plane)
            carried = self._next
            self._carried, self._next = self._next, self._carried
        self.frames += 1
