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

from drivers.base.device import Context, Options
from drivers.base.errors import DeviceRefused
from drivers.base.projector import LoadedSequence, Projector, ProjectorInfo, SequenceLimits
from drivers.clock import NS
from drivers.virtual.bench import Emission, TriggerLine
from drivers.virtual.device import VirtualDevice, VirtualOptions
from drivers.virtual.faults import Fault
from drivers.virtual.geometry import F32, Pinhole
from drivers.virtual.scene import TARGET
from drivers.virtual.timeline import Timeline

SEQUENCE = SequenceLimits(images=256, bits=8, period_us=(200.0, 1e6))
START_NS = 1_000_000  # from the command to the first image
REMEMBERED = 1024  # changes of light: the longest sequence, and one before it


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
    showing black is another thing, for an unlit pixel emits `leakage` of a lit one. A sequence
    runs at its own period, with a pulse on the bench's trigger line as each image begins; the lamp
    is off between images and after the last. `show`, `load`, `stop`, `safe` and `check` are safe
    to send again, `run` begins anew.
    """

    options_type = ProjectorOptions
    main_act = "show"
    main = True

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, ProjectorOptions)
        self._o = options
        self._epoch = self.clock.now_ns()
        self._shown: Timeline[_Shown | None] = Timeline(None, REMEMBERED)
        self._latest: _Shown | None = None
        self._loaded: tuple[LoadedSequence, tuple[_Shown, ...]] | None = None
        levels = (np.arange(256, dtype=np.float32) / 255) ** options.gamma
        self._tone = (options.leakage + (1 - options.leakage) * levels).astype(np.float32)
        self._pinhole = Pinhole(
            (230.0, 420.0, -230.0), TARGET, options.width, options.height, math.radians(21.0)
        )
        self.bench.add(self)
        self._line = self.bench.line = self.bench.line or TriggerLine()

    def info(self) -> ProjectorInfo:
        """See Projector."""
        o = self._o
        return ProjectorInfo(o.width, o.height, o.refresh_hz, o.latency_ms / 1e3, SEQUENCE)

    def facts(self) -> dict[str, Any]:
        """See Device; the leakage and the gamma that it was made with, for tests to compare."""
        return {"leakage": self._o.leakage, "gamma": self._o.gamma, "virtual": True}

    def show(self, image: NDArray[np.uint8]) -> int:
        """See Projector. A halt ends the wait; the flip happens all the same."""
        self._latest = self._take("show", image)
        kinds = self._begin("show")
        period = NS / self._o.refresh_hz
        told = round(self._o.latency_ms * 1e6)
        hidden = round(self._o.hidden_latency_ms * 1e6)
        late = round(period) if Fault.LATE_FLIP in kinds else 0
        with self.bench.lock:  # no frame that ends before `now` is still to be exposed
            count = math.floor((self.clock.now_ns() - self._epoch) / period) + 1
            flip = self._epoch + round(count * period)
            self._line.cut(self.clock.now_ns())
            self._shown.change(flip + told + hidden + late, self._latest)
        self.clock.wait_until(flip, self._halted)
        return flip + told

    def _take(self, phase: str, image: NDArray[np.uint8]) -> _Shown:
        shape = (self._o.height, self._o.width)
        if image.shape != shape or image.dtype != np.uint8:
            raise DeviceRefused(
                self.name,
                phase,
                f"an image of {image.shape} {image.dtype}, not {shape} uint8",
                "draw it for the size in info()",
            )
        key = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
        if self._latest is not None and self._latest.key == key:
            return self._latest
        return _Shown(key, image.copy())

    def load(
        self, images: Sequence[NDArray[np.uint8]], exposure_us: float, period_us: float
    ) -> LoadedSequence:
        """See Projector."""
        shortest, longest = SEQUENCE.period_us
        for problem, remedy in (
            (not 0 < len(images) <= SEQUENCE.images, f"1 to {SEQUENCE.images} images"),
            (not shortest <= period_us <= longest, f"a period of {shortest:g} to {longest:g} us"),
            (not 0 < exposure_us <= period_us, "an exposure no longer than the period"),
        ):
            if problem:
                raise DeviceRefused(
                    self.name,
                    "load",
                    f"{len(images)} images lit for {exposure_us:g} of {period_us:g} us",
                    f"give {remedy}",
                )
        shown = tuple(self._take("load", image) for image in images)
        self._begin("load")
        self._darken()
        loaded = LoadedSequence(len(images), exposure_us, period_us)
        self._loaded = (loaded, shown)
        return loaded

    def run(self) -> int:
        """See Projector. Light follows its pulse by `hidden_latency_ms`, as by a late flip."""
        kinds = self._begin("run")
        if self._loaded is None:
            raise DeviceRefused(self.name, "run", "no sequence is loaded", "load one first")
        loaded, shown = self._loaded
        self._darken()
        period, lit = loaded.period_us * 1e3, round(loaded.exposure_us * 1e3)
        hidden = round(self._o.hidden_latency_ms * 1e6)
        hidden += round(period) if Fault.LATE_FLIP in kinds else 0
        with self.bench.lock:
            start = self.clock.now_ns() + START_NS
            pulses = [start + round(k * period) for k in range(len(shown))]
            for pulse, image in zip(pulses, shown, strict=True):
                self._shown.change(pulse + hidden, image)
                self._shown.change(pulse + hidden + lit, None)
            self._line.fire(pulses)
        return start

    def stop(self) -> None:
        """See Projector."""
        self._begin("stop")
        self._darken()

    def safe(self) -> None:
        """See Device: the lamp off."""
        self._begin("safe")
        self._darken()

    def close(self) -> None:
        """See Device."""
        self._connected = False
        self._loaded = None
        self._darken()

    def _darken(self) -> None:
        with self.bench.lock:
            self._line.cut(self.clock.now_ns())
            self._shown.change(self.clock.now_ns(), None)

    # ------------------------------------------------------------ as a source on the bench

    @property
    def pinhole(self) -> Pinhole:
        """See Source."""
        return self._pinhole

    @property
    def strength(self) -> float:
        """See Source."""
        return 1.0

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
