"""The runs that are made from others, one at a time, beside the queue of scans.

Beside it, for they need no devices: a rig without its camera, or with hours of scans before it,
must not keep anybody from correcting a number. One at a time, so that they take one estimator's
memory, whatever is asked for; and slowly beside a scan (`daemon.runs.reprocessing`). They begin in
the order in which they were submitted, also after a restart.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import structlog

from daemon.config import RigConfig
from daemon.runs.calibration import Calibrations
from daemon.runs.failures import as_error
from daemon.runs.reprocessing import Reprocessing, method_of, source_of
from daemon.runs.runloop import RunLoop
from daemon.scans.method import Unsuitable
from daemon.storage.runfolder import RunFile, RunFolder
from daemon.storage.store import Store
from protocol.errors import Code, UmbraError
from protocol.messages.commands import Reprocess
from protocol.messages.events import AnyEvent, Progressed, RunChanged
from protocol.messages.runs import RunState
from protocol.reading import changed

log = structlog.get_logger(__name__)


class Reprocessor(RunLoop[Reprocessing]):
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
        super().__init__(store, config, thread="umbra-reprocessing")
        self._busy = busy
        self._publish = publish

    # ------------------------------------------------------------ the loop

    def _next(self) -> RunFolder | None:
        return next(iter(self._store.to_reprocess()), None)

    def _execution_of(self, run: RunFolder) -> Reprocessing:
        return Reprocessing(
            run,
            store=self._store,
            busy=self._busy,
            on_change=lambda: self._publish(RunChanged(run=run.info())),
            on_progress=lambda p: self._publish(Progressed(progress=p)),
        )

    def _execute(self, execution: Reprocessing) -> None:
        run = execution.folder
        log.info("reprocessing begins", run=run.id, source=run.file.parents[-1])
        execution.execute()

    def stop(self) -> None:
        """For shutdown: what is under way is interrupted, and what waits begins after a restart."""
        super().stop()
        if (current := self.under_way) is not None:
            reason = "umbrad was stopped; `umbra resume` begins anew"
            current.control.end(RunState.INTERRUPTED, reason)

    # ------------------------------------------------------------ commands

    def mine(self, run: str) -> RunFolder | None:
        """The run of this id, if it is one that is made from another. Raises UmbraError."""
        if not run:
            return None
        folder = self._store.open(run)
        return folder if folder.file.reprocessed else None

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
        self._require_resumable(run)
        source_of(run, self._store)
        run.update(state=RunState.QUEUED)
        self._changed(run)
        return run

    def abort(self, run: RunFolder, by: str) -> RunFolder:
        """End one that waits or is under way. Blocks for an fsync."""
        with self._choosing:
            current = self.under_way
            if current is not None and current.folder.id == run.id:
                if run.file.state is RunState.FINISHING:
                    raise UmbraError(
                        Code.WRONG_STATE,
                        f"{run.id} is writing its products, and will be done in a moment",
                    )
                current.control.end(RunState.ABORTED, "aborted", by=by)
                return run
            self._take_from_queue(run, by)
        self._changed(run)
        return run

    def _changed(self, run: RunFolder) -> None:
        self._publish(RunChanged(run=run.info()))
        self.wake()
