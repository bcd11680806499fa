"""What all GenICam cameras share: the Standard Features Naming Convention (SFNC), spoken once.

pylon, Aravis and GenTL reach a camera's features by the same names; a driver adds how a feature
is read and written (`Nodes`) and how buffers are had. Older cameras' names are understood too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Literal

import msgspec
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, CameraInfo, CameraSettings
from drivers.base.device import Context, Identity
from drivers.base.errors import DeviceGarbled, OutOfRange
from drivers.base.pixelformat import PixelFormat
from drivers.clock import NS
from drivers.streaming import Buffer, StreamingCamera, StreamingOptions
from drivers.unpack import Layout, Packing, layout_of

LATCH_EVERY_NS = 10 * NS  # clocks 50 ppm apart: 0.5 ms

Value = bool | int | float | str

# Where a camera has both names, the old one is its own and the other an alias for new programs.
EXPOSURE = ("ExposureTimeAbs", "ExposureTime")
GAIN = ("GainAbs", "Gain", "GainRaw")
GAIN_DB = ("GainAbs", "Gain")  # raw steps are each vendor's own
RATE = ("AcquisitionFrameRateAbs", "AcquisitionFrameRate")
RATE_ENABLE = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
RESULTING_RATE = ("AcquisitionResultingFrameRate", "ResultingFrameRate", "ResultingFrameRateAbs")
LATCHES = (
    ("TimestampLatch", "TimestampLatchValue"),
    ("GevTimestampControlLatch", "GevTimestampValue"),
)
READOUT = ("SensorReadoutTime", "ReadoutTime", "ReadoutTimeAbs")


class SfncOptions(StreamingOptions, frozen=True, kw_only=True):
    """Keys that every GenICam camera understands."""

    pixel_format: str = ""  # any name that the camera has: Mono12p, BayerRG8; "": as it is
    trigger_line: str = "Line1"
    trigger_edge: Literal["rising", "falling"] = "rising"
    features: dict[str, Value] = msgspec.field(default_factory=dict)  # others, set at connect


class Nodes(ABC):
    """A camera's features by name; exceptions are the library's own."""

    @abstractmethod
    def has(self, name: str) -> bool:
        """Whether the camera has the feature now."""

    @abstractmethod
    def get(self, name: str) -> Value:
        """Its value."""

    @abstractmethod
    def set(self, name: str, value: Value) -> None:
        """Give it a value."""

    @abstractmethod
    def range(self, name: str) -> tuple[float, float, float]:
        """A number's smallest and largest value and its step (0: none)."""

    @abstractmethod
    def entries(self, name: str) -> tuple[str, ...]:
        """The values that an enumeration may have now; () for what is none."""

    @abstractmethod
    def code(self, name: str) -> int:
        """An enumeration's value as a number: of PixelFormat, the code that frames carry."""

    @abstractmethod
    def execute(self, name: str) -> None:
        """Run a command."""

    def ensure(self, name: str, value: Value) -> None:
        """Give it a value unless it has it: some cannot be written because they have no choice."""
        if self.get(name) != value:
            self.set(name, value)

    def first(self, names: tuple[str, ...]) -> str:
        """The first of these names that the camera has; "" if none."""
        return next((name for name in names if self.has(name)), "")

    def number(self, names: tuple[str, ...]) -> float | None:
        """The value of the first of these names; None if the camera has none."""
        name = self.first(names)
        return float(self.get(name)) if name else None


class SfncCamera(StreamingCamera):
    """A GenICam camera. `nodes` is set by the driver's `_attach`, gone after `_release`."""

    options_type = SfncOptions
    options: SfncOptions

    def __init__(self, name: str, options: SfncOptions, context: Context) -> None:
        super().__init__(name, options, context)
        self._nodes_or_none: Nodes | None = None
        self._native = ""  # the pixel format's name in the camera
        self._code = 0  # and its number
        self._tick_ns = 1.0  # of the camera's clock
        self._latch: tuple[str, str] | None = None  # the command and where its result is
        self._latched_ns: int | None = None

    @abstractmethod
    def _attach(self) -> tuple[Nodes, Identity]:
        """Open the camera that the options name."""

    def check(self) -> None:
        """Read a feature from the camera."""
        with self._errors("check"):
            self._nodes("check").get("Width")

    def facts(self) -> dict[str, Any]:
        """See StreamingCamera; the pixel format by the camera's own name too."""
        return super().facts() | {"pixel_format": self._native}

    def _nodes(self, phase: str) -> Nodes:
        if self._nodes_or_none is None:
            raise self._refused(
                phase,
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        return self._nodes_or_none

    # ------------------------------------------------------------ opening

    def _open(self) -> Identity:
        nodes, identity = self._attach()
        self._nodes_or_none = nodes
        self._manual(nodes)
        for name, value in self.options.features.items():
            self._set_checked(nodes, name, value)
        if self.options.pixel_format:
            self._set_checked(nodes, "PixelFormat", self.options.pixel_format)
        self._native = self._usable_format(nodes)
        frequency = nodes.number(("GevTimestampTickFrequency",))
        self._tick_ns = NS / frequency if frequency else 1.0
        self._latch = next((pair for pair in LATCHES if all(map(nodes.has, pair))), None)
        return identity

    def _manual(self, nodes: Nodes) -> None:
        """A frame must depend on the light and on nothing else."""
        for name in ("ExposureAuto", "GainAuto", "BalanceWhiteAuto", "BlackLevelAuto"):
            if nodes.has(name) and "Off" in nodes.entries(name):
                nodes.ensure(name, "Off")
        if nodes.has("GammaEnable"):
            nodes.ensure("GammaEnable", False)
        elif nodes.has("Gamma"):
            nodes.ensure("Gamma", 1.0)
        if nodes.has("ExposureMode") and "Timed" in nodes.entries("ExposureMode"):
            nodes.ensure("ExposureMode", "Timed")

    def _set_checked(self, nodes: Nodes, name: str, value: Value) -> None:
        if not nodes.has(name):
            raise self._refused("connect", f"it has no feature {name}", "correct or remove it")
        if isinstance(value, str):
            entries = nodes.entries(name)
            if entries and value not in entries:
                raise self._refused(
                    "connect", f"{name} cannot be {value}", f"choose of {', '.join(entries)}"
                )
        elif not isinstance(value, bool):
            self._in_range(nodes, name, value, "connect")
        nodes.set(name, value)

    def _usable_format(self, nodes: Nodes) -> str:
        """The pixel format in force, or the first that can be used if that one cannot."""
        native = self._format_in_force(nodes)
        if layout_of(native) is None:
            usable = self._layouts(nodes)
            if not usable:
                raise self._refused(
                    "connect",
                    f"it has none but unknown pixel formats: {native}",
                    "use its vendor's tool to convert",
                )
            nodes.set("PixelFormat", next(iter(usable)))
            native = self._format_in_force(nodes)
        return native

    def _format_in_force(self, nodes: Nodes) -> str:
        """What the camera says now: the mosaic's first pixel may move with the region's corner."""
        native = str(nodes.get("PixelFormat"))
        self._code = nodes.code("PixelFormat")
        return native

    # ------------------------------------------------------------ settings

    def _apply(self, wanted: CameraSettings, phase: str) -> None:
        nodes = self._nodes(phase)
        if wanted.frame_rate_hz is not None:
            self._limit_rate(nodes, on=True)  # some cameras hide the rate unless it is limited
        numbers: list[tuple[str, float]] = []
        for value, names in (
            (wanted.exposure_us, EXPOSURE),
            (wanted.gain, GAIN),
            (wanted.frame_rate_hz, RATE),
        ):
            if value is None:
                continue
            node = nodes.first(names)
            if not node:
                raise self._refused(phase, f"it has no {names[-1]}", "leave it out")
            self._in_range(nodes, node, value, phase)
            numbers.append((node, value))
        if wanted.pixel_format is not None:
            self._native_for(nodes, wanted.pixel_format, phase)
        if wanted.roi is not None:
            self._check_roi(nodes, wanted.roi, phase)
            self._to_corner(nodes)
            self._native = self._format_in_force(nodes)
        if wanted.pixel_format is not None:
            native = self._native_for(nodes, wanted.pixel_format, phase)
            if native != self._native:
                nodes.set("PixelFormat", native)
        if wanted.roi is not None:
            self._set_roi(nodes, wanted.roi)
        for node, value in numbers:
            nodes.set(node, value)
        self._native = self._usable_format(nodes)

    def _in_range(self, nodes: Nodes, node: str, value: float, phase: str) -> None:
        low, high, _ = nodes.range(node)
        if not low <= value <= high:
            raise OutOfRange(
                self.name, phase, f"{node} {value:g} is out of range", f"choose {low:g} to {high:g}"
            )

    def _layouts(self, nodes: Nodes) -> dict[str, Layout]:
        found = {name: layout_of(name) for name in nodes.entries("PixelFormat")}
        return {name: layout for name, layout in found.items() if layout is not None}

    def _native_for(self, nodes: Nodes, wanted: PixelFormat, phase: str) -> str:
        """The camera's name for the wanted format: the one in force, or else unpacked, if it has
        several."""
        layouts = self._layouts(nodes)
        fitting = [n for n, layout in layouts.items() if layout.pixel_format is wanted]
        if not fitting:
            have = ", ".join(sorted({layout.pixel_format for layout in layouts.values()}))
            raise self._refused(phase, f"it has no pixel format {wanted}", f"choose of {have}")
        order = list(Packing)
        return min(fitting, key=lambda n: (n != self._native, order.index(layouts[n].packing), n))

    def _check_roi(self, nodes: Nodes, roi: tuple[int, int, int, int], phase: str) -> None:
        for offset, size, at, length in (
            ("OffsetX", "Width", roi[0], roi[2]),
            ("OffsetY", "Height", roi[1], roi[3]),
        ):
            low, high, step = nodes.range(size)
            movable = nodes.has(offset)
            # The size's maximum shrinks as the offset grows.
            whole = nodes.number((f"{size}Max", f"Sensor{size}"))
            if whole is None:
                whole = high + (float(nodes.get(offset)) if movable else 0)
            if not low <= length <= whole or (step > 1 and (length - low) % step):
                raise OutOfRange(
                    self.name,
                    phase,
                    f"{size} {length} is not possible",
                    f"choose {low:g} to {whole:g} in steps of {max(1, step):g}",
                )
            last = whole - length if movable else 0
            grid = max(1, nodes.range(offset)[2]) if movable else 1
            if not 0 <= at <= last or at % grid:
                raise OutOfRange(
                    self.name,
                    phase,
                    f"{offset} {at} is not possible with {size} {length}",
                    f"choose 0 to {last:g} in steps of {grid:g}",
                )

    def _to_corner(self, nodes: Nodes) -> None:
        """Offsets limit the size, and odd ones may change the mosaic's name."""
        for name in ("OffsetX", "OffsetY"):
            if nodes.has(name):
                nodes.set(name, 0)

    def _set_roi(self, nodes: Nodes, roi: tuple[int, int, int, int]) -> None:
        """From the corner to a region."""
        x, y, width, height = roi
        for name, value in (("Width", width), ("Height", height), ("OffsetX", x), ("OffsetY", y)):
            if value or nodes.has(name):
                nodes.set(name, value)

    def _limit_rate(self, nodes: Nodes, *, on: bool) -> None:
        name = nodes.first(RATE_ENABLE)
        if name:
            nodes.set(name, on)

    def _layout(self) -> Layout:
        layout = layout_of(self._native)
        assert layout is not None  # _usable_format and _native_for give no other
        return layout

    def _read(self) -> tuple[CameraInfo, CameraSettings]:
        nodes = self._nodes("configure")
        pixel_format = self._layout().pixel_format
        x, y, width, height = (
            int(nodes.number((name,)) or 0) for name in ("OffsetX", "OffsetY", "Width", "Height")
        )
        settings = CameraSettings(
            exposure_us=nodes.number(EXPOSURE),
            gain=nodes.number(GAIN),
            pixel_format=pixel_format,
            frame_rate_hz=nodes.number(RATE),
            roi=(x, y, width, height),
        )
        exposure = nodes.first(EXPOSURE)
        low, high, _ = nodes.range(exposure) if exposure else (0.0, 0.0, 0.0)
        gain = nodes.first(GAIN)
        info = CameraInfo(
            width=width,
            height=height,
            pixel_format=pixel_format,
            black_level=self.options.black_level,
            exposure_range_us=(low, high),
            gain_range=nodes.range(gain)[:2] if gain else None,
            gain_unit="dB" if gain in GAIN_DB else "",
            max_rate_hz=nodes.number(RESULTING_RATE) or settings.frame_rate_hz or 0.0,
            readout_s=(nodes.number(READOUT) or 0.0) / 1e6,
            triggers=self._triggers(nodes),
        )
        return info, settings

    def _triggers(self, nodes: Nodes) -> tuple[str, ...]:
        sources = nodes.entries("TriggerSource") if nodes.has("TriggerSource") else ()
        triggers = ["none"]
        if self.options.trigger_line in sources:
            triggers.insert(0, "hardware")
        if "Software" in sources and nodes.has("TriggerSoftware"):
            triggers.insert(0, "software")
        return tuple(triggers)

    # ------------------------------------------------------------ acquisition

    def _arm(self, acquisition: Acquisition) -> None:
        nodes = self._nodes("start")
        if nodes.has("AcquisitionMode"):
            nodes.ensure("AcquisitionMode", "Continuous")
        free = acquisition is Acquisition.FREE
        rate = self._wanted.frame_rate_hz or self.options.frame_rate_hz
        self._limit_rate(nodes, on=free and rate is not None)
        if not nodes.has("TriggerMode"):
            return  # free-running only
        if nodes.has("TriggerSelector"):
            for selector in nodes.entries("TriggerSelector"):
                nodes.ensure("TriggerSelector", selector)
                if nodes.has("TriggerMode"):
                    nodes.ensure("TriggerMode", "Off")
            nodes.ensure("TriggerSelector", "FrameStart")
        if free:
            nodes.ensure("TriggerMode", "Off")
            return
        hardware = acquisition is Acquisition.HARDWARE
        nodes.ensure("TriggerSource", self.options.trigger_line if hardware else "Software")
        if hardware and nodes.has("TriggerActivation"):
            rising = self.options.trigger_edge == "rising"
            nodes.ensure("TriggerActivation", "RisingEdge" if rising else "FallingEdge")
        nodes.ensure("TriggerMode", "On")

    def _unpack(self, buffer: Buffer, out: NDArray[Any]) -> None:
        if buffer.pixel_code not in {None, self._code} and not buffer.incomplete:
            raise DeviceGarbled(
                self.name,
                "grab",
                f"a frame with pixel format {buffer.pixel_code:#010x} came; it was set to "
                f"{self._native}, {self._code:#010x}",
                "does another program control it? connect again",
            )
        super()._unpack(buffer, out)

    def _fire(self) -> None:
        self._nodes("trigger").execute("TriggerSoftware")

    # ------------------------------------------------------------ time

    def _run(self) -> None:
        self._latched_ns = None
        super()._run()

    def _synchronise(self) -> bool:
        """Latch the camera's clock now and then, where it can be."""
        now = self.clock.now_ns()
        if self._latched_ns is not None and now - self._latched_ns < LATCH_EVERY_NS:
            return True
        if self._latch is None:
            return False
        command, value = self._latch
        nodes = self._nodes("clock")
        before = self.clock.now_ns()
        nodes.execute(command)
        after = self.clock.now_ns()
        self._time.forget()  # neither delayed nor old: better than any pair before
        self._time.observe(round(float(nodes.get(value)) * self._tick_ns), (before + after) // 2)
        self._latched_ns = after
        return True
