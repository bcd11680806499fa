"""One run from its first step to its products, in a thread of its own.

    prepare -> (replay what an interruption left) -> steps -> products -> end
       ^                                               │
       └── a device has failed, and is waited for ─────┘

What comes before the first frame is in `daemon.runs.preparation`, the steps are the sequencer's and
the recorder's, what others are told meanwhile is in `daemon.runs.standing`; here it is decided what
an end means: a failure keeps what was recorded, an abort leaves the devices safe, a full disk only
pauses.

Retry policy. Where the spec waits for what a run needs (`ready.deadline_s`), it waits again for a
device that was lost or did not answer, and goes on as after an interruption: with a stage that is
homed, and all frames that were recorded. A device that fails again and again before there is a new
frame ends the run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import Any

import structlog

from daemon.config import RigConfig
from daemon.devices.devicethread import Revoked, Session
from daemon.devices.rig import SAFE_S, Rig
from daemon.exposing.ahead import frames_ahead
from daemon.exposing.apparatus import Apparatus
from daemon.exposing.control import Control
from daemon.exposing.exposer import Behind
from daemon.exposing.modes import Choice, choose
from daemon.exposing.recorder import Exposed, Recorder
from daemon.exposing.ring import Ring
from daemon.exposing.sequencer import Sequencer, exposer_for, ring_for
from daemon.pictures.viewfinder import Viewfinder
from daemon.products import separated
from daemon.runs.ending import close, end_of, requeue, utc_now, with_exposure, without_result
from daemon.runs.failures import as_error
from daemon.runs.preparation import Preparation
from daemon.runs.resuming import require_same_sun
from daemon.runs.room import Room
from daemon.runs.standing import Standing
from daemon.scans.method import Bench, Method
from daemon.separation.estimator import NotYet, Result
from daemon.storage.durable import StorageError
from daemon.storage.frames import FrameStore
from daemon.storage.ledger import Tally
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from drivers.base.camera import CameraInfo
from drivers.base.errors import DeviceError
from drivers.clock import NS
from protocol.errors import Code, UmbraError
from protocol.messages.runs import End, Progress, RunState
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import OccluderScan
from protocol.scans.projected import PatternScan

_RESULT_S = 30.0
"""Deadline of the estimator's result."""
_TRUTH_S = 60.0
"""Deadline of a simulated camera's truth, which it computes when it is asked."""

_MENDS = {Code.DEVICE_LOST, Code.DEVICE_TIMEOUT, Code.DEVICE_GARBLED}
_IN_VAIN = 3
"""Failures of devices without a new frame between them, after which none is waited for."""

log = structlog.get_logger(__name__)


class Course:
    """The execution of one run. `execute` is its thread; all else may be called from any other."""

    def __init__(
        self,
        folder: RunFolder,
        *,
        rig: Rig,
        store: Store,
        config: RigConfig,
        viewfinder: Viewfinder,
        on_change: Callable[[], None],
        on_progress: Callable[[Progress], None],
    ) -> None:
        self.folder = folder
        self.control = Control()
        self._rig = rig
        self._store = store
        self._config = config
        self._viewfinder = viewfinder
        self.standing = Standing(folder, rig.clock, on_change=on_change, on_progress=on_progress)
        self._recorder: Recorder | None = None
        self._room = Room(store, self.control)
        self._timings: dict[str, float] = {}
        self._reason = ""  # why the steps ended
        self._failed_at: list[int] = []  # frames that were there when a device failed

    # ------------------------------------------------------------ for others

    def result(self) -> Result:
        """The result from the frames so far. Raises UmbraError(no_result)."""
        recorder = self._recorder
        if recorder is None:
            raise UmbraError(Code.NO_RESULT, f"{self.folder.id} has no frames yet")
        try:
            return recorder.result(_RESULT_S)
        except NotYet as error:
            raise UmbraError(Code.NO_RESULT, str(error)) from error

    # ------------------------------------------------------------ the thread

    def execute(self) -> End:
        """Run to the end; never raises. The devices are safe when it returns."""
        structlog.contextvars.bind_contextvars(run=self.folder.id)
        preparation = Preparation(
            self.folder,
            rig=self._rig,
            store=self._store,
            config=self._config,
            control=self.control,
            viewfinder=self._viewfinder,
            on_wait=self.standing.waiting,
            on_look=self.standing.looking,
            beat=self.standing.live,
        )
        while (end := self._attempt(preparation)) is None:
            log.warning("the run waits for the device, and goes on")
        begun = self.folder.file.state not in {RunState.QUEUED, RunState.WAITING}
        if end is self.control.verdict and end.state is RunState.INTERRUPTED and not begun:
            requeue(self.folder)
        else:
            close(self.folder, end, self._timings)
        self.standing.changed()
        return end

    def _attempt(self, preparation: Preparation) -> End | None:
        """Take the devices and go through to the end; None: one failed, and is waited for. The
        devices are safe when it returns."""
        session: Session | None = None
        end: End | None = None
        try:
            session = self._rig.take(f"run {self.folder.id}")
            self.control.check(session)  # what came before there was a session to revoke
            end = self._execute(session, preparation)
        except Revoked:
            end = self.control.verdict or End(
                state=RunState.INTERRUPTED, reason="the devices were taken away"
            )
        except Exception as error:
            if isinstance(error, DeviceError):
                self._rig.failed(error)
            known = as_error(error)
            if known.code is Code.INTERNAL:
                log.exception("run failed")
            end = self.control.verdict
            if end is None and not self._waits_for(known):
                end = End(state=RunState.FAILED, reason=known.message, code=known.code)
        finally:
            if session is not None:
                # Whoever revoked the session has sent the devices there already: this waits.
                futures = self._rig.make_safe(halt=not session.ended.is_set())
                self._rig.safe_within(futures, SAFE_S)
                if end is not None:
                    preparation.restore()
                self._rig.leave(session)
        return end

    def _waits_for(self, error: UmbraError) -> bool:
        """Whether the run goes on when what failed is there again."""
        file = self.folder.file
        if error.code not in _MENDS or not file.started or not file.spec.ready.deadline_s:
            return False
        log.warning("a device failed", problem=error.message)
        self._failed_at.append(self._recorder.tally.taken if self._recorder else 0)
        lately = self._failed_at[-_IN_VAIN:]
        return len(lately) < _IN_VAIN or lately[0] < lately[-1]

    def _execute(self, session: Session, preparation: Preparation) -> End:
        began = time.monotonic()
        file = self.folder.file
        resuming = bool(file.started)
        prepared = preparation.prepare(session, resuming=resuming)
        method = prepared.method
        bench, exposure = prepared.bench, prepared.exposure
        info = bench.camera
        exposure_us = float(prepared.settings.get("exposure_us", 0.0))
        choice = self._choose(bench, exposure_us)
        longest = 1.0
        if isinstance(file.spec, PatternScan) and file.spec.bracket is not None:
            longest = max(file.spec.bracket)
        self.standing.begins(method.planned(), exposure_us * longest * 1e-6)
        rig = {**self._rig.snapshot(), "settings": prepared.settings}
        if exposure is not None:
            rig["exposure"] = exposure.facts()
        elif resuming and (chosen := file.rig.get("exposure")):
            rig["exposure"] = chosen
        self.standing.update(
            state=RunState.RUNNING,
            started=file.started or utc_now(),
            ended="",
            end=None,
            planned=method.planned(),
            rig=rig,
            bench=bench.recorded(),
            calibration=prepared.calibration,
            estimates=prepared.estimates,
            sequencing=choice.facts(file.sequencing["counts"] if file.sequencing else {}),
        )
        if prepared.waited_s:
            self._timings["waited_s"] = self._timings.get("waited_s", 0.0) + prepared.waited_s
        frames = FrameStore.begin(
            self.folder.path,
            info.shape,
            info.pixel_format.dtype,
            pixels=self._config.storage.keep_frames,
            resuming=resuming,
        )
        try:
            least = self._config.sequencer.ring_frames
            ring = ring_for(choice, bench, method.planned(), least)
            recorder = self._recorder = self.standing.counts = Recorder(
                method, frames, ring, self._taken, self._disk_full
            )
            start = self._replay(session, method, recorder, frames, resuming=resuming)
            recorder.start()
            self.standing.say("scanning")
            self._timings["prepare_s"] = time.monotonic() - began
            scanning = self._rig.clock.now_ns()
            try:
                self._sequence(session, method, recorder, ring, choice, start)
            except BaseException:
                # Now, for the recorder may wait long for room.
                self._rig.make_safe(halt=not session.ended.is_set())
                recorder.hurry()
                raise
            finally:
                # Also after an abort: what the camera gave is made durable and counted.
                try:
                    recorder.finish()
                finally:
                    self._count(recorder, choice)
            self._timings["scan_s"] = (self._rig.clock.now_ns() - scanning) / NS
            truth = self._truth(session, _sources(file.spec, bench))
            self._rig.safe_within(self._rig.make_safe(halt=False), SAFE_S)
            return self._conclude(recorder, method, info, truth)
        finally:
            frames.close()

    def _sequence(
        self,
        session: Session,
        method: Method[Any],
        recorder: Recorder,
        ring: Ring,
        choice: Choice,
        start: tuple[int, int],
    ) -> None:
        apparatus = Apparatus(
            rig=self._rig,
            session=session,
            control=self.control,
            method=method,
            recorder=recorder,
            ring=ring,
            patience=self._config.sequencer,
            may_go_on=self._may_go_on,
            on_pause=self._paused,
            taken=recorder.tally.taken,
        )
        sequencer = Sequencer(apparatus, exposer_for(choice, apparatus))
        try:
            sequencer.run(*start)
            self._reason = sequencer.reason
        except Behind as error:
            raise UmbraError(
                Code.STORAGE_FAILED,
                f"{self._config.rig.data}: the disk has not taken a frame for half a minute; "
                "check it, then `umbra resume`",
            ) from error

    def _truth(self, session: Session, sources: tuple[str, ...]) -> dict[str, Any]:
        """What a simulated camera knows; a scan does not fail for the lack of it."""
        try:
            return self._rig.camera.call(lambda c: c.truth(sources), _TRUTH_S, session)
        except DeviceError as error:
            log.warning("no truth to compare with", problem=str(error))
            return {}

    # ------------------------------------------------------------ before

    def _choose(self, bench: Bench, exposure_us: float) -> Choice:
        """How exposures are kept in step with patterns. Raises Unsuitable."""
        choice = choose(self.folder.file.spec, self._config.sequencer, bench, exposure_us)
        log.info("mode", mode=choice.mode, why=choice.why)
        for warning in choice.warnings:
            log.warning("exposure", problem=warning)
        return choice

    def _replayed(self, session: Session) -> None:
        """A frame of before has been taken in: a sign of life, and the place to be aborted."""
        self.standing.replayed()
        self.control.check(session)

    def _replay(
        self,
        session: Session,
        method: Method[Any],
        recorder: Recorder,
        frames: FrameStore,
        *,
        resuming: bool,
    ) -> tuple[int, int]:
        """Take in what was recorded before an interruption; the step and sub-index to begin with.
        Raises UmbraError(unsuitable) where the sun has moved on."""
        with closing(frames_ahead(self._rig.camera, session, self.standing.live)) as ahead:
            method.foresee(ahead)
        if not resuming:
            return 0, 0
        self.standing.say("taking in what was recorded before the interruption")
        require_same_sun(self.folder, frames.records(), self._rig.clock.utc_ns())
        step, sub = recorder.replay(lambda: self._replayed(session))
        log.info("resumed", step=step, sub=sub, recorded=recorder.tally.recorded)
        return step, sub

    # ------------------------------------------------------------ during

    def _may_go_on(self) -> None:
        """Called at each step: a sign of life, and a pause before the disk is full."""
        self.standing.live()
        if self.folder.file.state is RunState.PAUSED and not self.control.paused:
            self.standing.goes_on()  # it was resumed while it was being paused
        self._room.look()

    def _paused(self, reason: str) -> None:
        """The sequencer has stopped at a checkpoint; comes back when it may go on."""
        if self.folder.file.state is not RunState.PAUSED:
            log.info("paused", reason=reason)
        self.standing.say(f"paused: {reason}" if reason else "paused")
        self.standing.note(state=RunState.PAUSED)

    def _disk_full(self, error: StorageError) -> None:
        """The disk took no more, reserve or not (recorder's thread): a pause, in which the frame
        keeps its buffer. Comes back to write it again; raises the error when the run ends."""
        if self.control.verdict is None:
            reason = self._room.refused(error)
            # The sequencer says so too when it gets there, which it may not after the last frame.
            self._paused(reason)
        if not self.control.await_resume():
            raise error

    def resumed(self) -> None:
        """The pause is over. Raises UmbraError(storage_full) if there is still no room."""
        self._room.require()
        if self.folder.file.state is RunState.PAUSED:
            self.standing.goes_on()
        self.control.resume()

    def _taken(self, tally: Tally, summary: Mapping[str, float], exposed: Exposed) -> None:
        """The estimator has taken a frame in (separator's thread)."""
        del summary
        if exposed.frame is not None:
            self._viewfinder.offer(exposed.frame, self._rig.camera.device.info(), self.folder.id)
        self.standing.taken(tally)

    def _count(self, recorder: Recorder, choice: Choice) -> None:
        tally = recorder.tally
        self.standing.note(
            recorded=tally.recorded,
            missing=tally.missing,
            rejected=tally.rejected,
            sequencing=choice.facts(recorder.ledger.exposing),
        )

    # ------------------------------------------------------------ after

    def _conclude(
        self, recorder: Recorder, method: Method[Any], info: CameraInfo, truth: Mapping[str, Any]
    ) -> End:
        self.standing.update(state=RunState.FINISHING)
        self.standing.say("writing products")
        began = time.monotonic()
        lost = recorder.ledger.lost_patterns
        try:
            result = with_exposure(recorder.result(_RESULT_S), self.folder.file.rig)
        except NotYet as error:
            raise without_result(error, recorder.ledger, self._reason) from None
        self._timings["separate_s"] = time.monotonic() - began
        made = separated.write(
            self.folder,
            result,
            full_scale=info.pixel_format.full_scale,
            pixel_format=info.pixel_format,
            frame=self._viewfinder.picture(),
            truth=truth,
            timings={**self._timings, "rate_hz": self.standing.rate()},
        )
        self.folder.add_products(made)
        self._timings["products_s"] = time.monotonic() - began
        return end_of(lost, self._reason, short=method.short())


def _sources(spec: AnyScan, bench: Bench) -> tuple[str, ...]:
    """The lights that a scan separates; (): the projector's."""
    if not isinstance(spec, OccluderScan):
        return ()
    return bench.lights if spec.lights is None else spec.lights
