"""The stage's motion during a video: homed first if it must be, kept going, ended with it.

    at rest ──begin──> going ──end, a pause, an abort──> at rest;  going ──failure──> failed

A thread of its own keeps the planner full and sets the next motion going when one has ended, so
that a slow camera does not starve the stage. When the stage fails, the camera's wait is ended too:
`check` then raises the stage's own error within a moment, and the run goes to its safe state.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import wait

import structlog

from daemon.devices.devicethread import DeviceThread, Revoked, Session
from daemon.scans.method import Circle, Motion
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.stage import Stage, StageState, StageStatus

CALL_S = 5.0
"""Deadline of a call that does not wait for the motion's end."""
HOME_S = 120.0
"""Deadline of homing: the longest travel at the slowest seek."""
_BEAT_S = 0.5  # between two signs of life while it homes
_PUMP_S = 0.05  # how often the planner is filled
_JOIN_S = 2 * CALL_S

_Leg = Callable[[Stage], None]
_Legs = Iterator[_Leg]

log = structlog.get_logger(__name__)


def require_homed(
    stage: DeviceThread[Stage], session: Session, beat: Callable[[], None]
) -> StageStatus:
    """Home the stage if its position is not known; its status. `beat` is called meanwhile.

    Raises DeviceRefused for a stage in alarm: somebody must look first.
    """
    status = stage.call(lambda s: s.status(), CALL_S, session)
    if status.state is StageState.ALARM:
        raise DeviceRefused(
            stage.device.name,
            "scan",
            f"it is in alarm: {status.detail}" if status.detail else "it is in alarm",
            "look at it, then `umbra stage unlock`; a scan homes it",
        )
    known = status.state not in {StageState.UNKNOWN, StageState.HOMING}
    if known and status.position_mm is not None:
        return status
    log.info("the stage is homed first")
    homing = stage.submit(lambda s: s.home(HOME_S), HOME_S + CALL_S, session)
    while not wait([homing], _BEAT_S).done:
        beat()
        stage.halt_revoked()
    homing.result()
    return stage.call(lambda s: s.status(), CALL_S, session)


class Mover:
    """One motion of the rig's stage. `begin` and `end` are called from the sequencer's thread."""

    def __init__(
        self,
        stage: DeviceThread[Stage],
        motion: Motion,
        session: Session,
        *,
        beat: Callable[[], None],
        wake: Callable[[], None],
    ) -> None:
        """`beat` is called while homing goes on, `wake` when the stage has failed."""
        self._stage = stage
        self._motion = motion
        self._session = session
        self._beat = beat
        self._wake = wake
        self._ending = threading.Event()
        self._over = threading.Event()
        self._failure: BaseException | None = None
        self._thread: threading.Thread | None = None

    @property
    def over(self) -> bool:
        """Whether a motion that has an end has come to it."""
        return self._over.is_set()

    def begin(self) -> None:
        """Home the stage if its position is not known, and set it going.

        Raises DeviceRefused for a stage in alarm: somebody must look first. Not repeated: what a
        stage refuses once it refuses again.
        """
        status = require_homed(self._stage, self._session, self._beat)
        if status.state is not StageState.IDLE:
            self._stage.call(lambda s: s.stop(), CALL_S, self._session)
        self._approach()
        legs = self._legs()
        self._stage.call(next(legs), CALL_S, self._session)
        self._thread = threading.Thread(target=self._follow, args=(legs,), name="umbra-mover")
        self._thread.start()

    def end(self) -> None:
        """End the motion: the stage decelerates and stands. Idempotent; does not raise."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        try:
            if not self._session.ended.is_set() and self._failure is None:
                self._stage.call(lambda s: s.stop(), CALL_S, self._session)
        except Revoked:
            pass  # the safe state, which follows a revocation, holds it
        except DeviceError as error:
            self._failure = error
            log.warning("the stage did not stop as told", problem=str(error))

    def check(self) -> None:
        """Raise what went wrong with the stage, if anything did."""
        if self._failure is not None:
            raise self._failure

    def position_at(self, at_ns: int) -> tuple[float, float] | None:
        """Where the stage was at a moment of the clock; None: not known."""
        return self._stage.device.position_at(at_ns)

    # ------------------------------------------------------------ the stage's side

    def _approach(self) -> None:
        """To where the motion begins, as fast as the stage goes."""
        motion, fastest = self._motion, self._stage.device.info().max_feed_mm_s
        if isinstance(motion, Circle):
            first = (motion.centre_mm[0] + motion.radius_mm, motion.centre_mm[1])
        else:
            first = motion.points_mm[0]
        self._stage.call(_to(first, fastest), CALL_S, self._session)
        while not self._session.ended.wait(_PUMP_S):
            self._beat()
            status = self._stage.call(lambda s: s.pump(), CALL_S, self._session)
            if status.state is not StageState.MOVING:
                return
        self._session.check()

    def _legs(self) -> _Legs:
        motion = self._motion
        if isinstance(motion, Circle):
            centre, radius, feed = motion.centre_mm, motion.radius_mm, motion.feed_mm_s
            return iter([lambda s: s.circle(centre, radius, feed, math.inf)])
        feed = motion.feed_mm_s
        return (_to(point, feed) for point in motion.points_mm[1:])

    def _follow(self, legs: _Legs) -> None:
        try:
            while not self._ending.wait(_PUMP_S):
                status = self._stage.call(lambda s: s.pump(), CALL_S, self._session)
                if status.state is StageState.IDLE:
                    leg = next(legs, None)
                    if leg is None:
                        self._over.set()
                        return
                    self._stage.call(leg, CALL_S, self._session)
                elif status.state is not StageState.MOVING:
                    raise DeviceRefused(
                        self._stage.device.name,
                        "scan",
                        f"it stopped: it is {status.state}"
                        + (f", {status.detail}" if status.detail else ""),
                        "mend that and home it, then `umbra resume`",
                    )
        except Revoked:
            return
        except DeviceError as error:
            self._failure = error
            self._wake()


def _to(point: tuple[float, float], feed: float) -> _Leg:
    return lambda stage: stage.move(*point, feed)
