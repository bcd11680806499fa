"""The rig as a light meter: pictures in full light before a scan, by the source that it will use.

Under a projector full light is white, under switchable lamps those of the scan, under the sun what
there is. An occluder stands where it stands: what is bright is what it does not shade. The pictures
are no frames of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from daemon.devices.devicethread import Session
from daemon.devices.rig import SAFE_S, Rig
from daemon.devices.snapshot import snap_whole
from daemon.patterns import render
from daemon.scans.method import Bench, Unsuitable
from daemon.separation.exposure import LONGEST_US, Limits
from daemon.separation.metering import Exposure, Level, choose, level_of
from daemon.separation.radiometry import Response
from drivers.base.camera import CameraInfo, CameraSettings, Frame
from drivers.clock import NS
from protocol.patterns import WHITE
from protocol.scans.calibrations import CalibrateDark
from protocol.scans.occluded import OccluderScan
from protocol.scans.spec import Spec

_SHOW_S = 5.0
_LIGHT_S = 5.0


def require_meterable(spec: Spec, bench: Bench) -> None:
    """Raise Unsuitable for a spec that asks for looks at the light where they mean nothing."""
    where = "$.auto_exposure" if spec.auto_exposure else "$.ready"
    if not (spec.auto_exposure or spec.ready.looks):
        return
    if bench.camera.recorded:
        raise Unsuitable("a recording's light and exposure are as they were taken", where)
    if not {"software", "none"} & set(bench.camera.triggers):
        raise Unsuitable(
            "the camera is triggered by the projector's sequences only, so no picture can be taken "
            "before the scan: set the exposure by hand (`umbra camera`), or leave the look away",
            where,
        )
    if isinstance(spec, CalibrateDark):
        raise Unsuitable("in the dark there is no light to look at", where)


def limits_of(rig: Rig, longest_us: float | None) -> Limits:
    """What bounds an exposure under the rig's projector, if it has one: whole periods of it."""
    shortest, longest = rig.camera.device.info().exposure_range_us
    longest = min(longest, longest_us or LONGEST_US)
    refresh_hz = rig.projector.device.info().refresh_hz if rig.projector is not None else 0.0
    return Limits(shortest, max(shortest, longest), 1e6 / refresh_hz if refresh_hz > 0 else None)


class LightMeter:
    """Measures for one run. Calls block: for the run's thread."""

    def __init__(
        self,
        *,
        rig: Rig,
        session: Session,
        spec: Spec,
        settings: CameraSettings,
        response: Response,
        latency_s: float,
        attempts: int,
        on_look: Callable[[float], None],
        on_picture: Callable[[Frame, CameraInfo], None],
    ) -> None:
        """`settings` are those of the run, its exposure included; `latency_s` as calibrated.
        `on_look` is called before each picture with the seconds that it is exposed."""
        self._rig = rig
        self._session = session
        self._spec = spec
        self._settings = settings
        self._response = response
        self._latency_ns = round(latency_s * NS)
        self._attempts = attempts
        self._on_look = on_look
        self._on_picture = on_picture

    def look(self) -> Level:
        """The level of a picture at the run's settings. Raises DeviceError."""
        with self._full_light():
            return self._picture(self._settings)

    def choose(self) -> Exposure:
        """The exposure for this light, as `metering.choose` finds it. Raises DeviceError."""
        start = self._rig.camera.device.settings().exposure_us or LONGEST_US / 100
        with self._full_light():
            return choose(
                lambda exposure: self._picture(replace(self._settings, exposure_us=exposure)),
                start,
                self.limits(),
            )

    def limits(self) -> Limits:
        """What bounds the exposure: the camera, the spec, a stream's pace, the projector's."""
        if not isinstance(self._spec, OccluderScan):
            return limits_of(self._rig, self._spec.exposure_us)
        camera = self._rig.camera.device
        shortest, longest = camera.info().exposure_range_us
        longest = min(longest, self._spec.exposure_us or LONGEST_US)
        rate = self._spec.frame_rate_hz or camera.settings().frame_rate_hz
        longest = min(longest, 1e6 / rate if rate else longest)
        return Limits(shortest, max(shortest, longest))

    def _picture(self, settings: CameraSettings) -> Level:
        exposure_us = settings.exposure_us or self._rig.camera.device.settings().exposure_us or 0.0
        self._on_look(exposure_us * 1e-6)
        frame, info = snap_whole(
            self._rig.camera, self._session, self._rig.clock, settings, self._attempts
        )
        self._on_picture(frame, info)
        return level_of(frame.pixels, self._response, frame.exposure_us or exposure_us)

    @contextmanager
    def _full_light(self) -> Iterator[None]:
        self._switch_on()
        try:
            yield
        finally:
            if not self._session.ended.is_set():
                self._switch_off()

    def _switch_on(self) -> None:
        if isinstance(self._spec, OccluderScan):
            for name in self._lamps():
                self._rig.lights[name].call(lambda x: x.set(True), _LIGHT_S, self._session)
        elif self._rig.projector is not None:
            info = self._rig.projector.device.info()
            white = render(WHITE, info.width, info.height)
            shown = self._rig.projector.call(lambda p: p.show(white), _SHOW_S, self._session)
            self._rig.clock.wait_until(shown + self._latency_ns, self._session.ended)

    def _switch_off(self) -> None:
        """As it was before: dark."""
        if isinstance(self._spec, OccluderScan):
            for name in self._lamps():
                self._rig.lights[name].call(lambda x: x.safe(), SAFE_S, self._session)
        elif self._rig.projector is not None:
            self._rig.projector.call(lambda p: p.safe(), SAFE_S, self._session)

    def _lamps(self) -> tuple[str, ...]:
        assert isinstance(self._spec, OccluderScan)
        there = tuple(self._rig.lights)
        return there if self._spec.lights is None else self._spec.lights
