"""Looking through the camera live, by hand: one picture after the other at a bounded cost.

    still ──start──> live ──stop, nobody renews, manual work ends, the camera fails──> still

One frame is triggered for each picture, so neither bus nor host carries frames that nobody sees; a
camera that cannot be triggered runs free, and the frames between are dropped. Pictures come at
`rate_hz`, or slower: looking at frames takes at most `SHARE` of one processor.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import structlog

from daemon.devices.devicethread import DeviceThread, Revoked, Session
from daemon.devices.rig import Rig
from daemon.exposing.apparatus import CALL_S
from daemon.pictures.display import common_white, for_display
from daemon.pictures.viewfinder import WIDTH, Glimpse, Viewfinder, saturation_of
from daemon.scans.single_image import SingleImageMethod
from daemon.separation.estimator import Components, Lighting, Observation
from drivers.base.camera import Acquisition, Camera, CameraInfo, Frame
from drivers.base.errors import DeviceError

SHARE = 0.25
"""Of one processor's time, at most."""
_PATIENCE_S = 2.0  # beyond exposure and readout, until a frame is called lost

log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Look:
    """What was asked for."""

    rate_hz: float
    until: float
    method: SingleImageMethod | None  # to separate each frame


class Live:
    """The live view of one rig. `start` and `stop` block shortly: never from the loop."""

    def __init__(self, rig: Rig, viewfinder: Viewfinder, use: Callable[[float], Session]) -> None:
        """`use` begins or joins manual work for a time."""
        self._rig = rig
        self._viewfinder = viewfinder
        self._use = use
        self._mutex = threading.Lock()
        self._turn = threading.RLock()  # who has the camera: the live view, or a snap
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._look: _Look | None = None
        self._acquiring = False

    @property
    def on(self) -> bool:
        """Whether it goes on."""
        thread = self._thread
        return thread is not None and thread.is_alive() and not self._stop.is_set()

    @property
    def separating(self) -> bool:
        """Whether frames are separated as well."""
        look = self._look
        return self.on and look is not None and look.method is not None

    def start(self, rate_hz: float, lease_s: float, method: SingleImageMethod | None) -> None:
        """Begin, or go on for `lease_s` more. Raises UmbraError."""
        camera = self._rig.camera
        self._rig.require_kind("camera")
        with self._mutex:
            session = self._use(lease_s)
            self._look = _Look(rate_hz, time.monotonic() + lease_s, method)
            if self.on:
                return
            self._join()
            self._stop.clear()
            self._thread = threading.Thread(
                target=self._run, args=(camera, session), name="umbra-live"
            )
            self._thread.start()

    def stop(self) -> None:
        """End it, and wait until the camera stands still."""
        with self._mutex:
            self._stop.set()
            self._join()

    @contextlib.contextmanager
    def aside(self) -> Iterator[None]:
        """The camera for something else meanwhile; the live view goes on afterwards."""
        with self._turn:
            self._acquiring = False
            yield

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(2 * CALL_S)

    # ------------------------------------------------------------ its thread

    def _run(self, camera: DeviceThread[Camera], session: Session) -> None:
        log.info("live view begins")
        reason = "stopped"
        try:
            while not self._stop.is_set():
                look = self._look
                assert look is not None
                if time.monotonic() >= look.until:
                    reason = "nobody asked again"
                    break
                begun = time.monotonic()
                with self._turn:
                    frame, info = self._frame(camera, session)
                spent = time.thread_time()
                self._show(frame, info, look.method)
                spent = time.thread_time() - spent
                due = begun + max(1 / look.rate_hz, spent / SHARE)
                # the first of the two to come ends the wait: an ended session, or the next frame
                session.ended.wait(max(0.0, min(due, look.until) - time.monotonic()))
            if not session.ended.is_set():
                with self._turn:
                    camera.call(lambda c: c.stop(), CALL_S, session)
        except Revoked:
            reason = "manual work ended"
        except DeviceError as error:
            reason = str(error)
            self._rig.failed(error)
        finally:
            self._stop.set()
            self._acquiring = False
            log.info("live view ended", reason=reason)

    def _frame(self, camera: DeviceThread[Camera], session: Session) -> tuple[Frame, CameraInfo]:
        exposure_s = (camera.device.settings().exposure_us or 0.0) * 1e-6

        def take(device: Camera) -> tuple[Frame, CameraInfo]:
            info = device.info()
            triggered = "software" in info.triggers
            if not self._acquiring:
                device.stop()
                device.start(Acquisition.SOFTWARE if triggered else Acquisition.FREE)
                self._acquiring = True
            if triggered:
                device.trigger()
            out = np.zeros(info.shape, info.pixel_format.dtype)
            asked_ns = device.clock.now_ns()
            while True:
                frame = device.grab(out, exposure_s + info.readout_s + _PATIENCE_S)
                # One that streams faster than it is looked at has its buffers full of the past.
                if triggered or info.recorded or frame.end_ns >= asked_ns:
                    return frame, info

        return camera.call(take, exposure_s + _PATIENCE_S + CALL_S, session)

    def _show(self, frame: Frame, info: CameraInfo, method: SingleImageMethod | None) -> None:
        self._viewfinder.offer(frame, info, now=True)
        if method is None or info.shape != method.bench.camera.shape:
            return  # the roi was changed meanwhile: the next `start` knows the new one
        estimator = method.estimator()
        estimator.update(frame.pixels, Observation(lighting=Lighting.PATTERN))
        components = estimator.result()
        assert isinstance(components, Components)
        white = common_white(components.direct, components.global_)
        for what, plane in (("direct", components.direct), ("global", components.global_)):
            picture = for_display(plane, white, width=WIDTH)
            height, width = picture.shape[:2]
            self._viewfinder.add(
                Glimpse(
                    picture=picture,
                    saturated=saturation_of(frame.pixels, info, height, width),
                    facts={"estimator": method.name, "white": white},
                    run="",
                    what=what,
                )
            )
