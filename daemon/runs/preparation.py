"""From a run that has the devices to one that can begin: everything it needs is there, the camera
is set, the exposure chosen, the method made.

    devices ──> disk ──> stage homed ──> light ──> steadiness ──> exposure ──> first frame

Up to the exposure these are preconditions, and may be waited for (`daemon.runs.preconditions`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import msgspec
import structlog

from daemon.config import RigConfig
from daemon.devices.devicethread import Session
from daemon.devices.lightmeter import LightMeter, require_meterable
from daemon.devices.rig import Rig
from daemon.exposing.apparatus import CALL_S
from daemon.exposing.control import Control
from daemon.exposing.motion import require_homed
from daemon.pictures.viewfinder import Viewfinder
from daemon.runs.calibration import Calibrations
from daemon.runs.preconditions import LightWatch, Precondition, Preconditions
from daemon.runs.resuming import require_same_devices
from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Method
from daemon.scans.parameters import response_of
from daemon.separation.metering import Exposure, Level
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store, estimate_bytes
from drivers.base.camera import CameraSettings
from drivers.base.errors import DeviceError
from protocol.errors import Code, UmbraError
from protocol.messages.runs import Waiting
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import OccluderScan
from protocol.scans.spec import Radiometry, Scan

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Prepared:
    """What a run begins with. `settings` are the camera's in force, JSON-able, as run.json keeps
    them; `exposure` where it was chosen by pictures; `estimates` of frames and bytes, where
    the plan knows."""

    method: Method[Any]
    bench: Bench
    settings: dict[str, Any]
    calibration: dict[str, Any]
    exposure: Exposure | None
    estimates: dict[str, float]
    waited_s: float


class Preparation:
    """Of one run, in its thread. `restore` may follow whatever came of it."""

    def __init__(
        self,
        folder: RunFolder,
        *,
        rig: Rig,
        store: Store,
        config: RigConfig,
        control: Control,
        viewfinder: Viewfinder,
        on_wait: Callable[[Waiting], None],
        on_look: Callable[[float], None],
        beat: Callable[[], None],
    ) -> None:
        """`on_wait` is told what the run waits for, `on_look` the seconds of each exposure before a
        look at the light, `beat` called while the stage is homed."""
        self._folder = folder
        self._spec = folder.file.spec
        self._rig = rig
        self._store = store
        self._config = config
        self._control = control
        self._viewfinder = viewfinder
        self._on_wait = on_wait
        self._on_look = on_look
        self._beat = beat
        self._found: CameraSettings | None = None  # as the camera was before the run
        self._settings: dict[str, Any] = {}

    def prepare(self, session: Session, *, resuming: bool) -> Prepared:
        """See the module. Raises UmbraError, DeviceError, Unsuitable, Revoked."""
        spec, file = self._spec, self._folder.file
        before = file.rig if resuming else None
        wanted = self._wanted(before)
        metered = spec.auto_exposure and not (before or {}).get("settings")
        exposure: Exposure | None = None
        estimates: dict[str, float] = {}

        def devices() -> None:
            self._rig.require_ready()
            require_meterable(spec, self._rig.bench())
            if before is not None:
                require_same_devices(self._folder, before, self._rig.snapshot())
            self._settings = self._configure(session, wanted)

        def disk() -> None:
            nonlocal estimates
            estimates = self._room(method_for(spec, self._rig.bench()).planned())

        def stage() -> None:
            if isinstance(spec, OccluderScan) and self._rig.stage is not None:
                require_homed(self._rig.stage, session, self._beat)

        def level() -> Level:
            meter = self._meter(session, wanted)
            return meter.choose().level if metered else meter.look()

        watch = LightWatch(spec.ready, level, self._rig.clock)
        waited_s = Preconditions(
            spec.ready,
            [
                Precondition("devices", devices),
                Precondition("disk", disk),
                Precondition("stage", stage, mended=True),
                *watch.conditions(),
            ],
            clock=self._rig.clock,
            control=self._control,
            session=session,
            on_wait=self._on_wait,
            on_failure=self._rig.failed,
        ).wait()
        if metered:
            exposure = self._meter(session, wanted).choose()
            log.info("exposure chosen", **exposure.facts())
            wanted = replace(wanted, exposure_us=exposure.exposure_us)
            self._settings = self._configure(session, wanted)
        calibration = file.calibration if resuming else None
        if calibration is None:
            calibration = self._calibration()
        bench = self._rig.bench(calibration["values"])
        return Prepared(
            method=method_for(as_exposed(self._spec, self._settings), bench),
            bench=bench,
            settings=self._settings,
            calibration=calibration,
            exposure=exposure,
            estimates=estimates,
            waited_s=waited_s,
        )

    def restore(self) -> None:
        """Set the camera as it was before the run, when it is stopped. Never raises: a camera that
        is gone comes back with the settings that it has by itself."""
        if self._found is None:
            return
        camera = self._rig.camera
        now = asdict(camera.device.settings())
        changed = {k: v for k, v in asdict(self._found).items() if v is not None and now[k] != v}
        if not changed:
            return
        try:
            camera.call(lambda c: c.configure(CameraSettings(**changed)), CALL_S)
        except DeviceError as error:
            log.warning("the camera keeps the run's settings", problem=str(error), were=changed)

    # ------------------------------------------------------------ the conditions

    def _wanted(self, before: Mapping[str, Any] | None) -> CameraSettings:
        """What the spec asks of the camera, or exactly what was before an interruption."""
        spec = self._spec
        # With auto-exposure the spec's own is the longest that may be chosen.
        exposure_us = None if spec.auto_exposure else spec.exposure_us
        wanted = CameraSettings(exposure_us=exposure_us, gain=spec.gain)
        if before is not None and (known := before.get("settings")):
            wanted = msgspec.convert(known, CameraSettings)
        if isinstance(spec, OccluderScan) and spec.frame_rate_hz is not None:
            wanted = replace(wanted, frame_rate_hz=spec.frame_rate_hz)
        return wanted

    def _configure(self, session: Session, wanted: CameraSettings) -> dict[str, Any]:
        camera = self._rig.camera
        if self._found is None:
            self._found = camera.device.settings()
        in_force = camera.call(lambda c: c.configure(wanted), CALL_S, session)
        return {
            **{name: value for name, value in asdict(in_force).items() if value is not None},
            "pixel_format": camera.device.info().pixel_format.value,
        }

    def _room(self, planned: int | None) -> dict[str, float]:
        """What the run is expected to take. Raises UmbraError(storage_full) where there is no room
        for it."""
        info = self._rig.camera.device.info()
        need = estimate_bytes(
            info.shape, info.pixel_format.dtype, planned or 1, self._config.storage.keep_frames
        )
        if not self._store.room_for(need):
            raise UmbraError(
                Code.STORAGE_FULL,
                f"{self._config.rig.data}: the scan needs about {need / 1e6:.0f} MB beyond the "
                f"reserve, {self._store.free_bytes() / 1e6:.0f} MB are free: delete old runs",
            )
        return {} if planned is None else {"frames": float(planned), "bytes": float(need)}

    # ------------------------------------------------------------ the light

    def _calibration(self) -> dict[str, Any]:
        found = Calibrations(self._store, self._config.calibration.max_age_days)
        return found.of(self._rig.snapshot(), self._settings, self._spec)

    def _meter(self, session: Session, wanted: CameraSettings) -> LightMeter:
        values = self._calibration()["values"]
        radiometry = self._spec.radiometry if isinstance(self._spec, Scan) else Radiometry()
        return LightMeter(
            rig=self._rig,
            session=session,
            spec=self._spec,
            settings=wanted,
            response=response_of(radiometry, self._rig.bench(values)),
            latency_s=float(values.get("latency_s", 0.0)),
            attempts=self._config.sequencer.attempts,
            on_look=self._on_look,
            on_picture=lambda frame, info: self._viewfinder.offer(frame, info, now=True),
        )


def as_exposed(spec: AnyScan, settings: Mapping[str, Any]) -> AnyScan:
    """A spec with the exposure that was chosen, for methods to reckon with; `settings` are the
    camera's in force."""
    if not spec.auto_exposure:
        return spec
    return msgspec.structs.replace(spec, exposure_us=settings.get("exposure_us"))
