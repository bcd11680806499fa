"""The frames of a recording, read before the scan reads them: a method may see them twice."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.devices.devicethread import DeviceThread, Session
from daemon.exposing.apparatus import CALL_S
from drivers.base.camera import Acquisition, Camera
from drivers.base.errors import EndOfRecording

_READ_S = 30.0  # of one frame, from a slow disk


def frames_ahead(
    camera: DeviceThread[Camera], session: Session, beat: Callable[[], None]
) -> Generator[NDArray[Any], None, None]:
    """From the first on, in one buffer: a frame lasts until the next is asked for. Nothing is read
    before one is, nor of a camera that is live. Raises DeviceError; `beat` is called before each.
    """
    info = camera.device.info()
    if not info.recorded:
        return
    buffer = np.empty(info.shape, info.pixel_format.dtype)
    camera.call(lambda c: c.start(Acquisition.FREE), CALL_S, session)
    try:
        while True:
            beat()
            camera.call(lambda c: c.grab(buffer, _READ_S), _READ_S + CALL_S, session)
            yield buffer
    except EndOfRecording:
        return
    finally:
        if not session.ended.is_set():
            camera.call(lambda c: c.stop(), CALL_S, session)
