"""The runs that are made from others, one at a time, beside the queue of scans.

Beside it, for they need no devices: a rig without its camera, or with hours of scans before it,
must not keep anybody from correcting a number. One at a time, so that they take one estimator's
memory, whatever is asked for; and slowly beside a scan (`daemon.runs.reprocessing`). They begin in
the order in which they were submitted, also after a restart.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import structlog

from daemon.config import RigConfig
from daemon.runs import aftermath
from daemon.runs.calibration import Calibrations
from daemon.runs.ending import utc_now
from daemon.runs.failures import as_error
from daemon.runs.reprocessing import Reprocessing, method_of, source_of
from daemon.scans.method import Unsuitable
from daemon.storage.runfolder import RunFile, RunFolder
from daemon.storage.store import Store
from protocol.errors import Code, UmbraError
from protocol.messages.commands import Reprocess
from protocol.messages.events import AnyEvent, Progressed, RunChanged
from protocol.messages.runs import End, Progress, RunState
from protocol.reading import changed

_RESUMABLE_CODES = {Code.STORAGE_FULL, Code.STORAGE_FAILED}

log = structlog.get_logger(__name__)


class Reprocessor:
    """Everything that is known of its runs is in the store, as of any other."""

    def __init__(
        self,
        *,
        store: Store,
        config: RigConfig,
        publish: Callable[[AnyEvent], None],
        busy: Callable[[], bool],
    ) -> None:
        """`publish` must be safe to call from any thread, and so must `busy`, which says whether a
        scan is under way."""
        self._busy = busy
        self._store = store
        self._config = config
        self._publish = publish
        self._current: Reprocessing | None = None
        self._choosing = threading.Lock()  # a run is begun or taken from the queue, never both
        self._wake = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping = False

    # ------------------------------------------------------------ the loop

    async def serve(self) -> None:
        """Reprocess what is queued until `stop`."""
        self._loop = asyncio.get_running_loop()
        while not self._stopping:
            self._wake.clear()
            with self._choosing:
                begun = self._begin()
            if begun is None:
                await self._wake.wait()
                continue
            await self._run(begun)
            del begun  # and with it its planes
            await asyncio.to_thread(aftermath.give_back)

    def _begin(self) -> Reprocessing | None:
        waiting = [] if self._stopping else self._store.to_reprocess()
        if not waiting:
            return None
        run = waiting[0]
        self._current = Reprocessing(
            run,
            store=self._store,
            busy=self._busy,
            on_change=lambda: self._publish(RunChanged(run=run.info())),
            on_progress=lambda p: self._publish(Progressed(progress=p)),
        )
        return self._current

    async def _run(self, begun: Reprocessing) -> None:
        loop = asyncio.get_running_loop()
        ended = loop.create_future()

        def execute() -> None:
            try:
                begun.execute()
            finally:
                loop.call_soon_threadsafe(ended.set_result, None)

        log.info("reprocessing begins", run=begun.folder.id, source=begun.folder.file.parents[-1])
        thread = threading.Thread(target=execute, name="umbra-reprocessing")
        thread.start()
        await ended
        thread.join()
        self._current = None
        if not self._stopping:
            await asyncio.to_thread(aftermath.after, begun.folder, self._store, self._config)

    def stop(self) -> None:
        """For shutdown: what is under way is interrupted, and what waits begins after a restart."""
        self._stopping = True
        if (current := self.current) is not None:
            reason = "umbrad was stopped; `umbra resume` begins anew"
            current.control.end(RunState.INTERRUPTED, reason)
        self._wake.set()

    # ------------------------------------------------------------ what is going on

    @property
    def current(self) -> Reprocessing | None:
        """What is under way."""
        current = self._current
        return None if current is None or current.folder.file.state.ended else current

    @property
    def progress(self) -> Progress | None:
        """How far it is."""
        current = self.current
        return current.progress() if current else None

    def mine(self, run: str) -> RunFolder | None:
        """The run of this id, if it is one that is made from another. Raises UmbraError."""
        if not run:
            return None
        folder = self._store.open(run)
        return folder if folder.file.reprocessed else None

    # ------------------------------------------------------------ commands

    def submit(self, asked: Reprocess, by: str, request_id: str) -> RunFolder:
        """Queue it, durably. Raises UmbraError where the run cannot be read so.

        Safe to repeat with the same `request_id`, also after a restart.
        """
        if (known := self._store.find_request(request_id)) is not None:
            return known
        parent = self._store.open(asked.run)
        spec = changed(parent.file.spec, asked.changes)
        source = source_of(parent, self._store)
        fields: dict[str, Any] = {
            "parents": tuple(dict.fromkeys((parent.id, source.id))),
            "planned": source.file.planned,
            "bench": source.file.bench,
            "sequencing": source.file.sequencing,
            "calibration": self._calibration(parent, now=asked.calibration == "now"),
        }
        tried = RunFile(id="", state=RunState.QUEUED, spec=spec, submitted="", **fields)
        try:
            method_of(tried, source.file)[0].estimator()
        except Unsuitable as error:
            raise as_error(error) from error
        run = self._store.create(spec, source.file.rig, by=by, request_id=request_id, **fields)
        log.info("reprocessing queued", run=run.id, source=source.id, by=by)
        self._changed(run)
        return run

    def _calibration(self, parent: RunFolder, *, now: bool) -> dict[str, Any] | None:
        """What was applied to the run; or what says today how frames of it are to be read."""
        then = parent.file.calibration
        if not now:
            return then
        rig = parent.file.rig
        calibrations = Calibrations(self._store, self._config.calibration.max_age_days)
        return calibrations.anew(then or {}, rig, rig.get("settings", {}))

    def resume(self, run: RunFolder) -> RunFolder:
        """Begin an interrupted one anew."""
        file = run.file
        broke = file.state is RunState.FAILED and file.end and file.end.code in _RESUMABLE_CODES
        if file.state is not RunState.INTERRUPTED and not broke:
            raise UmbraError(Code.WRONG_STATE, f"{run.id} is {file.state}: it cannot be resumed")
        source_of(run, self._store)
        run.update(state=RunState.QUEUED)
        self._changed(run)
        return run

    def abort(self, run: RunFolder, by: str) -> RunFolder:
        """End one that waits or is under way. Blocks for an fsync."""
        with self._choosing:
            current = self.current
            if current is not None and current.folder.id == run.id:
                if run.file.state is RunState.FINISHING:
                    raise UmbraError(
                        Code.WRONG_STATE,
                        f"{run.id} is writing its products, and will be done in a moment",
                    )
                current.control.end(RunState.ABORTED, "aborted", by=by)
                return run
            if run.file.state is not RunState.QUEUED:
                raise UmbraError(
                    Code.WRONG_STATE, f"{run.id} is {run.file.state}: it cannot be aborted"
                )
            end = End(state=RunState.ABORTED, reason="taken from the queue", by=by)
            run.update(state=RunState.ABORTED, end=end, ended=utc_now())
        self._changed(run)
        return run

    def _changed(self, run: RunFolder) -> None:
        self._publish(RunChanged(run=run.info()))
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._wake.set)
