"""What all cameras that hand out buffers share: halting, late and incomplete frames, times.

A driver says how its camera is opened, set, armed and read; this module makes a Camera of it.
Life and settings are those of drivers/attached.py.

    acquiring ──halt──> halted ──start, stop──> acquiring, idle

Retry policy. `configure`, `start`, `stop` and `check` may be sent again. `trigger` may not: the
camera may have exposed. When a triggered frame did not come, the acquisition is restarted before
the next trigger, so that a late frame is never taken for the next one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.attached import AttachedCamera
from drivers.base.camera import Acquisition, CameraInfo, CameraSettings, Frame
from drivers.base.device import Context, Options
from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceTimeout
from drivers.clock import NS
from drivers.devicetime import DeviceTime
from drivers.unpack import Layout, unpack

WRAP = 65535  # GigE Vision's frame ids go from 1 to this
HALT_SLICE_S = 0.02  # a wait inside a library cannot be woken: so long is it until `halt` is seen

T = TypeVar("T")


class StreamingOptions(Options, frozen=True, kw_only=True):
    """Keys that all these cameras understand, beside those that tell which camera it is."""

    exposure_us: float | None = None
    gain: float | None = None  # in the camera's own unit, mostly dB
    frame_rate_hz: float | None = None  # free-running
    roi: tuple[int, int, int, int] | None = None  # x, y, width, height
    black_level: float = 0.0  # nominal counts in the dark
    buffers: int = 8
    rolling_ms: float = 0.0  # of a rolling shutter: from the first row's exposure to the last's


@dataclass(frozen=True, slots=True)
class Buffer:
    """What a library handed out: flat bytes that are valid until `release`."""

    data: NDArray[np.uint8]
    width: int
    height: int
    block_id: int | None  # the camera's own count, GigE Vision's goes from 65535 to 1; None: unsaid
    device_ns: int  # on the camera's clock; 0: it has none
    release: Callable[[], None]
    stride: int | None = None  # bytes from row to row; None: rows follow without a gap
    incomplete: bool = False
    pixel_code: int | None = None  # the format's number as the frame itself has it; None: unsaid


class StreamingCamera(AttachedCamera):
    """See the module. A driver implements the methods below `what a driver adds`."""

    options_type: ClassVar[type[Options]] = StreamingOptions
    options: StreamingOptions

    def __init__(self, name: str, options: StreamingOptions, context: Context) -> None:
        super().__init__(name, options, context)
        self._incomplete = 0
        self._sequence = -1
        self._last_id: int | None = None
        self._time = DeviceTime()

    # ------------------------------------------------------------ what a driver adds

    @abstractmethod
    def _read(self) -> tuple[CameraInfo, CameraSettings]:
        """What is in force, asked from the camera."""

    @abstractmethod
    def _layout(self) -> Layout:
        """How its buffers are laid out; no I/O."""

    @abstractmethod
    def _arm(self, acquisition: Acquisition) -> None:
        """Say what makes it expose."""

    @abstractmethod
    def _begin(self) -> None:
        """Announce buffers and start streaming."""

    @abstractmethod
    def _fire(self) -> None:
        """Begin one exposure; returns when the camera has taken the command."""

    @abstractmethod
    def _next(self, timeout_s: float) -> Buffer | None:
        """The next buffer, None if there was none in time. Raises DeviceLost."""

    @abstractmethod
    def _end(self) -> None:
        """Stop streaming; buffers not fetched are forgotten. Idempotent."""

    def _synchronise(self) -> bool:
        """Pair the camera's clock with the rig's in `_time`; False if that takes frames."""
        return False

    def _ready(self) -> None:
        """Wait until the camera takes a trigger, where the library can tell."""

    def _still_there(self, phase: str) -> None:
        """Raise DeviceLost if no frame came because there is no camera any more."""

    def _only(self, fitting: Sequence[T], asked: str, serials: Iterable[object], remedy: str) -> T:
        """The one camera that fits what was `asked` for, of those with these serial numbers.

        Raises DeviceLost where there is none, DeviceRefused where there are several.
        """
        seen = ", ".join(map(str, serials)) or "none"
        if not fitting:
            raise DeviceLost(
                self.name, "connect", f"no camera {asked or 'at all'} (found: {seen})", remedy
            )
        if len(fitting) > 1:
            raise self._refused("connect", f"several cameras fit: {seen}", "name one by `serial`")
        return fitting[0]

    # ------------------------------------------------------------ what it is and is set to

    def facts(self) -> dict[str, Any]:
        """Identity, and how many frames came incomplete."""
        return {
            "model": self._identity.model,
            "serial": self._identity.serial,
            "incomplete": self._incomplete,
        }

    def _stated(self) -> CameraSettings:
        mine = self.options
        return CameraSettings(mine.exposure_us, mine.gain, None, mine.frame_rate_hz, mine.roi)

    def _take_in(self) -> None:
        """Ask what is in force. No camera says how its shutter rolls: the options do."""
        info, self._settings = self._read()
        self._info = replace(info, rolling_s=self.options.rolling_ms / 1e3)

    # ------------------------------------------------------------ acquisition

    def start(self, acquisition: Acquisition, at: int = 0) -> None:
        """See Camera; `at` is for recordings."""
        del at
        self._connected("start")
        self.stop()
        self._halted.clear()
        triggers = [t for t in self.info().triggers if t != "none"]
        if acquisition is not Acquisition.FREE and acquisition.value not in triggers:
            raise self._refused(
                "start",
                f"it has no {acquisition} trigger",
                f"it has {' and '.join(triggers)}" if triggers else "it can only run free",
            )
        with self._errors("start"):
            self._arm(acquisition)
            self._run()
        self._acquisition = acquisition

    def _run(self) -> None:
        self._triggered.clear()
        self._late = False
        self._sequence, self._last_id = -1, None
        self._time.forget()
        self._synchronise()
        self._begin()

    def trigger(self) -> tuple[int, int]:
        """See Camera: from before the command was sent to an exposure after it was taken."""
        self._connected("trigger")
        if self._acquisition is not Acquisition.SOFTWARE:
            raise self._refused("trigger", "it does not wait for software", "start it so")
        self._unless_halted("trigger")
        with self._errors("trigger"):
            if self._late:
                self._end()
                self._run()
            self._ready()
            before = self.clock.now_ns()
            self._fire()
        exposure = (before, self.clock.now_ns() + self._exposure_ns)
        self._triggered.append(exposure)
        return exposure

    def grab(self, out: NDArray[Any], timeout_s: float) -> Frame:
        """See Camera. Of an incomplete frame the pixels that did not come are anything."""
        info = self.info()
        if self._acquisition is None:
            raise self._refused("grab", "not started", "start it first")
        if out.shape != info.shape or out.dtype != info.pixel_format.dtype:
            raise self._refused(
                "grab",
                f"frames are {info.shape} {info.pixel_format.dtype}, "
                f"the buffer is {out.shape} {out.dtype}",
                "make the buffer from `info()`",
            )
        with self._errors("grab"):
            buffer = self._wait(timeout_s)
            now = self.clock.now_ns()
            try:
                self._unpack(buffer, out)
            finally:
                buffer.release()
            start, end = self._interval(buffer.device_ns, now)
        self._incomplete += buffer.incomplete
        return Frame(
            pixels=out,
            sequence=self._count(buffer.block_id),
            start_ns=start,
            end_ns=end,
            utc_ns=start + self.clock.utc_ns() - self.clock.now_ns(),
            exposure_us=self._settings.exposure_us or 0.0,
            gain=self._settings.gain or 0.0,
            incomplete=buffer.incomplete,
        )

    def stop(self) -> None:
        """See Camera."""
        if self._acquisition is None:
            return
        self._acquisition = None
        with self._errors("stop"):
            self._end()

    def _wait(self, timeout_s: float) -> Buffer:
        deadline = self.clock.now_ns() + round(timeout_s * NS)
        while True:
            self._unless_halted("grab")
            left = (deadline - self.clock.now_ns()) / NS
            buffer = self._next(min(max(left, 0.0), HALT_SLICE_S))
            if buffer is not None:
                return buffer
            if left <= 0:
                break
        self._still_there("grab")
        self._late = self._acquisition is Acquisition.SOFTWARE
        remedies = {
            Acquisition.SOFTWARE: "trigger again",
            Acquisition.HARDWARE: "check the trigger's wiring, line and edge",
        }
        remedy = remedies.get(self._acquisition or Acquisition.FREE, "check cable and bandwidth")
        raise DeviceTimeout(self.name, "grab", f"no frame within {timeout_s:g} s", remedy)

    def _unpack(self, buffer: Buffer, out: NDArray[Any]) -> None:
        info = self.info()
        problem = ""
        if (buffer.width, buffer.height) == (info.width, info.height):
            try:
                unpack(buffer.data, self._layout(), out, buffer.stride)
            except ValueError as error:
                problem = str(error)
        else:
            problem = f"a frame of {buffer.width} x {buffer.height} came"
        if problem and not buffer.incomplete:
            raise DeviceGarbled(
                self.name,
                "grab",
                f"{problem}; it was set to {info.width} x {info.height} {info.pixel_format}",
                "does another program control it? connect again",
            )

    def _count(self, block_id: int | None) -> int:
        """The frame's number since `start`, lost ones counted."""
        step = 1
        if block_id is not None and self._last_id is not None:
            step = block_id - self._last_id
            if step < -WRAP // 2:
                step += WRAP
        if block_id is not None:
            self._last_id = block_id
        elif self._last_id is not None:
            self._last_id = self._last_id % WRAP + 1 if self._last_id <= WRAP else self._last_id + 1
        self._sequence += max(step, 1)
        return self._sequence

    # ------------------------------------------------------------ time

    @property
    def _exposure_ns(self) -> int:
        return round((self._settings.exposure_us or 0.0) * 1000)

    def _interval(self, device_ns: int, now_ns: int) -> tuple[int, int]:
        """When the exposure of a frame that came now began and ended, by the best that is known:
        the camera's synchronised clock, our trigger, its clock against arrivals, the arrival."""
        triggered = self._triggered.popleft() if self._triggered else None
        length = self._exposure_ns
        if device_ns and self._synchronise():
            start = self._time.to_rig(device_ns)
            return start, start + length
        if triggered is not None:
            return triggered
        start = now_ns - length - round(self.info().readout_s * NS)
        if device_ns:
            self._time.observe(device_ns, start)
            start = self._time.to_rig(device_ns)
        return start, start + length
