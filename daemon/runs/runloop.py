"""What runs of either kind share: they wait in the store, and are executed one at a time."""

from __future__ import annotations

import asyncio
import threading
from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import ClassVar, Generic, Protocol, TypeVar

from daemon.config import RigConfig
from daemon.exposing.control import Control
from daemon.runs import aftermath
from daemon.runs.ending import utc_now
from daemon.runs.standing import Standing
from daemon.separation.estimator import Result
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.errors import Code, UmbraError
from protocol.messages.runs import End, Progress, RunState


class Execution(Protocol):
    """One run in its course: `execute` is its thread, all else may be called from any other."""

    @property
    def folder(self) -> RunFolder:
        """The run."""

    @property
    def control(self) -> Control:
        """What people ask of it."""

    @property
    def standing(self) -> Standing:
        """How far it is."""

    def execute(self) -> End:
        """Run to the end; never raises."""

    def result(self) -> Result:
        """The result from the frames so far. Raises UmbraError(no_result)."""


E = TypeVar("E", bound=Execution)


class RunLoop(ABC, Generic[E]):
    """Executes runs in order, each in a thread of its own.

    `serve` is for the loop, everything else for any thread.
    """

    resumable: ClassVar[Collection[Code]] = {Code.STORAGE_FULL, Code.STORAGE_FAILED}
    """A run that failed of these can go on, as if it had been interrupted."""

    def __init__(self, store: Store, config: RigConfig, *, thread: str) -> None:
        """`thread` names the thread of a run."""
        self._store = store
        self._config = config
        self._thread = thread
        self._execution: E | None = None
        self._choosing = threading.Lock()  # a run is begun or taken from the queue, never both
        self._wake = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping = False

    # ------------------------------------------------------------ the loop

    async def serve(self) -> None:
        """Execute what waits until `stop`."""
        self._loop = asyncio.get_running_loop()
        while not self._stopping:
            self._wake.clear()
            execution = self.begin()
            if execution is None:
                await self._wake.wait()
                continue
            await self._run(execution)
            del execution  # and with it its frames and planes
            await asyncio.to_thread(aftermath.give_back)

    def begin(self) -> E | None:
        """Take the next run that may begin from the queue: it is under way from now on."""
        with self._choosing:
            run = None if self._stopping else self._next()
            self._execution = None if run is None else self._execution_of(run)
            return self._execution

    async def _run(self, execution: E) -> None:
        loop = asyncio.get_running_loop()
        ended = loop.create_future()

        def execute() -> None:
            try:
                self._execute(execution)
            finally:
                loop.call_soon_threadsafe(ended.set_result, None)

        thread = threading.Thread(target=execute, name=self._thread)
        thread.start()
        await ended
        thread.join()
        self._execution = None
        if not self._stopping:
            await asyncio.to_thread(aftermath.after, execution.folder, self._store, self._config)
        self._ended()

    @abstractmethod
    def _next(self) -> RunFolder | None:
        """The run that may begin now, if there is one."""

    @abstractmethod
    def _execution_of(self, run: RunFolder) -> E:
        """How a run is executed."""

    def _execute(self, execution: E) -> None:
        """In the run's thread."""
        execution.execute()

    def _ended(self) -> None:
        """A run has ended, and what follows its end is done."""

    def wake(self) -> None:
        """Look again whether a run can begin."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._wake.set)

    def stop(self) -> None:
        """For shutdown: begin nothing more. From the loop."""
        self._stopping = True
        self._wake.set()

    # ------------------------------------------------------------ what is going on

    @property
    def under_way(self) -> E | None:
        """The execution of the current run, unless that has ended and only the loop has not heard
        of it yet."""
        execution = self._execution
        return None if execution is None or execution.folder.file.state.ended else execution

    @property
    def progress(self) -> Progress | None:
        """How far the run under way is."""
        execution = self.under_way
        return execution.standing.progress() if execution else None

    # ------------------------------------------------------------ what waits

    def _require_resumable(self, run: RunFolder) -> None:
        """Raise UmbraError(wrong_state) unless it was interrupted, or as good as that."""
        file = run.file
        broke = file.state is RunState.FAILED and file.end and file.end.code in self.resumable
        if file.state is not RunState.INTERRUPTED and not broke:
            raise wrong_state(run, "resumed")

    def _take_from_queue(self, run: RunFolder, by: str) -> None:
        """End a run that waits, while `_choosing` is held. Blocks for an fsync."""
        require_queued(run, "aborted")
        end = End(state=RunState.ABORTED, reason="taken from the queue", by=by)
        run.update(state=RunState.ABORTED, end=end, ended=utc_now())


def wrong_state(run: RunFolder, done: str) -> UmbraError:
    """A run cannot be `done` as it is."""
    return UmbraError(Code.WRONG_STATE, f"{run.id} is {run.file.state}: it cannot be {done}")


def require_queued(run: RunFolder, done: str) -> None:
    """Raise UmbraError(wrong_state) unless the run waits."""
    if run.file.state is not RunState.QUEUED:
        raise wrong_state(run, done)
