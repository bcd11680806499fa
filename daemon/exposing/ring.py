"""A bounded ring of preallocated frame buffers between camera, recorder and estimator.

Memory is the ring's whatever the scan's length. Policy when it is empty: a stepped scan waits
(`take` blocks), a video scan records an explicit gap (`take` with no wait gives None).
"""

from __future__ import annotations

import queue
from typing import Any

import numpy as np
from numpy.typing import NDArray

Buffer = NDArray[Any]


class Ring:
    """`count` buffers of one shape and dtype; thread-safe."""

    def __init__(self, count: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self._free: queue.SimpleQueue[Buffer] = queue.SimpleQueue()
        for _ in range(count):
            self._free.put(np.zeros(shape, dtype))
        self.count = count

    def take(self, timeout_s: float) -> Buffer | None:
        """A free buffer, or None if there is none within the time."""
        try:
            if timeout_s <= 0:
                return self._free.get_nowait()
            return self._free.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def give(self, buffer: Buffer) -> None:
        """Hand a buffer back; nobody may look at it any more."""
        self._free.put(buffer)
