"""The data folder: every run is a folder that explains itself, and `run.json` is its first page.

    DATA/umbrad.lock            held by the one daemon that may write here
    DATA/runs/ID/run.json       spec, rig, versions, state, products (`RunFile`)
    DATA/runs/ID/frames.*       see `daemon.storage.frames`
    DATA/runs/ID/...            products

A run's folder appears under its name together with its run.json, and disappears at once: folders
whose names begin with a dot are on their way in or out, and are swept up at the next start.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib.metadata
import math
import os
import platform
import re
import secrets
import shutil
import threading
from collections.abc import Collection
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import DTypeLike

from daemon.storage.durable import atomic_write, fsync_folder, storage
from daemon.storage.runfolder import RunFile, RunFolder, write
from drivers.clock import NS, Clock, RealClock
from protocol.errors import Code, UmbraError
from protocol.messages.envelopes import PROTOCOL
from protocol.messages.runs import RunState
from protocol.scans.anyscan import AnyScan

_ID = re.compile(r"[0-9]{8}-[0-9]{6}-[a-z0-9-]+-[a-z0-9]{4}")
_LETTERS = "abcdefghjkmnpqrstuvwxyz23456789"  # none that are taken for another
_LINE_BYTES = 2048  # of frames.jsonl, a generous guess
_LEAST_RESERVE = 256 << 20


class DataFolderInUse(UmbraError):
    """Another daemon writes to this data folder."""


class Store:
    """A data folder, held by one daemon at a time. Thread-safe.

    `reserve_bytes` of the disk are never promised to a run, so that a run which meets them can be
    paused, and its products still be written.
    """

    def __init__(
        self, data: Path, reserve_bytes: int = _LEAST_RESERVE, clock: Clock | None = None
    ) -> None:
        """Raises DataFolderInUse, StorageError."""
        self.data = data
        self.reserve_bytes = reserve_bytes
        self.damaged: dict[str, str] = {}  # folder -> what is wrong with it
        self._clock = clock or RealClock()
        self._runs = self.runs_folder = data / "runs"
        self._known: dict[str, RunFolder] = {}
        self._lock = threading.RLock()
        self._creating = threading.Lock()
        with storage(f"opening the data folder {data}"):
            self._runs.mkdir(parents=True, exist_ok=True)
            self._held = _hold(data / "umbrad.lock")
            for path in self._runs.glob(".*"):
                if path.is_dir() and not path.is_symlink():  # a file is somebody's: .DS_Store
                    shutil.rmtree(path)
        self.scan()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let another daemon have the folder; idempotent."""
        if self._held >= 0:
            os.close(self._held)
            self._held = -1

    # ------------------------------------------------------------ runs

    def create(
        self,
        spec: AnyScan,
        rig: dict[str, Any],
        by: str = "",
        request_id: str = "",
        *,
        first: bool = False,
        **fields: Any,
    ) -> RunFolder:
        """A new run, queued last (or first), durable on return; `fields` are RunFile's.

        Raises StorageError; then there is no run.
        """
        with self._creating:  # and not the lock that readers take: this waits for the disk
            now = datetime.fromtimestamp(self._clock.utc_ns() / NS, UTC)
            orders = [run.file.order for run in self.queued()] or [0]
            file = RunFile(
                id=self._new_id(now, msgspec.to_builtins(spec)["method"]),
                state=RunState.QUEUED,
                spec=spec,
                submitted=now.isoformat(timespec="microseconds"),
                by=by,
                request_id=request_id,
                order=min(orders) - 1 if first else max(orders) + 1,
                rig=rig,
                **{"versions": versions(), **fields},
            )
            path = self._runs / file.id
            coming = self._runs / f".{file.id}"
            with storage("creating a run"):
                try:
                    coming.mkdir()
                    write(coming, file)
                    coming.rename(path)
                except OSError:
                    shutil.rmtree(coming, ignore_errors=True)
                    raise
                fsync_folder(self._runs)
            run = RunFolder(path, file)
            with self._lock:
                self._known[file.id] = run
            return run

    def open(self, id: str) -> RunFolder:
        """A run by its id. Raises UmbraError(unknown_run), Damaged."""
        with self._lock:
            path = self._runs / id
            if not _ID.fullmatch(id) or not path.is_dir():
                self._known.pop(id, None)
                raise UmbraError(
                    Code.UNKNOWN_RUN, f"there is no run {id!r}; `umbra runs` lists them"
                )
            if id not in self._known:
                self._known[id] = RunFolder.read(path)
            return self._known[id]

    def runs(self) -> list[RunFolder]:
        """All runs, the newest first; from memory. What `scan` could not read is left out."""
        with self._lock:
            known = list(self._known.values())
        return sorted(known, key=lambda run: (run.file.submitted, run.id), reverse=True)

    def scan(self) -> None:
        """Look at the folders anew; those that cannot be read are in `damaged`."""
        with self._lock:
            there = [p for p in self._runs.iterdir() if p.name[0] != "." and p.is_dir()]
            self._known = {p.name: self._known[p.name] for p in there if p.name in self._known}
            self.damaged = {}
            for path in there:
                try:
                    self.open(path.name)
                except UmbraError as error:
                    self.damaged[path.name] = error.message

    def queued(self) -> list[RunFolder]:
        """The scans that wait, the next first."""
        return self._waiting(reprocessed=False)

    def to_reprocess(self) -> list[RunFolder]:
        """The runs that wait to be made from others, the next first."""
        return self._waiting(reprocessed=True)

    def _waiting(self, *, reprocessed: bool) -> list[RunFolder]:
        with self._lock:
            waiting = [
                run
                for run in self._known.values()
                if run.file.state is RunState.QUEUED and run.file.reprocessed is reprocessed
            ]
            return sorted(waiting, key=lambda run: (run.file.order, run.id))

    def find_request(self, request_id: str) -> RunFolder | None:
        """The run that a request has already made: a repeated request gets the same one."""
        with self._lock:
            known = self._known.values()
            return next((r for r in known if request_id and r.file.request_id == request_id), None)

    def expire(
        self, max_age_s: float = math.inf, max_bytes: float = math.inf, keep: Collection[str] = ()
    ) -> list[str]:
        """Delete ended runs older than `max_age_s`, then the oldest while all runs take more than
        `max_bytes`; never one of `keep`, one that has not ended, or a parent of either or of one
        that can be resumed. Gives their ids.

        Raises StorageError; what was deleted until then stays deleted.
        """
        with self._lock:
            runs = self.runs()
            kept = set(keep).union(
                *(run.file.parents for run in runs if run.id in keep or _goes_on(run.file.state))
            )
            now = self._clock.utc_ns() / NS
            sizes = {run.id: run.size() for run in runs}
            total = sum(sizes.values())
            gone = []
            for run in reversed(runs):
                if run.id in kept or not run.file.state.ended:
                    continue
                end = run.file.ended or run.file.submitted
                age = now - datetime.fromisoformat(end).timestamp()
                if age > max_age_s or total > max_bytes:
                    self._delete(run)
                    total -= sizes[run.id]
                    gone.append(run.id)
            return gone

    # ------------------------------------------------------------ marks

    def mark(self, name: str) -> None:
        """Remember durably that something is so, until `unmark`. Raises StorageError."""
        with storage(f"marking {name}"):
            atomic_write(self.data / name, b"")

    def unmark(self, name: str) -> None:
        """It is so no longer; idempotent. Raises StorageError."""
        with storage(f"unmarking {name}"):
            (self.data / name).unlink(missing_ok=True)
            fsync_folder(self.data)

    def marked(self, name: str) -> bool:
        """Whether it was marked, also before a restart."""
        return (self.data / name).exists()

    # ------------------------------------------------------------ room

    def free_bytes(self) -> int:
        """What the disk has free for us, the reserve included."""
        return shutil.disk_usage(self.data).free

    def room_for(self, bytes: int) -> bool:
        """Whether so much can be written without touching the reserve."""
        return self.free_bytes() - self.reserve_bytes >= bytes

    # ------------------------------------------------------------ inside

    def _new_id(self, now: datetime, method: str) -> str:
        while True:
            ending = "".join(secrets.choice(_LETTERS) for _ in range(4))
            id = f"{now:%Y%m%d-%H%M%S}-{method}-{ending}"
            if not (self._runs / id).exists():
                return id

    def _delete(self, run: RunFolder) -> None:
        going = self._runs / f".{run.id}"
        with storage(f"deleting run {run.id}"):
            run.path.rename(going)
            self._known.pop(run.id, None)
            fsync_folder(self._runs)
            shutil.rmtree(going)


def estimate_bytes(
    shape: tuple[int, ...], dtype: DTypeLike, frames: int, pixels: bool = True
) -> int:
    """What a run of so many frames of a shape will take on disk, products included; generous."""
    frame = math.prod(shape) * np.dtype(dtype).itemsize
    products = math.prod(shape) * 4 * 6 + math.prod(shape[:2]) * 16
    return frames * ((frame + (8 << 10) if pixels else 0) + _LINE_BYTES) + products + (4 << 20)


def versions() -> dict[str, str]:
    """What a result depends on: this software, its protocol, and the libraries under it."""
    found = {"python": platform.python_version(), "protocol": str(PROTOCOL)}
    for name in ("umbra-rig", "numpy", "opencv-contrib-python-headless"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def _goes_on(state: RunState) -> bool:
    """Whether a run may still need what it is made from."""
    return not state.ended or state is RunState.INTERRUPTED


def _hold(path: Path) -> int:
    """Lock a file until it is closed, or the process is no more."""
    held = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        pid = os.read(held, 32).decode("ascii", "replace").strip()
        os.close(held)
        raise DataFolderInUse(
            Code.STORAGE_FAILED,
            f"{path.parent} is in use by another umbrad (process {pid or 'unknown'}); "
            "stop it, or give this one a data folder of its own",
        ) from None
    os.truncate(held, 0)
    os.write(held, f"{os.getpid()}\n".encode("ascii"))
    return held
