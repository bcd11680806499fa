"""The queue, and the life of a run: which one is next, and what people may do to it.

Commands may come from any thread; runs are begun from the loop only (`RunLoop`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import ClassVar

import structlog

from daemon.config import RigConfig
from daemon.devices.lightmeter import require_meterable
from daemon.devices.rig import Rig
from daemon.exposing.modes import choose
from daemon.pictures.viewfinder import Viewfinder
from daemon.runs.course import Course
from daemon.runs.ending import utc_now
from daemon.runs.failures import as_error
from daemon.runs.runloop import RunLoop, require_queued, wrong_state
from daemon.scans.catalog import method_for
from daemon.scans.method import Unsuitable
from daemon.storage.frames import count
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from drivers.base.errors import DeviceError
from protocol.errors import Code, UmbraError
from protocol.messages.events import AnyEvent, Progressed, QueueChanged, RunChanged
from protocol.messages.runs import End, RunState
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import OccluderScan

_UNFINISHED = {RunState.RUNNING, RunState.PAUSED, RunState.FINISHING}

_TOO_FEW = {Code.FRAMES_MISSING, Code.NO_RESULT}
"""What a video fails with that goes on where it ended, if it is resumed."""

LOCK = "lock"
"""A reason to hold the queue, except for runs of whoever holds the rig."""

log = structlog.get_logger(__name__)


class Runner(RunLoop[Course]):
    """Runs what is queued, one at a time, in order; everything it knows is in the store."""

    resumable: ClassVar[Collection[Code]] = {
        Code.DEVICE_LOST,
        Code.DEVICE_TIMEOUT,
        Code.DEVICE_REFUSED,
        Code.DEVICE_GARBLED,
        Code.STORAGE_FULL,
        Code.STORAGE_FAILED,
        Code.NOT_READY,
    }

    def __init__(
        self,
        *,
        rig: Rig,
        store: Store,
        config: RigConfig,
        viewfinder: Viewfinder,
        publish: Callable[[AnyEvent], None],
        on_activity: Callable[[], None],
        make_way: Callable[[], None],
    ) -> None:
        """`publish` and `on_activity` must be safe to call from any thread; `make_way` ends manual
        work before a run and may block."""
        super().__init__(store, config, thread="umbra-sequencer")
        self._rig = rig
        self._viewfinder = viewfinder
        self._publish = publish
        self._on_activity = on_activity
        self._make_way = make_way
        self._held: set[str] = set()
        self._of_holder: set[str] = set()  # runs submitted by whoever holds the rig
        self._unwritten: set[str] = set()  # runs whose state a full disk has refused

    # ------------------------------------------------------------ the loop

    def recover(self) -> None:
        """After a start: runs that were under way were interrupted, whatever ended the daemon; one
        that only waited has lost nothing, and goes on waiting."""
        for run in self._store.runs():
            if run.file.state is RunState.WAITING:
                run.remember(state=RunState.QUEUED)
                log.info("run goes on waiting", run=run.id)
            elif run.file.state in _UNFINISHED:
                reason = "umbrad ended while the run was under way; `umbra resume` goes on with it"
                end = End(state=RunState.INTERRUPTED, reason=reason)
                found, how = count(run.path), run.file.sequencing
                run.remember(
                    state=RunState.INTERRUPTED,
                    ended=utc_now(),
                    end=end,
                    recorded=found.tally.recorded,
                    missing=found.tally.missing,
                    sequencing=how and {**how, "counts": dict(found.exposing)},
                )
                log.warning("run interrupted", run=run.id)
        self.tend()

    def tend(self) -> None:
        """Call now and then: write states that a full disk refused. Blocks for an fsync if so."""
        for run in self._store.runs():
            if run.unwritten:
                try:
                    run.flush()
                except UmbraError as error:
                    if run.id not in self._unwritten:
                        log.warning(
                            "a run's state is not written yet", run=run.id, error=str(error)
                        )
                    self._unwritten.add(run.id)
                else:
                    self._unwritten.discard(run.id)

    def wake(self) -> None:
        """Look again whether a run can begin, or go on that waits; from any thread."""
        if (course := self._execution) is not None:
            course.control.news.set()
        super().wake()

    @property
    def waits_for(self) -> str:
        """Why runs wait although none is under way; "" if they don't."""
        if not self._store.queued():
            return ""
        try:
            self._rig.require_ready()
        except UmbraError as error:
            return error.message
        return ", ".join(sorted(self._held))

    def _next(self) -> RunFolder | None:
        if self._stopping or self._held - {LOCK}:
            return None
        waiting = self._store.queued()
        if LOCK in self._held:
            waiting = [run for run in waiting if run.id in self._of_holder]
        if not waiting:
            return None
        if not self._rig.ready and not waiting[0].file.spec.ready.deadline_s:
            return None  # a device that is away fails no run that has not begun
        return waiting[0]

    def _execution_of(self, run: RunFolder) -> Course:
        def changed() -> None:
            self._publish(RunChanged(run=run.info()))
            self._on_activity()  # the rig's state is another one with it

        return Course(
            run,
            rig=self._rig,
            store=self._store,
            config=self._config,
            viewfinder=self._viewfinder,
            on_change=changed,
            on_progress=lambda p: self._publish(Progressed(progress=p)),
        )

    def _execute(self, execution: Course) -> None:
        log.info("run begins", run=execution.folder.id)
        self._on_activity()
        self._clear_the_way()
        execution.execute()

    def _ended(self) -> None:
        self._publish(QueueChanged(queue=tuple(r.id for r in self.queue())))
        self._on_activity()

    def _clear_the_way(self) -> None:
        """End manual work; where that fails the course finds the rig in use, and says so."""
        try:
            self._make_way()
        except (UmbraError, DeviceError) as error:
            log.warning("manual work did not end", error=str(error))

    def stop(self) -> None:
        """For shutdown: the current run is interrupted, and can be resumed after a restart."""
        super().stop()
        if (course := self.under_way) is not None:
            course.control.end(RunState.INTERRUPTED, "umbrad was stopped; `umbra resume` goes on")
            self._rig.make_safe()

    def hold(self, why: str) -> None:
        """Begin no run for as long as `why` is not released; during a LOCK only its holder's."""
        self._held.add(why)

    def release(self, why: str) -> None:
        """The reason to hold is gone."""
        if why not in self._held:
            return
        self._held.discard(why)
        if why == LOCK:
            self._of_holder.clear()
        self.wake()

    def end_for_estop(self, by: str) -> None:
        """The devices have been stopped: the current run ends as aborted."""
        if self._execution is not None:
            self._execution.control.end(RunState.ABORTED, "emergency stop", by=by)

    # ------------------------------------------------------------ what is going on

    @property
    def alive(self) -> bool:
        """Whether the run under way, if any, has moved lately (the watchdog's question)."""
        course = self.under_way
        return course is None or course.standing.alive

    @property
    def current(self) -> RunFolder | None:
        """The run under way."""
        course = self.under_way
        return course.folder if course else None

    def queue(self) -> list[RunFolder]:
        """The runs that wait, the next first."""
        current = self.current
        return [run for run in self._store.queued() if run is not current]

    def find(self, run: str) -> RunFolder:
        """A run by its id; "" is the current, else the newest. Raises UmbraError(unknown_run)."""
        if run:
            return self._store.open(run)
        if (current := self.current) is not None:
            return current
        newest = next(iter(self._store.runs()), None)
        if newest is None:
            raise UmbraError(Code.UNKNOWN_RUN, "there is no run yet; `umbra scan` makes one")
        return newest

    # ------------------------------------------------------------ commands

    def submitted(self, request_id: str) -> RunFolder | None:
        """The run that a request has made before, also before a restart."""
        return self._store.find_request(request_id)

    def submit(
        self, spec: AnyScan, by: str, request_id: str, *, first: bool, holder: bool
    ) -> RunFolder:
        """Queue a scan, durably. Raises UmbraError when the rig cannot do it as it is now.

        Safe to repeat with the same `request_id`, also after a restart.
        """
        if (known := self._store.find_request(request_id)) is not None:
            return known
        if self._rig.ready or not spec.ready.deadline_s:  # else it is looked at when they are there
            try:
                bench = self._rig.bench()
                method_for(spec, bench)
                require_meterable(spec, bench)
                exposure_us = spec.exposure_us or bench.exposure_us or 0.0
                choose(spec, self._config.sequencer, bench, exposure_us)
            except Unsuitable as error:
                raise as_error(error) from error
        run = self._store.create(
            spec, self._rig.snapshot(), by=by, request_id=request_id, first=first
        )
        if holder:
            self._of_holder.add(run.id)
        log.info("run queued", run=run.id, by=by)
        self._queue_changed(run)
        return run

    def move(self, run: str, to: int) -> list[RunFolder]:
        """Put a waiting run at another place; gives the new queue."""
        moved = self._store.open(run)
        require_queued(moved, "moved in the queue")
        rest = [r for r in self.queue() if r.id != moved.id]
        rest.insert(min(to, len(rest)), moved)
        for order, waiting in enumerate(rest):
            if waiting.file.order != order:
                waiting.update(order=order)
        self._publish(QueueChanged(queue=tuple(r.id for r in rest)))
        return rest

    def pause(self, run: str) -> RunFolder:
        """Pause the current run after the step under way."""
        course = self._running(run)
        if course.folder.file.state is not RunState.RUNNING:
            raise wrong_state(course.folder, "paused")
        course.control.pause("asked for by an operator")
        return course.folder

    def resume(self, run: str) -> RunFolder:
        """Go on with the paused run, or queue an interrupted one again, ahead of the others."""
        course = self.under_way
        if not run and course is None:
            raise UmbraError(
                Code.WRONG_STATE, "no run is paused; name the interrupted one: `umbra resume RUN`"
            )
        folder = self.find(run)
        if course is not None and folder.id == course.folder.id:
            course.resumed()
            return folder
        self._require_resumable(folder)
        orders = [r.file.order for r in self._store.queued()] or [0]
        folder.update(state=RunState.QUEUED, order=min(orders) - 1)
        self._queue_changed(folder)
        return folder

    def abort_current(self, run: str, by: str) -> RunFolder | None:
        """End the run under way, if it is this one; the devices go to their safe state at once.
        Never blocks."""
        course = self.under_way
        if course is None or run not in {"", course.folder.id}:
            return None
        if course.folder.file.state is RunState.FINISHING:
            raise UmbraError(
                Code.WRONG_STATE,
                f"{course.folder.id} has all its frames and is writing its products: the devices "
                "are safe, and it will be done in a moment",
            )
        course.control.end(RunState.ABORTED, "aborted", by=by)
        self._rig.make_safe()
        return course.folder

    def abort(self, run: str, by: str) -> RunFolder:
        """End a run that waits, runs or is paused. Blocks for an fsync."""
        if (current := self.abort_current(run, by)) is not None:
            return current
        if not run:
            raise UmbraError(Code.WRONG_STATE, "no run is under way; name the one: `umbra queue`")
        with self._choosing:
            if (current := self.abort_current(run, by)) is not None:  # it has begun meanwhile
                return current
            waiting = self._store.open(run)
            self._take_from_queue(waiting, by)
        self._queue_changed(waiting)
        return waiting

    def _running(self, run: str) -> Course:
        course = self.under_way
        if course is None or run not in {"", course.folder.id}:
            if run:
                raise wrong_state(self._store.open(run), "paused")
            raise UmbraError(Code.WRONG_STATE, "no run is under way")
        return course

    def _require_resumable(self, run: RunFolder) -> None:
        """Raise UmbraError(wrong_state) unless there is something left to be done in it."""
        file = run.file
        ended = file.end.code if file.end and file.state is RunState.FAILED else ""
        if not (isinstance(file.spec, OccluderScan) and ended in _TOO_FEW):
            super()._require_resumable(run)

    def _queue_changed(self, run: RunFolder) -> None:
        self._publish(RunChanged(run=run.info()))
        self._publish(QueueChanged(queue=tuple(r.id for r in self.queue())))
        self.wake()
