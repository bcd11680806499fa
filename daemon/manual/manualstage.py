"""The stage moved by hand: homing and motions that answer at once and are followed to their end.

    resting ──home, move, circle──> going ──done, stop, failure──> resting
                                    going ──move, circle, home──> going (stopped in between)

Whoever asked has the answer when the stage has accepted; a thread then keeps the planner full,
publishes `stage-changed`, and keeps manual work alive until the stage rests. There is one such
thread at a time: whoever asks for something else ends it first, and with it the motion; homing is
ended by `stop` only. A circle without an end goes on for `ENDLESS_S`, or for as long as its owner
holds the rig.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import structlog

from daemon.devices.devicethread import DeviceThread, Revoked, Session
from daemon.devices.rig import Rig
from daemon.exposing.motion import CALL_S
from drivers.base.errors import DeviceError
from drivers.base.stage import Stage
from drivers.base.stage import StageState as DriverState
from drivers.base.stage import StageStatus as DriverStatus
from protocol.errors import Code, UmbraError
from protocol.messages.events import AnyEvent, StageChanged
from protocol.messages.replies import StageStatus
from protocol.messages.rig import StageState

ENDLESS_S = 600.0
_ASK_S = 2.0  # deadline of a question; a stage that is busy answers later
_PUMP_S = 0.05  # how often the planner is filled
_TELL_S = 0.25  # how often `stage-changed` is published at most
_LEASE_S = 2.0  # of manual work, prolonged while a motion is followed
_FINISH_S = 30.0  # how long a scan waits for a motion's end before it stops it
_HALT_EVERY_S = 0.25

log = structlog.get_logger(__name__)


@dataclass
class _Motion:
    """One homing (then `homing` is its call) or motion, and the thread that follows it."""

    session: Session
    homing: Future[None] | None = None
    endless: bool = False
    replaced: threading.Event = field(default_factory=threading.Event)
    follower: threading.Thread | None = None

    @property
    def going(self) -> bool:
        return self.follower is not None and self.follower.is_alive()

    def join(self, seconds: float | None) -> None:
        """Wait for its end."""
        if self.follower is not None:
            self.follower.join(seconds)


class ManualStage:
    """What a person does with the stage. Calls block shortly: never from the loop."""

    def __init__(
        self,
        rig: Rig,
        use: Callable[[float], Session],
        keep: Callable[[Session, float], None],
        lasting: Callable[[], AbstractContextManager[None]],
        publish: Callable[[AnyEvent], None],
    ) -> None:
        """`use` begins or joins manual work, `keep` prolongs it, within `lasting` no lease ends
        it; `publish` from any thread."""
        self._rig = rig
        self._use = use
        self._keep = keep
        self._lasting = lasting
        self._publish = publish
        self._mutex = threading.Lock()  # one asks for a motion at a time; stop waits for nobody
        self._motion: _Motion | None = None  # the last
        self._problem = ""  # of the last motion

    @property
    def _thread(self) -> DeviceThread[Stage]:
        thread = self._rig.stage
        if thread is None:
            raise UmbraError(Code.DEVICE_MISSING, "this rig has no stage: add [stage] to rig.toml")
        return thread

    @property
    def going(self) -> bool:
        """Whether a motion is being followed."""
        return self._motion is not None and self._motion.going

    @property
    def _homing(self) -> Future[None] | None:
        """The homing under way."""
        motion = self._motion
        homing = motion.homing if motion is not None and motion.going else None
        return None if homing is None or homing.done() else homing

    # ------------------------------------------------------------ asked for

    def status(self) -> StageStatus:
        """Where it is, without disturbing whoever moves it. Raises UmbraError, DeviceError."""
        thread = self._thread
        if self._homing is not None:  # its thread waits, and the controller is silent
            return self._as_reply(StageState.HOMING, None, "")
        try:
            with self._rig.noticing():
                # not `call`: a question that comes too late must not halt a scan's motion
                now = thread.submit(lambda s: s.status(), _ASK_S).result(_ASK_S)
        except FutureTimeout:
            raise UmbraError(
                Code.DEVICE_TIMEOUT, f"{thread.device.name}: status: it is busy; ask again"
            ) from None
        return self._as_reply(StageState(now.state), now.position_mm, now.detail)

    def home(self, timeout_s: float) -> StageStatus:
        """Begin to look for the origin. Raises UmbraError(busy), DeviceError."""
        thread = self._thread
        with self._mutex:
            self._require_not_homing()
            session = self._use(_LEASE_S)
            self._take_over()
            self._problem = ""
            homing = thread.submit(lambda s: s.home(timeout_s), timeout_s + CALL_S, session)
            self._follow(_Motion(session, homing=homing), timeout_s)
        return self._as_reply(StageState.HOMING, None, "")

    def move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> StageStatus:
        """Begin to go straight to a point. Raises UmbraError, DeviceError."""
        return self._go(lambda s: s.jog(x_mm, y_mm, feed_mm_s), endless=False)

    def circle(
        self,
        centre_mm: tuple[float, float],
        radius_mm: float,
        feed_mm_s: float,
        turns: float | None,
    ) -> StageStatus:
        """Begin to go round; `turns` None: until `stop`. Raises UmbraError, DeviceError."""
        rounds = math.inf if turns is None else turns
        return self._go(
            lambda s: s.circle(centre_mm, radius_mm, feed_mm_s, rounds), endless=turns is None
        )

    def stop(self) -> StageStatus:
        """End every motion, homing too. Raises UmbraError, DeviceError."""
        session = self._use(_LEASE_S)
        self._end_homing()
        self._call(lambda s: s.stop(), session)
        if self._motion is not None:
            self._motion.join(CALL_S)
        return self.status()

    def unlock(self) -> StageStatus:
        """Leave the alarm; the position stays unknown. Raises UmbraError, DeviceError."""
        self._require_not_homing()
        self._problem = ""
        self._call(lambda s: s.unlock(), self._use(_LEASE_S))
        return self.status()

    def unlock_for_run(self) -> StageStatus:
        """The same for a run that has the devices, and waits. Raises DeviceError."""
        with self._rig.noticing():
            self._thread.call(lambda s: s.unlock(), CALL_S)
        return self.status()

    def finish(self) -> None:
        """Before a scan: wait for the end of homing and of a short motion; stop any other."""
        motion = self._motion
        if motion is not None and not motion.endless:
            motion.join(None if motion.homing is not None else _FINISH_S)
        if self.going:
            self.stop()

    # ------------------------------------------------------------ the motion

    def _call(self, act: Callable[[Stage], None], session: Session) -> None:
        """Make a call of manual work, which does not end meanwhile. Raises DeviceError, Revoked."""
        with self._lasting(), self._rig.noticing():
            self._thread.call(act, CALL_S, session)

    def _require_not_homing(self) -> None:
        if self._homing is not None:
            raise UmbraError(
                Code.BUSY, "the stage is homing: wait for its end, or `umbra stage stop`"
            )

    def _require_homed(self) -> None:
        """What a stage would refuse in any case, as a state of the rig's that homing mends."""
        now = self.status()
        name = self._thread.device.name
        if now.state is StageState.ALARM:
            raise UmbraError(
                Code.WRONG_STATE,
                f"{name}: it is in alarm"
                + (f": {now.detail}" if now.detail else "")
                + "; look at it, then `umbra stage home`",
            )
        if now.position_mm is None:
            raise UmbraError(
                Code.WRONG_STATE, f"{name}: its position is not known; home it: `umbra stage home`"
            )

    def _take_over(self) -> None:
        """Follow the motion under way no more: its pumping would wait behind what comes now, and
        a call that is late halts the stage."""
        if self._motion is not None:
            self._motion.replaced.set()
            self._motion.join(CALL_S + _ASK_S)

    def _end_homing(self) -> None:
        """Halt it until it has ended: a halt that comes before the driver has begun is lost."""
        homing, deadline = self._homing, time.monotonic() + CALL_S
        while homing is not None and not homing.done() and time.monotonic() < deadline:
            self._thread.device.halt()
            wait([homing], _HALT_EVERY_S)

    def _go(self, act: Callable[[Stage], None], *, endless: bool) -> StageStatus:
        with self._mutex:
            self._require_not_homing()
            session = self._use(_LEASE_S)
            self._require_homed()
            self._take_over()

            def go(stage: Stage) -> None:
                # held is what a safe state interrupted: nobody's wish any more
                if stage.status().state in {DriverState.MOVING, DriverState.HELD}:
                    stage.stop()
                act(stage)

            self._problem = ""
            try:
                self._call(go, session)
            finally:  # refused or not, what moves is followed until it rests
                self._follow(_Motion(session, endless=endless), 0.0)
        return self.status()

    def _follow(self, motion: _Motion, timeout_s: float) -> None:
        motion.follower = threading.Thread(
            target=self._until_rest, args=(motion, timeout_s), name="umbra-stage-by-hand"
        )
        self._motion = motion
        motion.follower.start()

    def _until_rest(self, motion: _Motion, timeout_s: float) -> None:
        thread = self._thread
        try:
            if motion.homing is not None:
                self._tell(StageState.HOMING, None, "")
                self._await(motion.homing, motion.session, timeout_s + CALL_S)
                thread.wait(motion.homing, 0.0)
            self._pump(thread, motion)
        except DeviceError as error:
            self._problem = str(error)
            log.warning("stage by hand", problem=self._problem)
            self._rig.failed(error)
        except Revoked:
            log.info("stage by hand ended with manual work")
        if not motion.replaced.is_set():
            self._told_at_rest(thread)

    def _await(self, homing: Future[None], session: Session, seconds: float) -> None:
        """Until the homing has ended, or must have."""
        deadline = time.monotonic() + seconds
        while not homing.done() and time.monotonic() < deadline:
            self._keep(session, _LEASE_S)
            wait([homing], _LEASE_S / 2)

    def _pump(self, thread: DeviceThread[Stage], motion: _Motion) -> None:
        session, tell_at, since = motion.session, 0.0, time.monotonic()
        while not motion.replaced.is_set():
            now: DriverStatus = thread.call(lambda s: s.pump(), CALL_S, session)
            if now.state is not DriverState.MOVING:
                return
            if not motion.endless or time.monotonic() < since + ENDLESS_S:
                self._keep(session, _LEASE_S)
            if time.monotonic() >= tell_at:
                tell_at = time.monotonic() + _TELL_S
                self._tell(StageState(now.state), now.position_mm, now.detail)
            session.ended.wait(_PUMP_S)

    def _told_at_rest(self, thread: DeviceThread[Stage]) -> None:
        try:
            now = thread.submit(lambda s: s.status(), _ASK_S).result(_ASK_S)
        except (DeviceError, FutureTimeout):
            self._tell(StageState.UNKNOWN, None, self._problem or "it does not answer")
        else:
            self._tell(StageState(now.state), now.position_mm, now.detail)

    def _tell(
        self, state: StageState, position_mm: tuple[float, float] | None, detail: str
    ) -> None:
        self._publish(
            StageChanged(state=state, position_mm=position_mm, detail=detail or self._problem)
        )

    def _as_reply(
        self, state: StageState, position_mm: tuple[float, float] | None, detail: str
    ) -> StageStatus:
        info = self._thread.device.info()
        return StageStatus(
            state=state,
            position_mm=position_mm,
            travel_mm=info.travel_mm,
            max_feed_mm_s=info.max_feed_mm_s,
            detail=detail or self._problem,
        )
