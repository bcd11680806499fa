"""One picture outside of any scan: by a software trigger, else of a camera that runs free."""

from __future__ import annotations

import numpy as np
import structlog

from daemon.devices.devicethread import DeviceThread, Session, Stuck
from drivers.base.camera import Acquisition, Camera, CameraInfo, CameraSettings, Frame
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceTimeout
from drivers.clock import Clock

_PATIENCE_S = 2.0
"""Beyond exposure and readout, until a frame is called lost."""
_CALL_S = 10.0
"""Beyond the exposure: deadline of everything about one picture."""

log = structlog.get_logger(__name__)


def snap(
    camera: DeviceThread[Camera],
    session: Session,
    clock: Clock,
    wanted: CameraSettings | None = None,
) -> tuple[Frame, CameraInfo]:
    """Take one picture, with these settings if any are given; in memory of its own.

    Raises DeviceError. Safe to repeat; whatever was acquiring has been stopped.
    """

    def take(device: Camera) -> tuple[Frame, CameraInfo]:
        device.stop()  # a live view may have left it acquiring
        if wanted is not None:
            device.configure(wanted)
        info = device.info()
        out = np.zeros(info.shape, info.pixel_format.dtype)
        exposure_s = (device.settings().exposure_us or 0.0) * 1e-6
        patience_s = exposure_s + info.readout_s + _PATIENCE_S
        triggered = "software" in info.triggers
        device.start(Acquisition.SOFTWARE if triggered else Acquisition.FREE)
        try:
            asked_ns = clock.now_ns()
            if triggered:
                device.trigger()
            frame = device.grab(out, patience_s)
            while not triggered and not info.recorded and frame.start_ns < asked_ns:
                frame = device.grab(out, patience_s)  # the first came from a buffer's past
        except DeviceLost:
            raise  # there is nothing to stop
        except DeviceError:
            device.stop()
            raise
        device.stop()
        return frame, info

    exposure_us = (wanted and wanted.exposure_us) or camera.device.settings().exposure_us or 0.0
    # of one that runs free a whole exposure may pass before the one that counts begins
    return camera.call(take, 2 * exposure_us * 1e-6 + _CALL_S, session)


def snap_whole(
    camera: DeviceThread[Camera],
    session: Session,
    clock: Clock,
    wanted: CameraSettings,
    attempts: int = 3,
) -> tuple[Frame, CameraInfo]:
    """The same, tried again where no picture came, or half of one: it has no effect.

    Raises DeviceError, Revoked.
    """
    problem: DeviceError
    for attempt in range(1, attempts + 1):
        try:
            frame, info = snap(camera, session, clock, wanted)
        except Stuck:
            raise
        except (DeviceTimeout, DeviceGarbled) as error:
            problem = error
        else:
            if not frame.incomplete:
                return frame, info
            name = camera.device.name
            problem = DeviceGarbled(name, "look", "half a picture came", "check its cable")
        session.check()  # of a camera that was halted nothing else can be said
        log.warning("picture taken again", attempt=attempt, problem=str(problem))
    raise problem
