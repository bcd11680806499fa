"""Cameras that Linux's own V4L2 drives (extra `v4l2`): UVC webcams, sensor boards, frame grabbers.

Timestamps are the kernel's, of the frame's start or end as the driver says. V4L2 has no common
triggers: where a driver has some as controls, the options name these. See drivers/streaming.py
for states and retry policy.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from linuxpy.video import raw
from numpy.typing import NDArray

from drivers import imagefile
from drivers.base.camera import Acquisition, CameraInfo, CameraSettings
from drivers.base.device import Context, Identity
from drivers.base.errors import (
    DeviceError,
    DeviceGarbled,
    DeviceLost,
    DeviceRefused,
    DeviceTimeout,
    OutOfRange,
)
from drivers.imagefile import BadImage
from drivers.streaming import Buffer, StreamingCamera, StreamingOptions
from drivers.unpack import Layout
from drivers.v4l2formats import LAYOUTS, reordered
from drivers.v4l2node import Kernel, Node, Rectangle

BY_ID = Path("/dev/v4l/by-id")

# Controls by the names that v4l2-ctl prints; the first that there is.
EXPOSURE = ("exposure_time_absolute", "exposure_absolute")  # in 100 us
GAIN = ("gain", "analogue_gain")
MANUAL = {  # a frame must depend on the light and on nothing else
    "auto_exposure": raw.ExposureAutoType.MANUAL.value,
    "exposure_auto": raw.ExposureAutoType.MANUAL.value,
    "exposure_dynamic_framerate": 0,
    "exposure_auto_priority": 0,
    "gain_automatic": 0,
    "white_balance_automatic": 0,
    "white_balance_temperature_auto": 0,
    "focus_automatic_continuous": 0,
    "focus_auto": 0,
}


class V4l2Options(StreamingOptions, frozen=True, kw_only=True):
    """Keys of a `driver = "v4l2"` camera."""

    path: str  # /dev/v4l/by-id/...: a name that stays the same after a replug
    pixel_format: str = ""  # V4L2's four letters: GREY, Y12P, RG10, YUYV, MJPG; "": as it is
    size: tuple[int, int] | None = None  # one of the camera's frame sizes
    controls: dict[str, int] = msgspec.field(default_factory=dict)  # others, by v4l2-ctl's names
    trigger_control: str = ""  # the control that makes the camera wait for pulses
    trigger_on: int = 1
    trigger_off: int = 0
    software_trigger: str = ""  # the control that, once written, is a pulse


class V4l2Camera(StreamingCamera):
    """A V4L2 capture device with memory-mapped buffers."""

    options_type = V4l2Options
    options: V4l2Options

    def __init__(
        self, name: str, options: V4l2Options, context: Context, kernel: Kernel | None = None
    ) -> None:
        super().__init__(name, options, context)
        self._kernel = kernel or Kernel()
        self._node_or_none: Node | None = None
        self._controls: dict[str, Any] = {}
        self._code = ""
        self._stride = 0

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device. Looks where udev gives lasting names."""
        kernel, found = Kernel(), []
        for path in map(str, sorted(BY_ID.glob("*")) if BY_ID.is_dir() else []):
            try:
                node = Node(kernel, path)
            except PermissionError as error:
                raise DeviceRefused(
                    path, "discover", "no permission", "join the group `video`"
                ) from error
            try:
                facts = node.capability()
            finally:
                node.close()
            if facts.device_caps & raw.Capability.VIDEO_CAPTURE.value:
                found.append(
                    {
                        "model": facts.card.decode(errors="replace"),
                        "serial": kernel.serial(path),
                        "options": {"driver": "v4l2", "path": path},
                    }
                )
        return found

    def check(self) -> None:
        """Ask the driver what it is."""
        self._connected("check")
        with self._errors("check"):
            self._node.capability()

    def facts(self) -> dict[str, Any]:
        """See StreamingCamera; the pixel format by V4L2's own name too."""
        return super().facts() | {"pixel_format": self._code}

    # ------------------------------------------------------------ opening

    def _open(self) -> Identity:
        options = self.options
        node = self._node_or_none = Node(self._kernel, options.path)
        facts = node.capability()
        needed = raw.Capability.VIDEO_CAPTURE.value | raw.Capability.STREAMING.value
        if facts.device_caps & needed != needed:
            raise self._refused(
                "connect",
                f"{options.path} does not stream pictures",
                "name its node with `index0`",
            )
        self._controls = node.controls()
        for name, value in MANUAL.items():
            if name in self._controls:
                node.set(self._controls[name], value)
        for name, value in options.controls.items():
            node.set(self._checked(name, value, "connect"), value)
        for name in filter(None, (options.trigger_control, options.software_trigger)):
            self._control((name,), "connect")
        code, size, _ = node.format()
        if options.pixel_format:
            code = options.pixel_format.ljust(4)
        if code not in LAYOUTS:
            raise self._refused(
                "connect",
                f"pixel format {code} is unknown",
                f"set `pixel_format` to one of {', '.join(self._codes())}",
            )
        self._set_format(code, options.size or size, "connect")
        return Identity(
            facts.card.decode(errors="replace"),
            self._kernel.serial(options.path),
            facts.driver.decode(errors="replace"),
        )

    def _release(self) -> None:
        node, self._node_or_none = self._node_or_none, None
        if node is not None:
            node.close()

    @property
    def _node(self) -> Node:
        if self._node_or_none is None:
            raise self._refused(
                "use",
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        return self._node_or_none

    # ------------------------------------------------------------ settings

    def _apply(self, wanted: CameraSettings, phase: str) -> None:
        settings = []
        if wanted.exposure_us is not None:
            name, value = self._control(EXPOSURE, phase), round(wanted.exposure_us / 100)
            settings.append((self._checked(name, value, phase), value))
        if wanted.gain is not None:
            name, value = self._control(GAIN, phase), round(wanted.gain)
            settings.append((self._checked(name, value, phase), value))
        code = self._code
        if wanted.pixel_format not in {None, self._layout().pixel_format}:
            code = self._code_for(wanted, phase)
        if wanted.frame_rate_hz is not None:
            self._set_rate(wanted.frame_rate_hz, phase)
        size = self._roi()[2:]
        cropped = wanted.roi is not None and wanted.roi != self._roi()
        if wanted.roi is not None and cropped:
            self._set_crop(wanted.roi, phase)
            size = wanted.roi[2:]
        if cropped or (code, size) != (self._code, self._roi()[2:]):
            self._set_format(code, size, phase)
        for control, value in settings:
            self._node.set(control, value)

    def _code_for(self, wanted: CameraSettings, phase: str) -> str:
        """The format that gives what is wanted, plain rather than packed or decoded."""
        there = self._codes()
        fitting = [c for c in there if LAYOUTS[c].pixel_format is wanted.pixel_format]
        if not fitting:
            have = ", ".join(sorted({LAYOUTS[c].pixel_format for c in there}))
            raise self._refused(
                phase, f"it has no pixel format {wanted.pixel_format}", f"choose of {have}"
            )
        return min(fitting, key=list(LAYOUTS).index)

    def _codes(self) -> list[str]:
        """The camera's formats that can be used."""
        return [code for code in self._node.codes() if code in LAYOUTS]

    def _set_format(self, code: str, size: tuple[int, int], phase: str) -> None:
        """Set this format, or the same with the colours in the order that the camera has them in:
        where a mosaic begins depends on the region's corner."""
        there = self._codes()
        if code not in there:
            code = next((other for other in reordered(code) if other in there), code)
        nearest = self._node.set_format(code, size)  # V4L2 would take what is near, silently
        if nearest != (code, size):
            (near_code, near) = nearest
            raise self._refused(
                phase,
                f"{size[0]} x {size[1]} {code} is not possible, it would be "
                f"{near[0]} x {near[1]} {near_code}",
                f"choose another size, or of the formats {', '.join(self._codes())}",
            )
        self._code, _, self._stride = self._node.format()

    def _roi(self) -> Rectangle:
        _, size, _ = self._node.format()
        crop = self._node.crop()
        return (*(crop[:2] if crop else (0, 0)), *size)

    def _set_crop(self, roi: Rectangle, phase: str) -> None:
        before = self._node.crop()
        if before is None:
            raise self._refused(phase, "it has no region of interest", "choose a `size`")
        got = self._node.set_crop(roi)
        if got != roi:
            self._node.set_crop(before)
            raise self._refused(
                phase, f"roi {list(roi)} is not possible", f"the nearest is {list(got)}"
            )

    def _set_rate(self, rate_hz: float, phase: str) -> None:
        before = self._node.rate()
        got = self._node.set_rate(rate_hz) if before and rate_hz > 0 else before
        if not 0.99 * rate_hz <= got <= 1.01 * rate_hz:
            if before:
                self._node.set_rate(before)
            raise self._refused(
                phase,
                f"frame rate {rate_hz:g} Hz is not possible at this size",
                f"the nearest is {got:g}" if before else "leave it out",
            )

    def _control(self, names: tuple[str, ...], phase: str) -> str:
        """The first of these controls that it has."""
        there = next((name for name in names if name in self._controls), "")
        if not there:
            have = ", ".join(sorted(self._controls))
            raise self._refused(phase, f"it has no control {names[0]}", f"it has: {have}")
        return there

    def _checked(self, name: str, value: int, phase: str) -> Any:
        """The control that can take this value."""
        control = self._controls[self._control((name,), phase)]
        if not control.minimum <= value <= control.maximum:
            raise OutOfRange(
                self.name,
                phase,
                f"{name} {value} is out of range",
                f"choose {control.minimum} to {control.maximum}",
            )
        return control

    def _layout(self) -> Layout:
        return LAYOUTS[self._code]

    def _read(self) -> tuple[CameraInfo, CameraSettings]:
        node, options = self._node, self.options
        exposure = next((c for name in EXPOSURE if (c := self._controls.get(name))), None)
        gain = next((c for name in GAIN if (c := self._controls.get(name))), None)
        rate, roi, pixel_format = node.rate(), self._roi(), self._layout().pixel_format
        settings = CameraSettings(
            exposure_us=node.get(exposure) * 100.0 if exposure else None,
            gain=float(node.get(gain)) if gain else None,
            pixel_format=pixel_format,
            frame_rate_hz=rate or None,
            roi=roi,
        )
        software = ("software",) if options.software_trigger else ()
        hardware = ("hardware",) if options.trigger_control else ()
        limits = (exposure.minimum * 100.0, exposure.maximum * 100.0) if exposure else (0.0, 0.0)
        info = CameraInfo(
            width=roi[2],
            height=roi[3],
            pixel_format=pixel_format,
            black_level=options.black_level,
            exposure_range_us=limits,
            gain_range=(float(gain.minimum), float(gain.maximum)) if gain else None,
            max_rate_hz=rate,
            triggers=(*software, *hardware, "none"),
        )
        return info, settings

    # ------------------------------------------------------------ acquisition

    def _arm(self, acquisition: Acquisition) -> None:
        if self.options.trigger_control:
            free = acquisition is Acquisition.FREE
            value = self.options.trigger_off if free else self.options.trigger_on
            self._node.set(self._controls[self.options.trigger_control], value)

    def _begin(self) -> None:
        self._node.stream(self.options.buffers)

    def _fire(self) -> None:
        self._node.set(self._controls[self.options.software_trigger], 1)

    def _next(self, timeout_s: float) -> Buffer | None:
        node, info = self._node, self.info()
        taken = node.take(timeout_s)
        if taken is None:
            return None
        buffer, data = taken
        return Buffer(
            data=data,
            width=info.width,
            height=info.height,
            block_id=int(buffer.sequence),
            device_ns=self._start_ns(buffer),
            release=lambda: node.give_back(buffer.index),
            stride=self._stride or None,
            incomplete=bool(buffer.flags & raw.BufferFlag.ERROR.value),
        )

    def _end(self) -> None:
        if self._node_or_none is not None:
            self._node_or_none.end()

    def _still_there(self, phase: str) -> None:
        del phase  # `_errors` says it
        self._node.capability()

    def _start_ns(self, buffer: Any) -> int:
        """The start of the exposure on the kernel's monotonic clock; 0 if it used another."""
        monotonic = raw.BufferFlag.TIMESTAMP_MONOTONIC.value
        if buffer.flags & raw.BufferFlag.TIMESTAMP_MASK.value != monotonic:
            return 0
        stamp = int(buffer.timestamp.secs) * 1_000_000_000 + int(buffer.timestamp.usecs) * 1000
        source = buffer.flags & raw.BufferFlag.TSTAMP_SRC_MASK.value
        if source == raw.BufferFlag.TSTAMP_SRC_SOE.value:
            return stamp
        return stamp - self._exposure_ns - round(self.info().readout_s * 1e9)

    def _synchronise(self) -> bool:
        """The kernel's clock can be read: no latching, no guessing."""
        self._time.forget()
        self._time.observe(time.monotonic_ns(), self.clock.now_ns())
        return True

    def _unpack(self, buffer: Buffer, out: NDArray[Any]) -> None:
        if buffer.incomplete or self._code not in {"YUYV", "MJPG"}:
            super()._unpack(buffer, out)
            return
        info = self.info()
        try:
            if self._code == "MJPG":
                image = imagefile.decode(buffer.data.tobytes())
            else:
                line = self._stride or 2 * info.width
                rows = buffer.data[: line * info.height].reshape(info.height, line)
                pairs = np.ascontiguousarray(rows[:, : 2 * info.width])
                pairs = pairs.reshape(info.height, info.width, 2)
                image = np.asarray(cv2.cvtColor(pairs, cv2.COLOR_YUV2RGB_YUYV))
            np.copyto(out, image)
        except (BadImage, ValueError) as error:
            raise DeviceGarbled(
                self.name, "grab", f"a {self._code} frame is broken: {error}", "grab again"
            ) from error

    @contextlib.contextmanager
    def _errors(self, phase: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            kind, remedy = _MEANING.get(
                error.errno or 0, (DeviceRefused, "choose another value, or connect again")
            )
            raise kind(
                self.name, phase, f"{self.options.path}: {error.strerror}", remedy
            ) from error


_MEANING: dict[int, tuple[type[DeviceError], str]] = {
    errno.ENOENT: (DeviceLost, "plug it in, and check `path`"),
    errno.ENODEV: (DeviceLost, "it was unplugged: plug it in, then connect again"),
    errno.ENXIO: (DeviceLost, "it was unplugged: plug it in, then connect again"),
    errno.EIO: (DeviceLost, "check its cable, then connect again"),
    errno.ENOSPC: (DeviceRefused, "too little USB bandwidth: another port, a smaller size or rate"),
    errno.EACCES: (DeviceRefused, "join the group `video`"),
    errno.EPERM: (DeviceRefused, "join the group `video`"),
    errno.EBUSY: (DeviceRefused, "close the other program that uses it"),
    errno.ETIMEDOUT: (DeviceTimeout, "try again"),
}
