"""One picture, by software trigger, outside of any scan."""

from __future__ import annotations

import numpy as np

from daemon.devicethread import DeviceThread, Session
from drivers.base import (
    Acquisition,
    Camera,
    CameraInfo,
    CameraSettings,
    DeviceError,
    DeviceLost,
    Frame,
)

_PATIENCE_S = 2.0
"""Beyond exposure and readout, until a frame is called lost."""
_CALL_S = 10.0
"""Beyond the exposure: deadline of everything about one picture."""


def snap(
    camera: DeviceThread[Camera], session: Session, wanted: CameraSettings | None = None
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
        device.start(Acquisition.SOFTWARE)
        try:
            device.trigger()
            frame = device.grab(out, exposure_s + info.readout_s + _PATIENCE_S)
        except DeviceLost:
            raise  # there is nothing to stop
        except DeviceError:
            device.stop()
            raise
        device.stop()
        return frame, info

    exposure_us = (wanted and wanted.exposure_us) or camera.device.settings().exposure_us or 0.0
    return camera.call(take, exposure_us * 1e-6 + _CALL_S, session)
