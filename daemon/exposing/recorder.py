"""From a frame to a durable record, an observation, and the estimator.

Two workers in a row, each with a bounded queue: the *recorder* decides what a frame is used for
(`Method.observe`), writes pixels and record, and commits in groups; the *separator* feeds the
estimator and gives the buffer back to the ring. The estimator never sees a frame that the
recorder has not accepted, so replaying the records gives the same bits.

A full disk ends nothing: the frame keeps its buffer, `on_full` waits for room, and it is written
again. Nothing of it was acknowledged.

Hand-over policy: `put` waits while the queue is full. The ring is what bounds it: a stepped scan
waits for a buffer, a video scan that finds none records a gap (see `daemon.exposing.sequencer`).
"""

from __future__ import annotations

import contextvars
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, TypeVar

import structlog

from daemon.exposing.ring import Buffer, Ring
from daemon.exposing.unusable import UNFORESEEN, named
from daemon.scans.method import Expose, Method, Step, Taken
from daemon.separation.estimator import Components, NotYet, Result
from daemon.storage.durable import StorageError
from daemon.storage.frames import FrameRecord, FrameStore
from daemon.storage.ledger import Ledger, Tally
from drivers.base.camera import Frame
from drivers.clock import NS
from protocol.errors import Code

R = TypeVar("R")

_GROUP_FRAMES = 16
_GROUP_S = 0.25
"""A commit comes at the latest after so many frames or seconds; sooner when nothing waits."""
_PATIENCE_S = 0.25  # how often a full queue is tried again, and the other worker looked at

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Exposed:
    """A frame with its place in the scan, or (frame None) the reason why there is none."""

    step: Step
    index: int
    sub: int
    frame: Frame | None
    buffer: Buffer | None = None
    missing: str = ""
    stage_mm: tuple[float, float] | None = None
    lit_ns: int = 0  # from when the light was said to be the step's; 0: not known
    exposing: Mapping[str, int] = field(default_factory=dict)  # see `FrameRecord`


def _iso(utc_ns: int) -> str:
    """UTC nanoseconds as ISO 8601, to the microsecond."""
    return datetime.fromtimestamp(utc_ns / NS, UTC).isoformat(timespec="microseconds")


def _worker(
    name: str, guard: Callable[[Callable[[], None]], None], work: Callable[[], None]
) -> threading.Thread:
    """A thread in the maker's context, so that its log records carry the run's id."""
    context = contextvars.copy_context()
    return threading.Thread(target=context.run, args=(guard, work), name=name)


class Recorder:
    """The two workers of one run. Any failure of theirs is raised by the next call of `put`.

    `on_taken(tally, summary, exposed)` is called after the estimator took a frame in, from the
    separator's thread; `exposed.frame.pixels` may be looked at only within the call. `on_full` is
    called by the recorder's thread when the disk is full: it comes back when there may be room, or
    raises.
    """

    def __init__(
        self,
        method: Method[Any],
        frames: FrameStore,
        ring: Ring,
        on_taken: Callable[[Tally, Mapping[str, float], Exposed], None],
        on_full: Callable[[StorageError], None],
    ) -> None:
        self._method = method
        self._frames = frames
        self._ring = ring
        self._on_taken = on_taken
        self._on_full = on_full
        self._estimator = method.estimator()
        self._failure: BaseException | None = None
        self._summary: Mapping[str, float] = {}
        self.ledger = Ledger()
        """What has become of the frames so far."""
        self._handed = 0  # frames put by the sequencer, and of these ...
        self._taken_in = 0  # ... in the estimator
        self._changed = threading.Condition()
        self._concluding = threading.Lock()  # once the separator has ended anybody may ask
        self._hurried = False
        self._incoming: queue.Queue[Exposed | None] = queue.Queue(maxsize=ring.count + 1)
        self._accepted: queue.Queue[tuple[Exposed, FrameRecord] | Future[Result] | None] = (
            queue.Queue(maxsize=ring.count + 8)
        )
        self._threads = (
            _worker("umbra-recorder", self._guard, self._record),
            _worker("umbra-separator", self._guard, self._separate),
        )

    # ------------------------------------------------------------ for the sequencer

    def replay(self, on_frame: Callable[[], None]) -> tuple[int, int]:
        """Feed the estimator with what an interrupted run recorded; before `start`.

        `on_frame` is called for each and may raise to end it.
        Gives the step and sub-index to go on with. Raises the store's named error for a damaged
        frame.
        """
        position = (0, 0)
        scratch: Buffer | None = None
        for record in self._frames.records():
            on_frame()
            position = (record.step, record.sub + 1)
            if not record.missing:
                scratch = self._frames.read(record.index, out=scratch)
                with named(record.index, record.source):
                    self._method.recall(scratch, record.observation)
                    self._estimator.update(scratch, record.observation)
            self.ledger.note(record)
        self._summary = self._estimator.summary()
        return position

    def start(self) -> None:
        """Begin to take frames."""
        for thread in self._threads:
            thread.start()

    def put(self, exposed: Exposed) -> None:
        """Hand over a frame and its buffer. Raises what went wrong in a worker."""
        while True:
            self.check()
            try:
                self._incoming.put(exposed, timeout=_PATIENCE_S)
            except queue.Full:
                continue
            self._handed += 1
            return

    def check(self) -> None:
        """Raise what went wrong in a worker, if anything did."""
        if self._failure is not None:
            raise self._failure

    @property
    def tally(self) -> Tally:
        """How many frames there are of each kind so far."""
        return self.ledger.tally

    @property
    def summary(self) -> Mapping[str, float]:
        """The estimator's figures after the last frame that it took in."""
        return self._summary

    def hurry(self) -> None:
        """The run ends without a result: frames are made durable and counted, and taken in no
        more. A resumed run takes them in from the disk."""
        self._hurried = True

    def finish(self) -> None:
        """Wait until everything is durable and taken in; the workers end. Raises their failure."""
        if self._threads[0].ident is None:
            return
        while self._threads[0].is_alive():
            try:
                self._incoming.put(None, timeout=_PATIENCE_S)
                break
            except queue.Full:
                continue
        for thread in self._threads:
            thread.join()
        self.check()

    def digested(self, timeout_s: float) -> bool:
        """Wait until all frames handed over so far are in the estimator; False if they are not
        after `timeout_s`. Raises what went wrong in a worker."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while self._taken_in < self._handed:
                self.check()
                if time.monotonic() >= deadline:
                    return False
                self._changed.wait(_PATIENCE_S)
        return True

    # ------------------------------------------------------------ for whoever asks

    def result(self, timeout_s: float) -> Result:
        """The result from the frames taken in so far; from any thread. Raises NotYet."""
        separator = self._threads[1]
        if separator.ident is None:
            raise NotYet("what was recorded before the interruption is being taken in; ask again")
        if not separator.is_alive():
            self.check()
            with self._concluding:
                return self._conclude()
        future: Future[Result] = Future()
        try:
            self._accepted.put(future, timeout=timeout_s)
            return future.result(timeout_s)
        except (queue.Full, TimeoutError):
            raise NotYet("the estimator is busy; ask again") from None

    # ------------------------------------------------------------ the workers

    def _guard(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001 - it is raised again by `put` and `finish`
            if self._failure is None:
                self._failure = error
            log.error("the recorder stopped", error=str(error))  # noqa: TRY400 - raised again
        finally:
            if work == self._record:
                self._hand_over(None)

    def _hand_over(self, item: tuple[Exposed, FrameRecord] | None) -> None:
        """Queue for the separator, unless it has died (its failure is what will be raised)."""
        while True:
            try:
                self._accepted.put(item, timeout=_PATIENCE_S)
            except queue.Full:
                if not self._threads[1].is_alive():
                    return
            else:
                return

    def _record(self) -> None:
        waiting: list[tuple[Exposed, FrameRecord]] = []
        oldest = 0.0
        while True:
            try:
                # Something waits to be durable: take what is there, but wait for nothing.
                exposed = self._incoming.get(block=not waiting)
            except queue.Empty:
                self._commit(waiting)
                continue
            if exposed is None:
                self._commit(waiting)
                return
            if not waiting:
                oldest = time.monotonic()
            waiting.append((exposed, self._accept(exposed)))
            if len(waiting) >= _GROUP_FRAMES or time.monotonic() >= oldest + _GROUP_S:
                self._commit(waiting)

    def _accept(self, exposed: Exposed) -> FrameRecord:
        frame = exposed.frame
        step = exposed.step
        taken = Taken(
            step=exposed.index,
            sub=exposed.sub,
            incomplete=frame is None or frame.incomplete,
            source=frame.source if frame else "",
            pixels=frame.pixels if frame else None,
            delay_us=(frame.start_ns - exposed.lit_ns) / 1e3 if frame and exposed.lit_ns else 0,
            exposure_us=frame.exposure_us if frame else 0.0,
        )
        with named(len(self._frames), taken.source):
            observation = self._method.observe(step, taken)
        record = FrameRecord(
            index=len(self._frames),
            step=exposed.index,
            sub=exposed.sub,
            sequence=frame.sequence if frame else -1,
            start_ns=frame.start_ns if frame else 0,
            end_ns=frame.end_ns if frame else 0,
            utc=_iso(frame.utc_ns) if frame else "",
            exposure_us=frame.exposure_us if frame else 0.0,
            gain=frame.gain if frame else 0.0,
            source=frame.source if frame else "",
            pattern=step.pattern if isinstance(step, Expose) else None,
            stage_mm=exposed.stage_mm,
            observation=observation,
            missing=exposed.missing,
            exposing=dict(exposed.exposing),
        )
        if frame is None:
            return self._frames.append_missing(record)
        return self._when_there_is_room(lambda: self._frames.append(frame.pixels, record))

    def _when_there_is_room(self, write: Callable[[], R]) -> R:
        """Write; on a full disk again and again. Any other failure is raised."""
        while True:
            try:
                return write()
            except StorageError as error:
                if error.code is not Code.STORAGE_FULL or not self._frames.writable:
                    raise
                self._on_full(error)

    def _commit(self, waiting: list[tuple[Exposed, FrameRecord]]) -> None:
        if not waiting:
            return
        again = False

        def commit() -> None:
            nonlocal again
            if again:  # it may have been an fsync that found the disk full, and dropped them
                for exposed, record in waiting:
                    if exposed.frame is not None:
                        self._frames.rewrite(exposed.frame.pixels, record)
            again = True
            self._frames.commit()

        self._when_there_is_room(commit)
        for item in waiting:
            self._hand_over(item)
        waiting.clear()

    def _separate(self) -> None:
        while (item := self._accepted.get()) is not None:
            if isinstance(item, Future):
                self._answer(item)
                continue
            exposed, record = item
            if not self._hurried:
                if exposed.frame is not None:
                    with named(record.index, record.source):
                        self._estimator.update(exposed.frame.pixels, record.observation)
                self._summary = self._estimator.summary()
            self.ledger.note(record)
            with self._changed:
                self._taken_in += 1
                self._changed.notify_all()
            self._on_taken(self.tally, self._summary, exposed)
            if exposed.buffer is not None:
                self._ring.give(exposed.buffer)

    def _conclude(self) -> Result:
        result = self._estimator.result()
        return self._method.conclude(result) if isinstance(result, Components) else result

    def _answer(self, future: Future[Result]) -> None:
        try:
            future.set_result(self._conclude())
        except (NotYet, *UNFORESEEN) as error:  # told to who asks; the scan goes on
            future.set_exception(error)
