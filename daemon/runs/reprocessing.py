"""One run made from another's frames, in a thread of its own and without a device.

    parent's frames ──> (its observations, or decided again) ──> fresh estimator ──> products

What the parent recorded is only read: pixels with their checksums, and what each frame was used
for. Where nothing changes the result is therefore the parent's, bit for bit. The new run keeps its
own frames.jsonl, for frames may be used differently in it, and no pixels. It is as quick as the
disk and the estimator, so an interruption is not gone on with: it begins anew. While a scan is
under way it takes a quarter of its time, for a scan's frames cannot wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from itertools import count, takewhile
from typing import Any

import msgspec
import structlog

from daemon.exposing.control import Control
from daemon.exposing.unusable import named
from daemon.products import separated
from daemon.runs.ending import close, end_of, utc_now, with_exposure
from daemon.runs.failures import as_error
from daemon.runs.preparation import as_exposed
from daemon.runs.standing import Standing
from daemon.scans.catalog import method_for
from daemon.scans.method import (
    INCOMPLETE,
    Bench,
    Circle,
    Expose,
    Method,
    Step,
    Taken,
    Unsuitable,
    Watch,
)
from daemon.separation.estimator import Components, NotYet, Result
from daemon.storage.durable import storage
from daemon.storage.frames import ARRAY, LINES, FrameRecord, FrameStore
from daemon.storage.ledger import Ledger, Tally
from daemon.storage.runfolder import RunFile, RunFolder
from daemon.storage.store import Store, estimate_bytes
from drivers.clock import RealClock
from protocol.errors import Code, UmbraError
from protocol.messages.runs import End, Progress, RunState
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import Mesh

_SHARE = 0.25
"""Of its thread's time while a scan is under way: the scan's frames cannot wait, these can."""
_GROUP_FRAMES = 256
"""Records that are made durable together: a crash costs nothing, for all of it is done again."""

log = structlog.get_logger(__name__)


class _Ended(Exception):
    """Somebody has ended the run; `Control.verdict` says why."""


class Reprocessing:
    """The execution of one run. `execute` is its thread; all else may be called from any other."""

    def __init__(
        self,
        folder: RunFolder,
        *,
        store: Store,
        busy: Callable[[], bool],
        on_change: Callable[[], None],
        on_progress: Callable[[Progress], None],
    ) -> None:
        """`busy` says whether a scan is under way, which is to be left the machine."""
        self.folder = folder
        self.control = Control()
        self.standing = Standing(folder, RealClock(), on_change=on_change, on_progress=on_progress)
        self.standing.counts = self
        self.summary: Mapping[str, float] = {}
        self._ledger = Ledger()
        self._busy = busy
        self._store = store
        self._estimating = threading.Lock()
        self._conclude: Callable[[], Result] | None = None
        self._timings: dict[str, float] = {}

    # ------------------------------------------------------------ for others

    @property
    def tally(self) -> Tally:
        """What has become of the parent's frames so far."""
        return self._ledger.tally

    def result(self) -> Result:
        """The result from the frames so far. Raises UmbraError(no_result)."""
        conclude = self._conclude
        if conclude is None:
            raise UmbraError(Code.NO_RESULT, f"{self.folder.id} has taken in no frames yet")
        try:
            return conclude()
        except NotYet as error:
            raise UmbraError(Code.NO_RESULT, str(error)) from error

    # ------------------------------------------------------------ the thread

    def execute(self) -> End:
        """Run to the end; never raises."""
        structlog.contextvars.bind_contextvars(run=self.folder.id)
        try:
            end = self._execute()
        except _Ended:
            end = self.control.verdict or End(state=RunState.INTERRUPTED, reason="it was ended")
        except Exception as error:
            known = as_error(error)
            if known.code is Code.INTERNAL:
                log.exception("reprocessing failed")
            end = End(state=RunState.FAILED, reason=known.message, code=known.code)
        close(self.folder, end, self._timings)
        self.standing.changed()
        return end

    def _execute(self) -> End:
        began = time.monotonic()
        file = self.folder.file
        source = source_of(self.folder, self._store)
        method, again = method_of(file, source.file)
        self.standing.update(state=RunState.RUNNING, started=utc_now(), ended="", end=None)
        self.standing.say("reading the frames of " + source.id)
        frames = frames_of(source)
        if not self._store.room_for(estimate_bytes(*_form(frames), len(frames), pixels=False)):
            raise UmbraError(
                Code.STORAGE_FULL,
                f"{self._store.data}: there is no room for the products beyond the reserve: "
                "delete old runs, then `umbra resume`",
            )
        if again:
            log.info("what each frame is used for is decided again")
        self.standing.begins(len(frames))
        own = self._records(frames)
        try:
            lost = self._take_in(frames, own, method, again=again)
        finally:
            own.close()
            frames.close()
            tally = self.tally
            self.folder.update(
                recorded=tally.recorded, missing=tally.missing, rejected=tally.rejected
            )
        self._timings["scan_s"] = time.monotonic() - began
        return self._finish(method.bench, source, lost)

    def _records(self, frames: FrameStore) -> FrameStore:
        """An empty frames.jsonl: what an interruption left of one is done again."""
        with storage("beginning anew"):
            (self.folder.path / LINES).unlink(missing_ok=True)
        shape, dtype = _form(frames)
        return FrameStore.create(self.folder.path, shape, dtype, pixels=False)

    def _take_in(
        self, frames: FrameStore, own: FrameStore, method: Method[Any], *, again: bool
    ) -> dict[int, str]:
        """Every frame, in order, into a fresh estimator; gives the patterns that have none, and
        why."""
        estimator = method.estimator()

        def conclude() -> Result:
            with self._estimating:
                result = estimator.result()
            return method.conclude(result) if isinstance(result, Components) else result

        if method.bench.camera.recorded:
            records = frames.records()[: len(frames)]
            method.foresee(frames.read(r.index) for r in records if not r.missing)
        scratch = None
        at: tuple[int, Step] | None = None
        for record in frames.records()[: len(frames)]:  # it may be resumed meanwhile
            began = time.monotonic()
            if self.control.verdict is not None:
                raise _Ended
            if at is None or record.step != at[0]:
                at = record.step, _as_shown(method, record, self.summary)
            step = at[1]
            if record.missing:
                method.observe(step, _taken(record, None))  # as when it did not come
                self._note(own.append_missing(record))
                continue
            scratch = frames.read(record.index, out=scratch)
            with named(record.index, record.source):
                if again:
                    observation = method.observe(step, _taken(record, scratch))
                else:
                    observation = record.observation
                    method.recall(scratch, observation)
            kept = own.append(scratch, msgspec.structs.replace(record, observation=observation))
            with self._estimating, named(record.index, record.source):
                estimator.update(scratch, observation)
                self.summary = estimator.summary()
            self._conclude = conclude
            if len(own) % _GROUP_FRAMES == 0:
                own.commit()
            self._note(kept)
            self._give_way(time.monotonic() - began)
        own.commit()
        return self._ledger.lost_patterns

    def _note(self, record: FrameRecord) -> None:
        self._ledger.note(record)
        self.standing.taken(self.tally)

    def _give_way(self, took_s: float) -> None:
        """After a frame that took so long: beside a scan, leave it the rest of the time."""
        if self._busy():
            self.control.news.wait(took_s * (1.0 / _SHARE - 1.0))  # an end is not waited for

    def _finish(self, bench: Bench, source: RunFolder, lost: dict[int, str]) -> End:
        file = self.folder.file
        if self._conclude is None:
            raise UmbraError(Code.NO_RESULT, f"{source.id} has no frames: scan again")
        self.standing.update(state=RunState.FINISHING)
        self.standing.say("writing products")
        began = time.monotonic()
        result = with_exposure(self._conclude(), file.rig)
        self._timings["separate_s"] = time.monotonic() - began
        pixel_format = bench.camera.pixel_format
        made = separated.write(
            self.folder,
            result,
            full_scale=pixel_format.full_scale,
            pixel_format=pixel_format,
            timings=self._timings,
            frames=source.path,
        )
        self.folder.add_products(made)
        self._timings["products_s"] = time.monotonic() - began
        return end_of(lost, f"made from {file.parents[0]}")


# ---------------------------------------------------------------- what is to be read, and how


def source_of(run: RunFolder, store: Store) -> RunFolder:
    """The run whose frames these are: itself, or what it was made from.

    Raises UmbraError where its frames cannot be read again, with the remedy.
    """
    source = store.open(run.file.parents[-1]) if run.file.reprocessed else run
    if not source.file.state.ended:
        raise UmbraError(
            Code.WRONG_STATE,
            f"{source.id} is {source.file.state}: it can be reprocessed when it has ended",
        )
    if not (source.path / LINES).exists():
        raise UmbraError(Code.NO_RESULT, f"{source.id} has taken no frames: scan again")
    if not (source.path / ARRAY).is_dir():
        raise UmbraError(
            Code.FRAMES_MISSING,
            f"{source.id} keeps no pixels ([storage] keep_frames = false): separate the "
            "recording again (`umbra separate`), or scan again",
        )
    if source.file.bench is None:
        raise UmbraError(
            Code.UNSUITABLE,
            f"{source.id} does not say what its method knew of the rig, for an older umbrad made "
            "it: scan again",
        )
    return source


def frames_of(source: RunFolder) -> FrameStore:
    """Its frames, for reading only. Raises Damaged, StorageError."""
    return FrameStore.open(source.path, readonly=True)


def method_of(file: RunFile, source: RunFile) -> tuple[Method[Any], bool]:
    """The method that reads the source's frames as a run's spec says, and whether it decides anew
    what each is used for. Raises UmbraError, Unsuitable."""
    then = method_for(_as_exposed(source.spec, source), _bench(source))
    spec = _as_moved(_as_exposed(file.spec, source), then)
    method = method_for(spec, _bench(file))
    return method, not method.decides_as(then)


def _as_exposed(spec: AnyScan, source: RunFile) -> AnyScan:
    return as_exposed(spec, source.rig.get("settings", {}))


def _as_moved(spec: AnyScan, then: Method[Any]) -> AnyScan:
    """A mesh that is made otherwise has still gone round as it was planned at the time."""
    if not isinstance(spec, Mesh):
        return spec
    steps = takewhile(bool, (then.step(index, {}) for index in count()))
    motion = next((step.motion for step in steps if isinstance(step, Watch)), None)
    if not isinstance(motion, Circle):
        return spec
    return msgspec.structs.replace(
        spec,
        radius_mm=motion.radius_mm,
        centre_mm=motion.centre_mm,
        feed_mm_s=motion.feed_mm_s,
    )


def _bench(file: RunFile) -> Bench:
    """What the method is told of the rig. Raises UmbraError(unsuitable)."""
    try:
        return Bench.of(file.bench or {}, (file.calibration or {}).get("values", {}))
    except msgspec.ValidationError as error:
        raise UmbraError(
            Code.UNSUITABLE, f"{file.id}: what its method knew of the rig cannot be read ({error})"
        ) from error


def _as_shown(method: Method[Any], record: FrameRecord, summary: Mapping[str, float]) -> Step:
    """The step that a frame was taken for. Raises Unsuitable where it is not what was shown."""
    step = method.step(record.step, summary)
    shown = step.pattern if isinstance(step, Expose) else None
    if step is None or shown != record.pattern:
        raise Unsuitable(
            f"frame {record.index} shows another pattern than {method.name} has at its place in "
            "this version of umbrad: reprocess it with the one that took it, or scan again"
        )
    return step


def _taken(record: FrameRecord, pixels: Any) -> Taken:
    return Taken(
        step=record.step,
        sub=record.sub,
        incomplete=bool(record.missing) or record.observation.reason == INCOMPLETE,
        source=record.source,
        pixels=pixels,
        delay_us=record.observation.delay_us,
        exposure_us=record.exposure_us,
    )


def _form(frames: FrameStore) -> tuple[tuple[int, ...], Any]:
    """Shape and dtype of the frames, which are kept: see `source_of`."""
    assert frames.shape is not None
    assert frames.dtype is not None
    return frames.shape, frames.dtype
