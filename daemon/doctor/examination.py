"""All checks in order: first those that only look, then those that use the devices."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import structlog

from daemon.config import RigConfig
from daemon.devices.devicethread import Revoked, Session
from daemon.devices.rig import Rig
from daemon.doctor import (
    clocks,
    devices,
    disk,
    display,
    exposing,
    keys,
    permissions,
    service,
    software,
)
from daemon.doctor.verdict import failed, skipped
from daemon.manual.manual import Manual
from daemon.storage.store import Store
from drivers.base.camera import CameraInfo
from drivers.base.errors import DeviceError
from protocol.errors import Code, UmbraError
from protocol.messages.findings import Check
from protocol.messages.rig import Health

_LEASE_S = 120.0  # longer than any examination takes

log = structlog.get_logger(__name__)


class Doctor:
    """Examines one rig. Blocks for seconds: never from the loop."""

    def __init__(
        self,
        *,
        rig: Rig,
        manual: Manual,
        store: Store,
        config: RigConfig,
        path: Path | None,
        watchdog_s: float | None,
    ) -> None:
        """`path` is rig.toml's, `watchdog_s` what the service manager wants."""
        self._rig = rig
        self._manual = manual
        self._store = store
        self._config = config
        self._path = path
        self._watchdog_s = watchdog_s

    def look(self, *, run_writes: bool) -> list[Check]:
        """The checks that use no device; the disk is left alone while a run writes to it."""
        found = self._rig.devices()
        checks = [software.environment(), software.configuration(self._path, self._config)]
        checks += permissions.permissions(self._config.devices)
        checks += devices.health(found)
        newest = next(iter(self._store.runs()), None)
        before = ({}, "") if newest is None else (newest.file.rig, newest.id)
        checks += devices.firmware(found, *before)
        checks += [clocks.step(self._rig.clock), clocks.synchronised()]
        info = self._camera_info()
        frame_bytes = None if info is None else _bytes(info)
        checks.append(disk.space(self._store.free_bytes(), self._store.reserve_bytes, frame_bytes))
        if run_writes:
            checks.append(disk.speed_unknown())
        else:
            rate_hz = self._rate_hz(info) if info is not None else 0.0
            checks.append(disk.speed(Path(self._config.rig.data), frame_bytes, rate_hz))
        checks.append(keys.keys(self._config.network.keys))
        checks.append(service.watchdog(os.environ, self._watchdog_s))
        return checks

    def expose(self) -> list[Check]:
        """The checks that use the devices, as manual work, which ends in the safe state.

        Raises UmbraError(busy) when somebody else uses them, or takes them meanwhile.
        """
        self._manual.end()
        session = self._manual.use(_LEASE_S)
        try:
            return list(self._exposing(session))
        except Revoked:
            raise UmbraError(
                Code.BUSY, "the examination was ended: a run, `umbra show off` or a stop came"
            ) from None
        finally:
            self._manual.end()

    def _exposing(self, session: Session) -> Iterator[Check]:
        projector = self._rig.projector
        if projector is not None:
            yield from self._tried(
                "projector: refresh", lambda: [display.check(projector, session)]
            )
        camera_info = self._camera_info()
        if camera_info is None:
            yield skipped("camera: trigger", "there is no camera to trigger")
            return
        camera = self._rig.camera
        if camera_info.recorded:
            yield exposing.recorded()
            return
        judge = exposing.trigger if "software" in camera_info.triggers else exposing.stream
        yield from self._tried(
            "camera: trigger",
            lambda: [judge(exposing.shoot(camera, session, exposing.SHOTS))],
        )
        if projector is not None:
            yield from self._tried(
                "projector: light",
                lambda: exposing.projector_checks(camera, projector, session, self._rig.clock),
            )
            if projector.device.info().sequences and "hardware" in camera_info.triggers:
                yield from self._tried(
                    "camera: trigger wire", lambda: [exposing.wiring(camera, projector, session)]
                )
        for name, light in self._rig.lights.items():
            yield from self._tried(
                f"light: {name}", partial(exposing.light_checks, camera, name, light, session)
            )

    def _tried(self, name: str, check: Callable[[], list[Check]]) -> list[Check]:
        """A device that fails is a finding, not an error."""
        try:
            return check()
        except DeviceError as error:
            self._rig.failed(error)
            remedy = error.remedy or "check its cable and power"
            return [failed(name, f"{error.device}: {error.phase}: {error.problem}", remedy)]

    def _camera_info(self) -> CameraInfo | None:
        """What the camera delivers, where there is one and it is there."""
        ready = {d.kind for d in self._rig.devices() if d.health is Health.READY}
        return self._rig.camera.device.info() if "camera" in ready else None

    def _rate_hz(self, info: CameraInfo) -> float:
        return info.max_rate_hz or self._rig.camera.device.settings().frame_rate_hz or 0.0


def _bytes(info: CameraInfo) -> int:
    height, width = info.shape[:2]
    return height * width * info.pixel_format.channels * info.pixel_format.dtype.itemsize
