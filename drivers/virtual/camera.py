"""A camera that looks at the virtual scene."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, Camera, CameraInfo, CameraSettings, Frame
from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceRefused, DeviceTimeout, OutOfRange
from drivers.clock import NS
from drivers.virtual.cameraoptions import EXPOSURE_US, GAIN_DB, CameraOptions
from drivers.virtual.device import VirtualDevice
from drivers.virtual.faults import Fault
from drivers.virtual.sensor import Sensor, Settings


@dataclass(frozen=True, slots=True)
class _Exposure:
    sequence: int
    start_ns: int
    end_ns: int


class VirtualCamera(VirtualDevice, Camera):
    """A camera that integrates the light of the bench, frame by frame: all rows at once, or, where
    its shutter rolls, the last one `rolling_ms` after the first.

    Software-triggered: an exposure begins `trigger_latency_us` after its trigger, or when the
    sensor is free. Hardware-triggered: the same after each pulse on the bench's line, but a pulse
    that finds the sensor exposing is not heard. Free-running: at `frame_rate_hz`. A frame that
    finds none of the `buffers` free is lost, and its sequence number with it. A frame whose light
    the bench has forgotten is `incomplete`. Gain in dB. `Sensor` makes counts of the light.

    `configure`, `start`, `stop`, `safe` and `check` are safe to send again; `trigger` is not.
    """

    options_type = CameraOptions
    main_act = "grab"

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, CameraOptions)
        self._o = options
        self._set = Settings(
            exposure_us=options.exposure_us,
            gain=options.gain,
            pixel_format=options.pixel_format,
            frame_rate_hz=options.frame_rate_hz,
            roi=(0, 0, options.width, options.height),
        )
        self._acquisition: Acquisition | None = None
        self._waiting: deque[_Exposure] = deque()  # exposed or being exposed, not yet grabbed
        self._heard = 0  # the last pulse on the trigger line that was looked at
        self._wake = threading.Event()  # the pulses have changed, or it was halted
        self._free = 0  # when the sensor can begin to expose
        self._started = 0
        self._next = 0  # sequence number
        self._last: tuple[NDArray[Any], Frame] | None = None
        self._sensor = Sensor(options, self.bench, self.clock.now_ns())

    # ------------------------------------------------------------ settings

    @property
    def _period_ns(self) -> int:
        """Between two frames: the sensor reads out a frame while it exposes the next."""
        fastest = max(self._set.exposure_us * 1e3, self._o.readout_ms * 1e6)
        if self._acquisition is Acquisition.FREE:
            return round(max(fastest, NS / self._set.frame_rate_hz))
        return round(fastest)

    def connect(self) -> Identity:
        """See Device. The scene is built here, where no frame's deadline waits for it."""
        identity = super().connect()
        self._sensor.prepare(self._set.layouts)
        return identity

    def info(self) -> CameraInfo:
        """See Camera."""
        fastest = max(self._set.exposure_us * 1e3, self._o.readout_ms * 1e6)
        return CameraInfo(
            self._set.roi[2],
            self._set.roi[3],
            self._set.pixel_format,
            black_level=self._sensor.black(self._set),
            exposure_range_us=EXPOSURE_US,
            gain_range=GAIN_DB,
            gain_unit="dB",
            max_rate_hz=NS / fastest,
            readout_s=self._o.readout_ms / 1e3,
            rolling_s=self._o.rolling_ms / 1e3 if self._o.rolling_told else 0.0,
            triggers=tuple(
                t for t in self._o.triggers if t != "hardware" or self.bench.line is not None
            ),
        )

    def facts(self) -> dict[str, Any]:
        """See Device."""
        return {
            "virtual": True,
            "full_well_e": self._o.full_well_e,
            "read_noise_e": self._o.read_noise_e,
            "seed": self._o.seed,
        }

    def settings(self) -> CameraSettings:
        """See Camera."""
        return CameraSettings(**asdict(self._set))

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """See Camera."""
        self._begin("configure")
        if self._acquisition is not None:
            raise self._refuse("configure", "it is acquiring", "stop it first")
        given = {k: v for k, v in asdict(wanted).items() if v is not None}
        new = replace(self._set, **given)
        for value, (low, high), what in (
            (new.exposure_us, EXPOSURE_US, "exposure in us"),
            (new.gain, GAIN_DB, "gain in dB"),
            (new.frame_rate_hz, (0.01, 1e4), "frame rate in Hz"),
        ):
            if not low <= value <= high:
                raise OutOfRange(
                    self.name,
                    "configure",
                    f"{what} {value:g}",
                    f"choose one from {low:g} to {high:g}",
                )
        x, y, width, height = new.roi
        fits = x >= 0 and y >= 0 and x + width <= self._o.width and y + height <= self._o.height
        if not (fits and width > 0 and height > 0):
            raise OutOfRange(
                self.name,
                "configure",
                f"roi {new.roi}",
                f"stay within {self._o.width} x {self._o.height}",
            )
        if new.pixel_format.bayer and (x % 2 or y % 2):
            raise OutOfRange(
                self.name, "configure", f"roi {new.roi}", "a mosaic begins at even x and y"
            )
        self._set = new
        return self.settings()

    def _refuse(self, phase: str, problem: str, remedy: str) -> DeviceRefused:
        return DeviceRefused(self.name, phase, problem, remedy)

    # ------------------------------------------------------------ acquisition

    def start(self, acquisition: Acquisition, at: int = 0) -> None:  # noqa: ARG002
        """See Camera."""
        self._begin("start")
        line = self.bench.line
        wanted = "none" if acquisition is Acquisition.FREE else acquisition.value
        if wanted not in self._o.triggers:
            raise self._refuse(
                "start", f"it has no {acquisition} mode", f"it has {', '.join(self._o.triggers)}"
            )
        if acquisition is Acquisition.HARDWARE:
            if line is None:
                raise self._refuse(
                    "start",
                    "nothing on the bench sends it triggers",
                    "use software triggers, or add a virtual projector",
                )
            with self.bench.lock:
                line.listeners.add(self._wake)
        self._waiting.clear()
        self._acquisition = acquisition
        self._next = 0
        self._started = self._free = self._heard = self.clock.now_ns()

    def trigger(self) -> tuple[int, int]:
        """See Camera. A trigger that comes before the sensor is free waits for it."""
        if self._acquisition is not Acquisition.SOFTWARE:
            raise self._refuse("trigger", "it waits for no trigger", "start it with SOFTWARE")
        kinds = self._begin("trigger")
        start = self.clock.now_ns() + round(self._o.trigger_latency_us * 1e3)
        start = max(start, self._free)
        end = start + round(self._set.exposure_us * 1e3)
        if Fault.DROP_TRIGGER not in kinds:
            self._free = max(end, start + self._period_ns)
            self._queue(start, end)
        return start, end

    def _queue(self, start: int, end: int) -> None:
        if len(self._waiting) < self._o.buffers:
            self._waiting.append(_Exposure(self._next, start, end))
        self._next += 1  # without a free buffer the frame is lost, its number used up

    def halt(self) -> None:
        """See Device."""
        super().halt()
        self._wake.set()

    def _await_pulse(self, deadline_ns: int) -> None:
        """Wait until a pulse has begun an exposure, for a halt, or for the deadline."""
        while not self._waiting:
            self._wake.clear()
            if self._halted.is_set():
                return
            planned = self._listen()
            if self._waiting or self.clock.now_ns() >= deadline_ns:
                return
            until = deadline_ns if planned is None else min(planned, deadline_ns)
            self.clock.wait_until(until, self._wake)

    def _listen(self) -> int | None:
        """Expose for each pulse up to now; gives the next one that is planned."""
        line = self.bench.line
        assert line is not None
        with self.bench.lock:
            now = self.clock.now_ns()
            while (pulse := line.after(self._heard)) is not None and pulse <= now:
                self._heard = pulse
                start = pulse + round(self._o.trigger_latency_us * 1e3)
                kinds = self.faults.strike("trigger", self._halted)
                kinds |= self.faults.strike("pulse", self._halted)
                missed = Fault.DROP_TRIGGER in kinds
                if missed or start < self._free:
                    continue
                self._expose_at(start)
                if Fault.FALSE_TRIGGER in kinds:
                    self._expose_at(self._free)
            return pulse

    def _expose_at(self, start: int) -> None:
        self._free = start + self._period_ns
        self._queue(start, start + round(self._set.exposure_us * 1e3))

    def _run(self) -> None:
        """Expose all that a free-running camera has exposed by now, and the one in the making;
        the next one, if there is no other to wait for."""
        period, exposure = self._period_ns, round(self._set.exposure_us * 1e3)
        due = (self.clock.now_ns() - self._started) // period
        while not self._waiting or (self._next <= due and len(self._waiting) < self._o.buffers):
            start = self._started + self._next * period
            self._queue(start, start + exposure)
        self._next = max(self._next, due)

    def grab(self, out: NDArray[Any], timeout_s: float) -> Frame:
        """See Camera."""
        if self._acquisition is None:
            raise self._refuse("grab", "it is not acquiring", "start it first")
        shape, dtype = self.info().shape, self._set.pixel_format.dtype
        if out.shape != shape or out.dtype != dtype:
            raise self._refuse(
                "grab", f"a buffer of {out.shape} {out.dtype}", f"give {shape} {dtype}"
            )
        kinds = self._begin("grab", timeout_s)
        if Fault.DUPLICATE_FRAME in kinds and self._last is not None:
            out[...] = self._last[0]
            return replace(self._last[1], pixels=out)
        deadline = self.clock.now_ns() + round(timeout_s * NS)
        if self._acquisition is Acquisition.FREE:
            self._run()
        elif self._acquisition is Acquisition.HARDWARE:
            self._await_pulse(deadline)
        if not self._waiting:
            halted = self.clock.wait_until(deadline, self._halted)
            raise self._late(halted, timeout_s, "was it triggered?")
        exposure = self._waiting[0]
        there = exposure.end_ns + round((self._o.readout_ms + self._o.rolling_ms) * 1e6)
        halted = self.clock.wait_until(min(there, deadline), self._halted)
        if halted or there > deadline:
            raise self._late(halted, timeout_s, "allow for the exposure and the readout")
        self._waiting.popleft()
        complete = self._sensor.expose(exposure.start_ns, exposure.end_ns, self._set, out)
        if Fault.TORN_FRAME in kinds and self._last is not None:
            out[: shape[0] // 2] = self._last[0][: shape[0] // 2]
        if Fault.INCOMPLETE_FRAME in kinds:
            out[shape[0] // 2 :] = 0
            complete = False
        utc = self.clock.utc_ns() - self.clock.now_ns() + exposure.start_ns
        frame = Frame(
            out,
            exposure.sequence,
            exposure.start_ns,
            exposure.end_ns,
            utc,
            self._set.exposure_us,
            self._set.gain,
            incomplete=not complete,
        )
        self._last = (out.copy(), frame)
        return frame

    def _late(self, halted: bool, timeout_s: float, remedy: str) -> DeviceTimeout:
        problem = "halted" if halted else f"no frame within {timeout_s:g} s"
        return DeviceTimeout(self.name, "grab", problem, remedy)

    def stop(self) -> None:
        """See Camera."""
        self._begin("stop")
        self._end()

    def safe(self) -> None:
        """See Device: stopped."""
        self._begin("safe")
        self._end()

    def close(self) -> None:
        """See Device."""
        self._connected = False
        self._end()

    def _end(self) -> None:
        self._acquisition = None
        self._waiting.clear()
        self._last = None
        if self.bench.line is not None:
            with self.bench.lock:
                self.bench.line.listeners.discard(self._wake)

    def truth(self, sources: tuple[str, ...] = ()) -> dict[str, NDArray[np.float32]]:
        """See Camera."""
        return self._sensor.truth(sources, self._set)
