"""DSLRs and mirrorless cameras through libgphoto2 (extra `gphoto2`): RAW as a mosaic, or JPEG.

A RAW file gives the sensor's own counts, unpacked, with the mosaic named and the black level that
the file states. A JPEG has the camera's tone curve: tell the scan, or set the camera to RAW. How
large frames are is known only from a picture, so `connect` takes one. A setting takes the camera's
nearest step, if one is near. Life and settings otherwise: drivers/attached.py. A waiting grab sees
`halt` within 50 ms; an exposure goes on to its end.

Retry policy. `configure`, `start`, `stop` and `check` may be sent again; `trigger` may not. When
a picture did not come, the next trigger first waits until the camera has been quiet for an exposure
and a second, and drops what comes: a late picture is never taken for the next one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import gphoto2 as gp
import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.attached import AttachedCamera
from drivers.base.camera import Acquisition, CameraInfo, CameraSettings, Frame
from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.clock import NS
from drivers.gphoto2config import Config
from drivers.imagefile import BadImage
from drivers.rawfile import develop

SHUTTER = ("shutterspeed", "shutterspeed2", "exptime")  # what makers call it
ISO = ("iso", "isospeed")
MEMORY = "Internal RAM"  # not the card, which is slower
SLICE_MS = 50  # libgphoto2 cannot be woken: so long is it until `halt` is seen
QUIET_S = 1.0
FIRST_PICTURE_S = 20.0
NEAR = 1.2  # steps are a third or half of a stop, 1.26 or 1.41: the nearest is at most so far


class GphotoOptions(Options, frozen=True, kw_only=True):
    """Keys of a `driver = "gphoto2"` camera."""

    serial: str = ""  # as `gphoto2 --summary` says; "": the only camera there is
    exposure_us: float | None = None  # the nearest that the camera has
    iso: float | None = None
    config: dict[str, str] = msgspec.field(default_factory=dict)  # gphoto2's own: imageformat ...
    keep: bool = False  # leave pictures on the camera's card


class GphotoCamera(AttachedCamera):
    """A camera that takes pictures one at a time. See the module. `gain` is the ISO speed."""

    options_type = GphotoOptions
    options: GphotoOptions

    def __init__(self, name: str, options: GphotoOptions, context: Context) -> None:
        super().__init__(name, options, context)
        self._camera: Any = None
        self._sequence = 0

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device. Opens each camera for a moment to ask for its serial number."""
        found = []
        for model, port in _attached():
            try:
                camera = _opened(model, port)
                serial = Config(camera).text("serialnumber")
                camera.exit()
            except gp.GPhoto2Error:
                serial = ""  # somebody else has opened it, perhaps the rig itself
            options = {"driver": "gphoto2", **({"serial": serial} if serial else {})}
            found.append({"model": model, "serial": serial, "options": options})
        return found

    # ------------------------------------------------------------ life

    def check(self) -> None:
        """Ask for its model."""
        self._connected("check")
        with self._errors("check"):
            self._camera.get_abilities()
            self._camera.get_storageinfo()

    def facts(self) -> dict[str, Any]:
        """Identity."""
        return {"model": self._identity.model, "serial": self._identity.serial}

    def _open(self) -> Identity:
        self._camera, identity = self._find()
        target = self._config.first(("capturetarget",))
        if target and MEMORY in self._config.choices(target):
            self._config.set(target, MEMORY)
        for name, value in self.options.config.items():
            self._choose(name, value, "connect")
        return identity

    def _find(self) -> tuple[Any, Identity]:
        wanted, seen = [], []
        for model, port in _attached():
            camera = _opened(model, port)
            serial = Config(camera).text("serialnumber")
            seen.append(f"{model} {serial}")
            if self.options.serial in {"", serial}:
                identity = Identity(model, serial, Config(camera).text("deviceversion"))
                wanted.append((camera, identity))
            else:
                camera.exit()
        if len(wanted) == 1:
            return wanted[0]
        for camera, _ in wanted:
            camera.exit()
        if wanted:
            raise self._refused("connect", f"several: {', '.join(seen)}", "name one by `serial`")
        raise DeviceLost(
            self.name,
            "connect",
            f"no camera {self.options.serial or 'at all'} (found: {', '.join(seen) or 'none'})",
            "switch it on, and off its power saving; check cable and `serial`",
        )

    # ------------------------------------------------------------ settings

    def _stated(self) -> CameraSettings:
        return CameraSettings(exposure_us=self.options.exposure_us, gain=self.options.iso)

    def _apply(self, wanted: CameraSettings, phase: str) -> None:
        info = self._info
        if wanted.frame_rate_hz is not None:
            raise self._refused(phase, "it has no frame rate", "leave it out")
        if info and wanted.pixel_format not in {None, info.pixel_format}:
            raise self._refused(
                phase,
                f"it delivers {info.pixel_format}, not {wanted.pixel_format}",
                "set its image format: `config = {imageformat = ...}`",
            )
        if info and wanted.roi not in {None, (0, 0, info.width, info.height)}:
            raise self._refused(phase, "it has no region of interest", "leave it out")
        steps = []
        if wanted.exposure_us is not None:
            steps.append(self._step(SHUTTER, wanted.exposure_us / 1e6, phase))
        if wanted.gain is not None:
            steps.append(self._step(ISO, wanted.gain, phase))
        for name, choice in steps:
            self._choose(name, choice, phase)

    def _step(self, names: tuple[str, ...], value: float, phase: str) -> tuple[str, str]:
        """The setting, and its choice that is nearest to `value`."""
        name = self._config.first(names)
        if not name:
            raise self._refused(phase, f"it has no {names[0]} to set", "set its dial to manual")
        numbers = self._config.numbers(name)
        if not numbers or value <= 0:
            raise self._refused(phase, f"{name} cannot be set", "set its dial to manual")
        best = min(numbers, key=lambda c: max(numbers[c] / value, value / numbers[c]))
        if not 1 / NEAR <= numbers[best] / value <= NEAR:
            raise self._refused(
                phase,
                f"{name} {value:g} is out of its steps",
                f"the nearest is {best}; it has {min(numbers.values()):g} "
                f"to {max(numbers.values()):g}",
            )
        return name, best

    def _choose(self, name: str, value: str, phase: str) -> None:
        if not self._config.has(name):
            raise self._refused(phase, f"it has no setting {name}", "correct or remove it")
        choices = self._config.choices(name)
        if choices and value not in choices:
            raise self._refused(
                phase, f"{name} cannot be {value}", f"choose of {', '.join(choices)}"
            )
        self._config.set(name, value)

    @property
    def _config(self) -> Config:
        return Config(self._camera)

    def _take_in(self) -> None:
        info = self.info()
        seconds = self._config.number(SHUTTER)
        self._settings = CameraSettings(
            exposure_us=None if seconds is None else seconds * 1e6,
            gain=self._config.number(ISO),
            pixel_format=info.pixel_format,
            roi=(0, 0, info.width, info.height),
        )

    def _learn(self) -> None:
        """Take a picture and find out what pictures are like."""
        phase = "connect"
        self._halted.clear()
        self._drain(0.0)
        self._camera.trigger_capture()
        exposure = self._config.number(SHUTTER) or 0.0
        data = self._picture(phase, exposure + FIRST_PICTURE_S)
        if self._drain(0.2):
            raise self._refused(
                phase, "one exposure gives several pictures", "set it to RAW or to JPEG, not both"
            )
        try:
            pixels, pixel_format, black = develop(data)
        except BadImage as error:
            raise self._refused(phase, f"its picture {error.problem}", error.remedy) from error
        name = self._config.first(SHUTTER)
        times = self._config.numbers(name).values() if name else ()
        speeds = self._config.numbers(iso).values() if (iso := self._config.first(ISO)) else ()
        self._info = CameraInfo(
            width=pixels.shape[1],
            height=pixels.shape[0],
            pixel_format=pixel_format,
            black_level=black,
            exposure_range_us=(min(times) * 1e6, max(times) * 1e6) if times else (0.0, 0.0),
            gain_range=(min(speeds), max(speeds)) if speeds else None,
            gain_unit="ISO",
            triggers=("software", "hardware"),
        )
        self._take_in()

    # ------------------------------------------------------------ acquisition

    def start(self, acquisition: Acquisition, at: int = 0) -> None:
        """See Camera. HARDWARE: a cable release; pictures are fetched as they come."""
        del at
        self._connected("start")
        if acquisition is Acquisition.FREE:
            raise self._refused("start", "it cannot run free", "use software or hardware triggers")
        self.stop()
        with self._errors("start"):
            self._drain(0.0)
        self._halted.clear()
        self._triggered.clear()
        self._late = False
        self._sequence = 0
        self._acquisition = acquisition

    def trigger(self) -> tuple[int, int]:
        """See Camera. Of the shutter's lag nothing is known: calibrate the latency."""
        self._connected("trigger")
        if self._acquisition is not Acquisition.SOFTWARE:
            raise self._refused("trigger", "it does not wait for software", "start it so")
        exposure_s = (self._settings.exposure_us or 0.0) / 1e6
        with self._errors("trigger"):
            if self._late:
                self._drain(exposure_s + QUIET_S)
                self._triggered.clear()
                self._late = False
            self._unless_halted("trigger")
            before = self.clock.now_ns()
            self._camera.trigger_capture()
        exposure = (before, self.clock.now_ns() + round(exposure_s * NS))
        self._triggered.append(exposure)
        return exposure

    def grab(self, out: NDArray[Any], timeout_s: float) -> Frame:
        """See Camera. Raises DeviceGarbled for a picture that cannot be read or has changed its
        size or kind."""
        info = self.info()
        if self._acquisition is None:
            raise self._refused("grab", "not started", "start it first")
        with self._errors("grab"):
            data = self._picture("grab", timeout_s)
        now = self.clock.now_ns()
        try:
            pixels, pixel_format, _ = develop(data)
        except BadImage as error:
            raise DeviceGarbled(
                self.name, "grab", f"its picture {error.problem}", error.remedy
            ) from error
        if pixels.shape != info.shape or pixel_format is not info.pixel_format:
            raise DeviceGarbled(
                self.name,
                "grab",
                f"a {pixels.shape[1]} x {pixels.shape[0]} {pixel_format} picture came, not "
                f"{info.width} x {info.height} {info.pixel_format}",
                "connect again after changing its image format",
            )
        np.copyto(out, pixels)
        length = round((self._settings.exposure_us or 0.0) * 1000)
        start, end = self._triggered.popleft() if self._triggered else (now - length, now)
        sequence, self._sequence = self._sequence, self._sequence + 1
        return Frame(
            pixels=out,
            sequence=sequence,
            start_ns=start,
            end_ns=end,
            utc_ns=start + self.clock.utc_ns() - self.clock.now_ns(),
            exposure_us=self._settings.exposure_us or 0.0,
            gain=self._settings.gain or 0.0,
        )

    def stop(self) -> None:
        """See Camera."""
        self._acquisition = None

    def _release(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            with contextlib.suppress(gp.GPhoto2Error):  # it is gone: nothing to close
                camera.exit()

    def _picture(self, phase: str, timeout_s: float) -> bytes:
        """The next picture's file, taken off the camera."""
        deadline = self.clock.now_ns() + round(timeout_s * NS)
        while True:
            self._unless_halted(phase)
            left_ms = (deadline - self.clock.now_ns()) * 1000 // NS
            event, where = self._camera.wait_for_event(max(1, min(left_ms, SLICE_MS)))
            if event == gp.GP_EVENT_FILE_ADDED:
                return self._fetch(where)
            if left_ms <= 0:
                self._late = True
                raise DeviceTimeout(
                    self.name,
                    phase,
                    f"no picture within {timeout_s:g} s",
                    "check focus (manual), card and battery, then trigger again",
                )

    def _fetch(self, where: Any) -> bytes:
        file = self._camera.file_get(where.folder, where.name, gp.GP_FILE_TYPE_NORMAL)
        data = bytes(memoryview(file.get_data_and_size()))
        if not self.options.keep:
            self._camera.file_delete(where.folder, where.name)
        return data

    def _drain(self, quiet_s: float) -> int:
        """Drop pictures until none has come for `quiet_s`; gives how many."""
        dropped = 0
        deadline = self.clock.now_ns() + round(quiet_s * NS)
        while True:
            event, where = self._camera.wait_for_event(SLICE_MS if quiet_s else 1)
            if event == gp.GP_EVENT_FILE_ADDED:
                dropped += 1
                if not self.options.keep:
                    self._camera.file_delete(where.folder, where.name)
                deadline = self.clock.now_ns() + round(quiet_s * NS)
            elif event == gp.GP_EVENT_TIMEOUT and self.clock.now_ns() >= deadline:
                return dropped
            if self._halted.is_set():
                return dropped

    # ------------------------------------------------------------ errors

    @contextlib.contextmanager
    def _errors(self, phase: str) -> Iterator[None]:
        try:
            yield
        except gp.GPhoto2Error as error:
            raise self._kind(error)(
                self.name, phase, str(error.string), _REMEDIES.get(error.code, "connect again")
            ) from error

    def _kind(self, error: Any) -> type[DeviceError]:
        if error.code in {gp.GP_ERROR_TIMEOUT, gp.GP_ERROR_CAMERA_BUSY}:
            return DeviceTimeout
        lost = {
            gp.GP_ERROR_IO,
            gp.GP_ERROR_IO_READ,
            gp.GP_ERROR_IO_WRITE,
            gp.GP_ERROR_IO_USB_FIND,
            gp.GP_ERROR_MODEL_NOT_FOUND,
        }
        return DeviceLost if error.code in lost else DeviceRefused


_REMEDIES = {
    gp.GP_ERROR_CAMERA_BUSY: "wait until its card is written, then try again",
    gp.GP_ERROR_IO_USB_CLAIM: "another program holds it: on a desktop, unmount it there",
    gp.GP_ERROR_NO_SPACE: "empty its card",
}


# ---------------------------------------------------------------- libgphoto2


def _attached() -> list[tuple[str, str]]:
    """Model and port of each camera."""
    found = gp.Camera.autodetect()
    return [(str(found.get_name(i)), str(found.get_value(i))) for i in range(found.count())]


def _opened(model: str, port: str) -> Any:
    camera = gp.Camera()
    ports = gp.PortInfoList()
    ports.load()
    camera.set_port_info(ports[ports.lookup_path(port)])
    kinds = gp.CameraAbilitiesList()
    kinds.load()
    camera.set_abilities(kinds[kinds.lookup_model(model)])
    camera.init()
    return camera
