"""The latest frame, small enough to look at, at a bounded rate and cost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.display import thumbnail
from drivers.base import CameraInfo, Frame

_EVERY_S = 0.25
_WIDTH = 640
_HISTOGRAM_BINS = 64


@dataclass(frozen=True, slots=True)
class Glimpse:
    """A small sRGB picture (h, w, 3) uint8 of a frame, and what there is to say of it."""

    picture: NDArray[np.uint8]
    facts: dict[str, Any]
    run: str


class Viewfinder:
    """Keeps the newest glimpse; thread-safe. `on_glimpse` is told each, at most 4 a second."""

    def __init__(self, on_glimpse: Callable[[Glimpse], None]) -> None:
        self._on_glimpse = on_glimpse
        self._lock = threading.Lock()
        self._latest: Glimpse | None = None
        self._next = 0.0

    def offer(self, frame: Frame, info: CameraInfo, run: str = "", *, now: bool = False) -> None:
        """Look at a frame, unless one was looked at just before (`now`: in any case)."""
        moment = time.monotonic()
        if moment < self._next and not now:
            return
        self._next = moment + _EVERY_S
        glimpse = Glimpse(
            picture=thumbnail(frame.pixels, info.pixel_format, _WIDTH),
            facts=facts_of(frame, info),
            run=run,
        )
        with self._lock:
            self._latest = glimpse
        self._on_glimpse(glimpse)

    def latest(self) -> Glimpse | None:
        """The newest glimpse, if there was a frame since the start."""
        with self._lock:
            return self._latest

    def picture(self) -> NDArray[np.uint8] | None:
        """The newest picture alone."""
        glimpse = self.latest()
        return glimpse.picture if glimpse else None


def facts_of(frame: Frame, info: CameraInfo) -> dict[str, Any]:
    """Exposure, saturation and histogram of a frame, from a sample of its pixels."""
    full = info.pixel_format.full_scale
    step = max(1, int((frame.pixels.size / 250_000) ** 0.5))
    sample = frame.pixels[::step, ::step]
    counts, _ = np.histogram(sample, bins=_HISTOGRAM_BINS, range=(0, full + 1))
    return {
        "exposure_us": frame.exposure_us,
        "gain": frame.gain,
        "width": info.width,
        "height": info.height,
        "pixel_format": info.pixel_format.value,
        "full_scale": full,
        "minimum": int(sample.min()),
        "mean": float(sample.mean()),
        "maximum": int(sample.max()),
        "saturated": float(np.count_nonzero(sample >= full) / sample.size),
        "histogram": counts.tolist(),
        "source": frame.source,
    }
