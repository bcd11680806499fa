"""The latest frame, small enough to look at, at a bounded rate and cost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.pictures.display import thumbnail
from drivers.base.camera import CameraInfo, Frame

_EVERY_S = 0.25  # between two pictures of a run
WIDTH = 640
_HISTOGRAM_BINS = 64


@dataclass(frozen=True, slots=True)
class Glimpse:
    """A small sRGB picture (h, w, 3) uint8, and what there is to say of it.

    `saturated` (h, w) uint8 is 1 where a pixel of the camera under it is at its full scale.
    """

    picture: NDArray[np.uint8]
    saturated: NDArray[np.uint8]
    facts: dict[str, Any]
    run: str
    what: str = "frame"  # frame, direct, global
    at_s: float = field(default_factory=time.monotonic)  # when it was made


class Viewfinder:
    """Keeps the newest glimpses; thread-safe. `on_glimpse` is told each, of a run's frames at most
    4 a second."""

    def __init__(self, on_glimpse: Callable[[Glimpse], None]) -> None:
        self._on_glimpse = on_glimpse
        self._lock = threading.Lock()
        self._latest: dict[str, Glimpse] = {}
        self._next = 0.0

    def offer(self, frame: Frame, info: CameraInfo, run: str = "", *, now: bool = False) -> None:
        """Look at a frame, unless one was looked at just before (`now`: in any case)."""
        moment = time.monotonic()
        if moment < self._next and not now:
            return
        self._next = moment + _EVERY_S
        picture = thumbnail(frame.pixels, info.pixel_format, WIDTH)
        height, width = picture.shape[:2]
        self.add(
            Glimpse(
                picture=picture,
                saturated=saturation_of(frame.pixels, info, height, width),
                facts=facts_of(frame, info),
                run=run,
            )
        )

    def add(self, glimpse: Glimpse) -> None:
        """Keep a glimpse, and tell of it."""
        with self._lock:
            self._latest[glimpse.what] = glimpse
        self._on_glimpse(glimpse)

    def latest(self, what: str = "frame") -> Glimpse | None:
        """The newest glimpse of a kind, if there was one since the start."""
        with self._lock:
            return self._latest.get(what)

    def picture(self) -> NDArray[np.uint8] | None:
        """The newest picture alone."""
        glimpse = self.latest()
        return glimpse.picture if glimpse else None


def saturation_of(
    pixels: NDArray[Any], info: CameraInfo, height: int, width: int
) -> NDArray[np.uint8]:
    """Where a frame is over-exposed: (height, width) uint8, 1 for each cell of the small picture
    with a pixel at full scale in it."""
    hot: NDArray[np.bool_] = np.asarray(pixels >= info.pixel_format.full_scale)
    if hot.ndim == 3:
        hot = np.asarray(hot.any(axis=2))
    return cells(hot, height, width)


def cells(marked: NDArray[Any], height: int, width: int) -> NDArray[np.uint8]:
    """A mask at a smaller size: 1 where anything under a cell is marked."""
    if not marked.any():
        return np.zeros((height, width), np.uint8)
    spread = cv2.resize(marked.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return (np.asarray(spread) > 0).astype(np.uint8)


def facts_of(frame: Frame, info: CameraInfo) -> dict[str, Any]:
    """Exposure, saturation and histogram of a frame, from a sample of its pixels."""
    full = info.pixel_format.full_scale
    step = max(1, int((frame.pixels.size / 250_000) ** 0.5)) | 1  # odd: all colours of a mosaic
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
