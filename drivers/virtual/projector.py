"""A projector that lights the virtual scene."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from drivers.base import Context, DeviceRefused, Options, Projector, ProjectorInfo
from drivers.clock import NS
from drivers.virtual.bench import Emission
from drivers.virtual.device import VirtualDevice, VirtualOptions
from drivers.virtual.faults import Fault
from drivers.virtual.geometry import F32, Pinhole
from drivers.virtual.scene import TARGET
from drivers.virtual.timeline import Timeline


class ProjectorOptions(VirtualOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of ``[projector] driver = "virtual"``."""

    width: Annotated[int, Meta(ge=16, le=4096)] = 512
    height: Annotated[int, Meta(ge=16, le=4096)] = 384
    refresh_hz: Annotated[float, Meta(gt=0)] = 60.0
    latency_ms: Annotated[float, Meta(ge=0)] = 0.0  # from the flip to light; it is told
    hidden_latency_ms: Annotated[float, Meta(ge=0)] = 0.0  # the same; it is not told
    gamma: Annotated[float, Meta(gt=0)] = 1.0
    leakage: Annotated[float, Meta(ge=0, lt=1)] = 0.02  # b
    defocus_px: Annotated[float, Meta(ge=0)] = 0.6  # sigma of the blur, projector pixels


@dataclass(frozen=True, eq=False)
class _Shown:
    """An image that was shown; equal images have equal keys."""

    key: bytes
    image: NDArray[np.uint8]


class VirtualProjector(VirtualDevice, Projector):
    """A projector with a refresh: an image that was given flips at the next one.

    Its lamp is off (no light at all) until the first `show`, in the safe state, and when closed;
    showing black is another thing, for an unlit pixel emits `leakage` of a lit one. `show`, `safe`
    and `check` are safe to send again.
    """

    options_type = ProjectorOptions
    main_act = "show"
    main = True

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, ProjectorOptions)
        self._o = options
        self._epoch = self.clock.now_ns()
        self._shown: Timeline[_Shown | None] = Timeline(None)
        self._latest: _Shown | None = None
        levels = (np.arange(256, dtype=np.float32) / 255) ** options.gamma
        self._tone = (options.leakage + (1 - options.leakage) * levels).astype(np.float32)
        self._pinhole = Pinhole(
            (230.0, 420.0, -230.0), TARGET, options.width, options.height, math.radians(21.0)
        )
        self.bench.add(self)

    def info(self) -> ProjectorInfo:
        """See Projector."""
        o = self._o
        return ProjectorInfo(o.width, o.height, o.refresh_hz, o.latency_ms / 1e3)

    def facts(self) -> dict[str, Any]:
        """See Device; the leakage and the gamma that it was made with, for tests to compare."""
        return {"leakage": self._o.leakage, "gamma": self._o.gamma, "virtual": True}

    def show(self, image: NDArray[np.uint8]) -> int:
        """See Projector. A halt ends the wait; the flip happens all the same."""
        shape = (self._o.height, self._o.width)
        if image.shape != shape or image.dtype != np.uint8:
            raise DeviceRefused(
                self.name,
                "show",
                f"an image of {image.shape} {image.dtype}, not {shape} uint8",
                "draw it for the size in info()",
            )
        kinds = self._begin("show")
        key = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
        if self._latest is None or self._latest.key != key:
            self._latest = _Shown(key, image.copy())
        period = NS / self._o.refresh_hz
        told = round(self._o.latency_ms * 1e6)
        hidden = round(self._o.hidden_latency_ms * 1e6)
        late = round(period) if Fault.LATE_FLIP in kinds else 0
        with self.bench.lock:  # no frame that ends before `now` is still to be exposed
            count = math.floor((self.clock.now_ns() - self._epoch) / period) + 1
            flip = self._epoch + round(count * period)
            self._shown.change(flip + told + hidden + late, self._latest)
        self.clock.wait_until(flip, self._halted)
        return flip + told

    def safe(self) -> None:
        """See Device: the lamp off."""
        self._begin("safe")
        self._darken()

    def close(self) -> None:
        """See Device."""
        self._connected = False
        self._darken()

    def _darken(self) -> None:
        with self.bench.lock:
            self._shown.change(self.clock.now_ns(), None)

    # ------------------------------------------------------------ as a source on the bench

    @property
    def pinhole(self) -> Pinhole:
        """See Source."""
        return self._pinhole

    def emitted(self, start_ns: int, end_ns: int) -> Sequence[Emission]:
        """See Source."""
        return [
            Emission((end - start) / (end_ns - start_ns), shown.key, partial(self._draw, shown))
            for start, end, shown in self._shown.spans(start_ns, end_ns)
            if shown is not None
        ]

    def _draw(self, shown: _Shown) -> F32:
        emission = cv2.LUT(shown.image, self._tone)
        if self._o.defocus_px:
            emission = cv2.GaussianBlur(
                emission, (0, 0), self._o.defocus_px, borderType=cv2.BORDER_REPLICATE
            )
        return np.asarray(emission, np.float32)
