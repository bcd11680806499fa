"""The step loop: show -> expose -> frame, in step, with no fixed sleeps.

For a pattern step the light is first this pattern's (`show` returns at that moment), then the
camera is triggered; the next pattern is drawn while the exposure lasts and flipped as soon as it
ends, so that readout and flip go on side by side (for the exposures of a bracket the light stays):

    projector   |flip k|..........|flip k+1|..........
    camera             |expose k| readout k |expose k+1|

A frame counts only if its exposure lies wholly within the time in which its pattern was lit, by
the device's own time stamps, and if it looks like its pattern (`daemon.proof`). One that does not,
that is incomplete, or that did not come in time is exposed again, `attempts` times in all; then it
is an explicit missing record. Repeating is safe because a frame that is not recorded has no effect.

Of the rig's calibration two things are applied here: the light is this pattern's only `latency_s`
after the projector said so, and images are drawn through the inverse of its `tone`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from daemon.config import SequencerSection
from daemon.control import Control
from daemon.devicethread import Session, Stuck
from daemon.motion import Mover
from daemon.patterns import predistorted, render
from daemon.proof import Proof, expected_level
from daemon.recorder import Exposed, Recorder
from daemon.rig import SAFE_S, Rig
from daemon.ring import Buffer, Ring
from daemon.scans.method import Digest, Expose, Method, Step, Watch
from drivers.base import (
    Acquisition,
    Camera,
    CameraInfo,
    CameraSettings,
    DeviceError,
    DeviceGarbled,
    DeviceTimeout,
    EndOfRecording,
    Frame,
)
from drivers.clock import NS
from protocol.patterns import AnyPattern

SHOW_S = 5.0
"""Deadline of a flip: many refreshes, even of a slow projector."""
CALL_S = 5.0
"""Deadline of a camera call that does not wait for light."""
_RING_S = 30.0
"""How long a stepped scan waits for the recorder before it says that the disk does not keep up."""

log = structlog.get_logger(__name__)


_GAP = 10_000
"""Frames that a stream may lose at once; a larger step in their numbers is garbage."""


class Behind(Exception):
    """The recorder gives no buffer back: the disk does not keep up."""


@dataclass(slots=True)
class _Exposure:
    """A frame that has been triggered and is being read out."""

    index: int
    step: Expose
    sub: int
    lit_ns: int  # from when the light was the pattern's
    dark_ns: int  # until when it was; 0: it still is
    level: float | None  # of the scene under what the projector was given, as far as it is known
    end_ns: int  # when the camera said that the exposure would end
    buffer: Buffer
    grab: Future[Frame]
    attempt: int


class Sequencer:
    """One scan in its course, in the thread that calls `run`."""

    def __init__(
        self,
        *,
        rig: Rig,
        session: Session,
        control: Control,
        method: Method[Any],
        recorder: Recorder,
        ring: Ring,
        patience: SequencerSection,
        may_go_on: Callable[[], None],
        on_pause: Callable[[str], None],
    ) -> None:
        self._rig = rig
        self._session = session
        self._control = control
        self._method = method
        self._recorder = recorder
        self._ring = ring
        self._patience = patience
        self._may_go_on = may_go_on
        self._on_pause = on_pause
        self._clock = rig.clock
        self._camera = rig.camera
        self._info: CameraInfo = rig.camera.device.info()
        self._projector = None if self._info.recorded else rig.projector
        self._acquisition: Acquisition | None = None
        self._taken = 0
        self._pending: _Exposure | None = None
        self._drawn: tuple[AnyPattern, NDArray[np.uint8], float | None] | None = None
        calibration = method.bench.calibration or {}
        self._latency_ns = round(float(calibration.get("latency_s", 0.0)) * NS)
        self._tone: list[int] | None = calibration.get("tone")
        self._exposure_us = self._camera.device.settings().exposure_us
        self._silent = 0  # grabs of a stream in a row that gave nothing
        self._last_sequence: int | None = None
        self._lit: Expose | None = None
        self._lit_ns = 0
        self._lit_level: float | None = None
        self._looks = Proof(self._info.pixel_format.full_scale) if method.looked_at else None
        self.reason = "all steps were exposed"

    def run(self, step_index: int, sub: int, taken: int) -> None:
        """All steps from `step_index`/`sub` on; `taken` frames were had before.

        Raises Revoked (abort), DeviceError, Behind, or what the recorder raises.
        """
        self._taken = taken
        try:
            while (step := self._method.step(step_index, self._summary())) is not None:
                self._may_go_on()
                if self._control.paused:
                    self._settle()
                if self._control.checkpoint(self._session, self._paused):
                    self._acquisition = None
                if isinstance(step, Expose):
                    self._expose(step_index, step, sub)
                elif isinstance(step, Digest):
                    self._digest()
                else:
                    self._watch(step_index, step, sub)
                step_index, sub = step_index + 1, 0
            self._settle()
        except DeviceError:
            raise  # the device that failed is named, not the stop that must fail after it
        except BaseException:
            self._stop_camera()
            raise
        self._stop_camera()

    def _stop_camera(self) -> None:
        if not self._session.ended.is_set():
            self._camera.call(lambda c: c.stop(), CALL_S, self._session)
            self._set_exposure(None)

    def _summary(self) -> Mapping[str, float]:
        return self._recorder.summary

    def _paused(self, reason: str) -> None:
        """Dark and held for as long as the pause lasts."""
        self._camera.call(lambda c: c.stop(), CALL_S, self._session)
        self._acquisition = None
        self._lit = None
        if self._projector is not None:
            self._projector.call(lambda p: p.safe(), SAFE_S, self._session)
        for light in self._rig.lights.values():
            light.call(lambda x: x.safe(), SAFE_S, self._session)
        if self._rig.stage is not None:
            self._rig.stage.call(lambda s: s.safe(), SAFE_S, self._session)
        self._on_pause(reason)

    # ------------------------------------------------------------ pattern steps

    def _expose(self, index: int, step: Expose, first: int) -> None:
        if first >= step.frames:
            return
        self._set_exposure(step.exposure_us)
        self._acquire(Acquisition.SOFTWARE)
        if self._lit is not None and _next_of_bracket(self._lit, step):
            self._lit = step  # the light is this step's already
        else:
            self._light(step)
        for sub in range(first, step.frames):
            self._settle()
            self._pause_within(step)
            if self._lit is not step:  # settling had to show an earlier pattern again
                self._light(step)
            self._pending = self._trigger(index, step, sub, attempt=1)
            if sub + 1 == step.frames:
                self._draw_ahead(index + 1)
            self._await_exposure(self._pending)

    def _pause_within(self, step: Expose) -> None:
        """A pause in the middle of a step: the frames of a long one would fill the ring while the
        disk is full."""
        if self._control.checkpoint(self._session, self._paused):
            self._acquire(Acquisition.SOFTWARE)
            self._light(step)

    def _set_exposure(self, wanted_us: float | None) -> None:
        """Expose for so long from now on; None: as the run began."""
        wanted_us = wanted_us or self._exposure_us
        if wanted_us is None or wanted_us == self._camera.device.settings().exposure_us:
            return
        self._settle()  # what is being read out was exposed as before
        wanted = CameraSettings(exposure_us=wanted_us)

        def change(camera: Camera) -> None:
            camera.stop()
            camera.configure(wanted)

        self._camera.call(change, CALL_S, self._session)
        self._acquisition = None

    def _digest(self) -> None:
        """Wait until the estimator knows every frame so far."""
        self._settle()
        while not self._recorder.digested(_RING_S):
            if not self._control.paused:
                raise Behind
            if self._control.checkpoint(self._session, self._paused):
                self._acquisition = None

    def _light(self, step: Expose) -> None:
        """Make the light this step's; `_lit_ns` says from when it is."""
        if self._pending is not None:
            self._pending.dark_ns = self._clock.now_ns()
        self._lit = step
        if self._projector is None:
            self._lit_ns = 0
        elif step.pattern is None:
            self._projector.call(lambda p: p.safe(), SAFE_S, self._session)
            self._lit_ns = self._clock.now_ns() + self._latency_ns
            self._lit_level = None
        else:
            image, self._lit_level = self._image(step)
            sent = image if self._tone is None else predistorted(image, self._tone)
            flipped = self._projector.call(lambda p: p.show(sent), SHOW_S, self._session)
            self._lit_ns = flipped + self._latency_ns

    def _image(self, step: Expose) -> tuple[NDArray[np.uint8], float | None]:
        """What to show, and how bright the scene must then be."""
        assert self._projector is not None
        assert step.pattern is not None
        if self._drawn is None or self._drawn[0] != step.pattern:
            info = self._projector.device.info()
            image = render(step.pattern, info.width, info.height)
            self._drawn = (step.pattern, image, expected_level(image))
        return self._drawn[1:]

    def _draw_ahead(self, index: int) -> None:
        """Draw the next pattern while the exposure lasts."""
        if self._projector is None:
            return
        step = self._method.step(index, self._summary())
        if isinstance(step, Expose) and step.pattern is not None:
            self._image(step)

    def _trigger(self, index: int, step: Expose, sub: int, attempt: int) -> _Exposure:
        while (buffer := self._ring.take(_RING_S)) is None:
            self._recorder.check()
            if not self._control.paused:
                raise Behind
            self._pause_within(step)  # the disk is full
        if self._projector is not None:
            begin = self._lit_ns + round(step.delay_s * NS)
            self._clock.wait_until(begin, self._session.ended)
            self._session.check()
        _, end_ns = self._camera.call(lambda c: c.trigger(), CALL_S, self._session)
        timeout_s = self._frame_deadline()
        grab = self._camera.submit(
            lambda c: c.grab(buffer, timeout_s), timeout_s + CALL_S, self._session
        )
        return _Exposure(
            index, step, sub, self._lit_ns, 0, self._lit_level, end_ns, buffer, grab, attempt
        )

    def _frame_deadline(self) -> float:
        exposure_us = self._camera.device.settings().exposure_us or 0.0
        return exposure_us * 1e-6 + self._info.readout_s + self._patience.frame_timeout_s

    def _await_exposure(self, exposure: _Exposure) -> None:
        """Wait for the end of the exposure, not of the readout: then the light may change."""
        if self._projector is not None:
            self._clock.wait_until(exposure.end_ns, self._session.ended)
        self._session.check()

    def _settle(self) -> None:
        """See the frame that is being read out to its end: recorded, repeated, or missing."""
        while (exposure := self._pending) is not None:
            problem: str
            self._may_go_on()
            try:
                frame = self._camera.wait(exposure.grab, self._frame_deadline() + CALL_S)
                problem = self._proof(exposure, frame)
            except Stuck:
                raise
            except (DeviceTimeout, DeviceGarbled) as error:
                problem = str(error)
                frame = None
            self._pending = None
            if not problem and frame is not None:
                self._put(
                    exposure.index,
                    exposure.step,
                    exposure.sub,
                    frame,
                    exposure.buffer,
                    lit_ns=exposure.lit_ns,
                )
                return
            self._ring.give(exposure.buffer)
            if exposure.attempt < self._patience.attempts:
                log.warning(
                    "frame exposed again",
                    step=exposure.index,
                    sub=exposure.sub,
                    attempt=exposure.attempt,
                    problem=problem,
                )
                self._restart()
                self._light(exposure.step)
                self._pending = self._trigger(
                    exposure.index, exposure.step, exposure.sub, exposure.attempt + 1
                )
                self._await_exposure(self._pending)
            else:
                self._restart()
                self._miss(exposure.index, exposure.step, exposure.sub, problem)

    def _restart(self) -> None:
        """After a doubtful frame nothing in the camera's queue can be trusted: empty it."""
        self._acquisition = None
        self._camera.call(lambda c: c.stop(), CALL_S, self._session)
        self._acquire(Acquisition.SOFTWARE)

    def _proof(self, exposure: _Exposure, frame: Frame) -> str:
        """Why the frame may show more or less than its pattern, by time stamps and looks; or ""."""
        if frame.incomplete:
            return "the frame is incomplete"
        if self._projector is None:
            return ""
        if frame.start_ns < exposure.lit_ns:
            early = (exposure.lit_ns - frame.start_ns) / NS * 1e3
            return f"the exposure began {early:.2f} ms before its pattern was lit"
        if exposure.dark_ns and frame.end_ns > exposure.dark_ns:
            late = (frame.end_ns - exposure.dark_ns) / NS * 1e3
            return f"the exposure ended {late:.2f} ms after its pattern was taken down"
        if self._looks is None:
            return ""
        return self._looks.problem(frame.pixels, exposure.step, exposure.level)

    # ------------------------------------------------------------ video steps

    def _watch(self, index: int, step: Watch, first: int) -> None:
        """A video: frames as they come, while the stage moves, until there is enough."""
        self._settle()
        mover = self._set_going(step)
        began = self._clock.now_ns()
        sub, last = first, None
        try:
            while step.frames is None or sub < step.frames:
                self._may_go_on()
                if mover is not None and self._control.paused:
                    mover.end()
                if self._control.checkpoint(self._session, self._paused):
                    mover, last = self._set_going(step), None
                seconds = (self._clock.now_ns() - began) / NS
                if reason := self._enough(mover, seconds):
                    self.reason = reason
                    return
                came = self._next_frame(index, step, sub, last, mover)
                if came is None:
                    return
                sub, last = came
        finally:
            if mover is not None:
                mover.end()

    def _set_going(self, step: Watch) -> Mover | None:
        """Lights on, the stage going, the camera streaming."""
        for name in step.lights:
            self._rig.lights[name].call(lambda x: x.set(True), CALL_S, self._session)
        mover = None
        if step.motion is not None and self._rig.stage is not None:
            mover = Mover(
                self._rig.stage,
                step.motion,
                self._session,
                beat=self._may_go_on,
                wake=self._camera.device.halt,
            )
            mover.begin()
        self._acquire(Acquisition.FREE)
        return mover

    def _enough(self, mover: Mover | None, seconds: float) -> str:
        """Why the video ends now; "": it goes on. Raises what went wrong with the stage."""
        if mover is not None:
            mover.check()
            if mover.over:
                return "the stage's motion has come to its end"
        return self._method.enough(self._summary(), seconds)

    def _next_frame(
        self, index: int, step: Watch, sub: int, last: int | None, mover: Mover | None
    ) -> tuple[int, int | None] | None:
        """Take a frame or record why there is none; the next sub-index and the last sequence
        number, or None at the end of a recording."""
        buffer = self._ring.take(_RING_S if self._info.recorded else 0.0)
        behind = buffer is None
        if buffer is None:
            if self._info.recorded and self._control.paused:
                return sub, last  # the disk is full
            if self._info.recorded:
                raise Behind
            buffer = np.empty(self._info.shape, self._info.pixel_format.dtype)
        try:
            frame = self._grab_free(buffer)
        except EndOfRecording:
            self._ring.give(buffer)
            return None
        if frame is None:
            if not behind:
                self._ring.give(buffer)
            if mover is not None:
                mover.check()
            return sub, last  # what was exposed meanwhile shows as a gap in the sequence
        lost = 0 if last is None else max(0, frame.sequence - last - 1)
        for _ in range(lost if step.frames is None else min(lost, step.frames - sub - 1)):
            self._miss(index, step, sub, "lost between camera and host")
            sub += 1
        if behind:
            self._miss(index, step, sub, "the recorder did not keep up")
        else:
            at = mover.position_at(frame.mid_ns) if mover is not None else None
            self._put(index, step, sub, frame, buffer, stage_mm=at)
        return sub + 1, frame.sequence

    def _grab_free(self, buffer: Buffer) -> Frame | None:
        """The next frame of a stream; None if none came in time."""
        timeout_s = self._frame_deadline()
        try:
            frame = self._camera.call(
                lambda c: c.grab(buffer, timeout_s), timeout_s + CALL_S, self._session
            )
        except Stuck:
            raise
        except (DeviceTimeout, DeviceGarbled) as error:
            self._silent += 1
            if self._silent >= self._patience.attempts:
                raise
            log.warning("no frame", problem=str(error), silent=self._silent)
            return None
        self._silent = 0
        last = frame.sequence if self._last_sequence is None else self._last_sequence
        if not 0 <= frame.sequence - last <= _GAP:
            raise DeviceGarbled(
                self._camera.device.name,
                "grab",
                f"frame number {frame.sequence} came after {self._last_sequence}",
                "reconnect the camera",
            )
        self._last_sequence = frame.sequence
        return frame

    # ------------------------------------------------------------ both

    def _acquire(self, wanted: Acquisition) -> None:
        if self._acquisition is wanted:
            return
        at = self._taken

        def start(camera: Camera) -> None:
            camera.stop()
            camera.start(wanted, at)

        self._camera.call(start, CALL_S, self._session)
        self._acquisition = wanted
        self._last_sequence = None

    def _put(
        self,
        index: int,
        step: Step,
        sub: int,
        frame: Frame,
        buffer: Buffer,
        *,
        lit_ns: int = 0,
        stage_mm: tuple[float, float] | None = None,
    ) -> None:
        self._taken += 1
        self._recorder.put(
            Exposed(
                step=step,
                index=index,
                sub=sub,
                frame=frame,
                buffer=buffer,
                stage_mm=stage_mm,
                lit_ns=lit_ns,
            )
        )

    def _miss(self, index: int, step: Step, sub: int, reason: str) -> None:
        self._taken += 1
        log.error("frame missing", step=index, sub=sub, reason=reason)
        self._recorder.put(Exposed(step=step, index=index, sub=sub, frame=None, missing=reason))


def _next_of_bracket(lit: Expose, step: Expose) -> bool:
    """Whether a step shows what the one before it shows, for another exposure of one bracket."""
    same = (lit.pattern, lit.lighting, lit.index) == (step.pattern, step.lighting, step.index)
    return same and lit.exposure != step.exposure
