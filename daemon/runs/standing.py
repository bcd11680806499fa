"""How a run stands: its state, how far it is, and whether it moves, as everybody else is told."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from daemon.storage.durable import StorageError
from daemon.storage.ledger import Tally
from daemon.storage.runfolder import RunFolder
from drivers.clock import NS, Clock
from protocol.errors import Code
from protocol.messages.runs import Progress, RunState, Waiting

_PROGRESS_S = 0.1
"""Progress is told no more often."""
_RATE_FRAMES = 20
"""The rate is that of so many frames, the last ones."""
_STILL_S = 60.0
"""A scan that shows no sign of life for so long hangs: every wait in it has a shorter deadline."""
_CONCLUDE_S = 600.0
"""The same while products are written, which gives no sign of life until it is done."""


class Counts(Protocol):
    """Whoever counts a run's frames: its `Recorder`, or its `Reprocessing`."""

    @property
    def tally(self) -> Tally:
        """What has become of the frames so far."""

    @property
    def summary(self) -> Mapping[str, float]:
        """The estimator's figures so far."""


class Standing:
    """Of one run. Told by its threads, asked by any."""

    def __init__(
        self,
        folder: RunFolder,
        clock: Clock,
        *,
        on_change: Callable[[], None],
        on_progress: Callable[[Progress], None],
    ) -> None:
        """Both are called from whatever thread has something to tell."""
        self.counts: Counts | None = None  # until there are frames to count
        self._folder = folder
        self._clock = clock
        self._on_change = on_change
        self._on_progress = on_progress
        self._planned: int | None = None
        self._phase = "preparing"
        self._waits: Waiting | None = None
        self._moments: deque[tuple[int, int]] = deque(maxlen=_RATE_FRAMES + 1)
        self._told = 0.0
        self._exposure_s = 0.0  # the longest
        self._beat = time.monotonic()

    # ------------------------------------------------------------ asked

    def progress(self) -> Progress:
        """How far it is, now."""
        counts, planned = self.counts, self._planned
        tally = counts.tally if counts else Tally()
        summary = dict(counts.summary) if counts else {}
        fraction = summary.get("coverage") if planned is None else tally.taken / max(planned, 1)
        rate = self.rate()
        left = None if planned is None or not rate else max(0, planned - tally.taken) / rate
        return Progress(
            run=self._folder.id,
            state=self._folder.file.state,
            recorded=tally.recorded,
            planned=planned,
            missing=tally.missing,
            rejected=tally.rejected,
            fraction=fraction,
            rate_hz=rate,
            remaining_s=left,
            phase=self._phase,
            summary=summary,
            waits=self._waits,
        )

    def rate(self) -> float:
        """Frames a second, of late; 0: not known."""
        moments = list(self._moments)
        if len(moments) < 2 or moments[-1][0] == moments[0][0]:
            return 0.0
        return (moments[-1][1] - moments[0][1]) / (moments[-1][0] - moments[0][0]) * NS

    @property
    def alive(self) -> bool:
        """Whether it has moved lately. In a pause there is nothing to move."""
        state = self._folder.file.state
        limit = _CONCLUDE_S if state is RunState.FINISHING else _STILL_S + 2 * self._exposure_s
        if state is RunState.WAITING:
            limit += self._folder.file.spec.ready.look_s
        return state is RunState.PAUSED or time.monotonic() - self._beat < limit

    # ------------------------------------------------------------ told

    def live(self) -> None:
        """A sign of life."""
        self._beat = time.monotonic()

    def looking(self, exposure_s: float) -> None:
        """A picture is taken before the first frame, and comes no sooner than after so long."""
        self._exposure_s = exposure_s
        self.live()

    def waiting(self, waits: Waiting) -> None:
        """It waits for something before its first frame: said at each look."""
        self._waits = waits
        self.live()
        if self._folder.file.state is not RunState.WAITING:
            self.note(state=RunState.WAITING)
        self.say(f"waiting for {waits.what}: {waits.seen}")

    def begins(self, planned: int | None, exposure_s: float = 0.0) -> None:
        """It waits no more: so many frames are planned (None: until there is enough), the longest
        exposure of which takes `exposure_s`."""
        self._planned, self._exposure_s, self._waits = planned, exposure_s, None

    def taken(self, tally: Tally) -> None:
        """The estimator has taken one more frame in."""
        self._moments.append((self._clock.now_ns(), tally.taken))
        self._tell(at_once=tally.taken == self._planned)

    def replayed(self) -> None:
        """The estimator has taken in one more frame of before the interruption."""
        self._tell(at_once=False)

    def _tell(self, *, at_once: bool) -> None:
        now = self._beat = time.monotonic()
        if at_once or now - self._told >= _PROGRESS_S:
            self._told = now
            self._on_progress(self.progress())

    def goes_on(self) -> None:
        """A pause is over. Raises StorageError."""
        self._moments.clear()
        self.update(state=RunState.RUNNING)
        self.say("scanning")

    def say(self, phase: str) -> None:
        """What it is doing, in words."""
        self._phase = phase
        self._on_progress(self.progress())

    def update(self, **changes: Any) -> None:
        """Change fields of run.json. Raises StorageError."""
        self.live()
        self._folder.update(**changes)
        self.changed()

    def note(self, **changes: Any) -> None:
        """Change fields which a full disk must not keep from being known: what it refuses is
        written later (`Runner.tend`). Raises StorageError for any other failure."""
        try:
            self.update(**changes)
        except StorageError as error:
            if error.code is not Code.STORAGE_FULL:
                raise
            self._folder.remember(**changes)
            self.changed()

    def changed(self) -> None:
        """Tell that run.json, or what is remembered of it, has changed."""
        self._on_change()
