"""A video of an occluder scan: the camera streams while the stage moves, until there is enough."""

from __future__ import annotations

import numpy as np
import structlog

from daemon.devices.devicethread import Stuck
from daemon.exposing.apparatus import CALL_S, Apparatus
from daemon.exposing.motion import Mover
from daemon.exposing.ring import Buffer
from daemon.scans.method import Watch
from drivers.base.camera import Acquisition, Frame
from drivers.base.errors import DeviceGarbled, DeviceTimeout, EndOfRecording
from drivers.clock import NS

WAY = "video"

_GAP = 10_000
"""Frames that a stream may lose at once; a larger step in their numbers is garbage."""

log = structlog.get_logger(__name__)


class Video:
    """Frames as they come; what the stream or the disk lost is an explicit missing record."""

    def __init__(self, apparatus: Apparatus) -> None:
        self._apparatus = apparatus
        self._silent = 0  # grabs in a row that gave nothing
        self._last: int | None = None  # number of the last frame since the stream began
        self._mover: Mover | None = None

    def watch(self, index: int, step: Watch, first: int) -> str:
        """Take frames from sub-index `first` on; gives the reason why the video ended, "" where it
        is only that all frames were had.

        Raises DeviceError, Revoked, Behind.
        """
        apparatus = self._apparatus
        self._set_going(step)
        going_ns, since = 0, apparatus.clock.now_ns()  # before the last pause, and after it
        sub: int | None = first
        try:
            while sub is not None and (step.frames is None or sub < step.frames):
                apparatus.may_go_on()
                apparatus.control.check(apparatus.session)
                if apparatus.control.paused:
                    going_ns += apparatus.clock.now_ns() - since
                    self._pause()
                    self._set_going(step)
                    since = apparatus.clock.now_ns()
                if reason := self._enough((going_ns + apparatus.clock.now_ns() - since) / NS):
                    return reason
                sub = self._next(index, step, sub)
        finally:
            if self._mover is not None:
                self._mover.end()
        return ""

    def _pause(self) -> None:
        """Stage and stream end, and begin anew, even if it is resumed before it came to a pause."""
        if self._mover is not None:
            self._mover.end()
        if not self._apparatus.checkpoint():
            self._apparatus.stop()

    def _set_going(self, step: Watch) -> None:
        """Lights on, the stage going, the camera streaming."""
        apparatus = self._apparatus
        for name in step.lights:
            apparatus.rig.lights[name].call(lambda x: x.set(True), CALL_S, apparatus.session)
        self._mover = None
        if step.motion is not None and apparatus.rig.stage is not None:
            self._mover = Mover(
                apparatus.rig.stage,
                step.motion,
                apparatus.session,
                beat=apparatus.may_go_on,
                wake=apparatus.camera.device.halt,
            )
            self._mover.begin()
        apparatus.acquire(Acquisition.FREE)
        self._last = None

    def _enough(self, seconds: float) -> str:
        """Why the video ends now; "": it goes on. Raises what went wrong with the stage."""
        if self._mover is not None:
            self._mover.check()
            if self._mover.over:
                return "the stage's motion has come to its end"
        return self._apparatus.method.enough(self._apparatus.recorder.summary, seconds)

    def _next(self, index: int, step: Watch, sub: int) -> int | None:
        """Take a frame or record why there is none; the next sub-index, None at the end of a
        recording."""
        apparatus, info, last = self._apparatus, self._apparatus.info, self._last
        buffer = apparatus.buffer() if info.recorded else apparatus.ring.take(0.0)
        if apparatus.acquire(Acquisition.FREE):
            last = self._last = None  # there was a pause, for a disk that is full
        behind = buffer is None
        if buffer is None:
            buffer = np.empty(info.shape, info.pixel_format.dtype)
        try:
            frame = self._grab(buffer)
        except EndOfRecording:
            apparatus.ring.give(buffer)
            return None
        if frame is None:
            if not behind:
                apparatus.ring.give(buffer)
            if self._mover is not None:
                self._mover.check()
            return sub  # what was exposed meanwhile shows as a gap in the sequence
        lost = 0 if last is None else max(0, frame.sequence - last - 1)
        for _ in range(lost if step.frames is None else min(lost, step.frames - sub - 1)):
            apparatus.miss(index, step, sub, "lost between camera and host")
            sub += 1
        if behind:
            apparatus.miss(index, step, sub, "the recorder did not keep up")
        else:
            at = self._mover.position_at(frame.mid_ns) if self._mover is not None else None
            apparatus.put(index, step, sub, frame, buffer, way=WAY, stage_mm=at)
        return sub + 1

    def _grab(self, buffer: Buffer) -> Frame | None:
        """The next frame of the stream; None if none came in time."""
        apparatus = self._apparatus
        timeout_s = apparatus.frame_deadline()
        try:
            frame = apparatus.camera.call(
                lambda c: c.grab(buffer, timeout_s), timeout_s + CALL_S, apparatus.session
            )
        except Stuck:
            raise
        except (DeviceTimeout, DeviceGarbled) as error:
            self._silent += 1
            if self._silent >= apparatus.patience.attempts:
                raise
            log.warning("no frame", problem=str(error), silent=self._silent)
            return None
        self._silent = 0
        last = frame.sequence if self._last is None else self._last
        if not 0 <= frame.sequence - last <= _GAP:
            raise DeviceGarbled(
                apparatus.camera.device.name,
                "grab",
                f"frame number {frame.sequence} came after {self._last}",
                "reconnect the camera",
            )
        self._last = frame.sequence
        return frame
