"""A run's frames: pixels in `frames.zarr`, what is known of each in `frames.jsonl`.

The order of writing is the promise. `append` writes a frame's shard; `commit` makes all shards
since the last one durable, then their names and the array's new length, and only then writes the
lines of `frames.jsonl` that acknowledge them. So a line always has its pixels, and whatever has no
line was never acknowledged: it is removed when the folder is opened again.

Each frame is a shard of its own (`daemon.storage.shards`); a missing one has none, which Zarr reads
as zeros.
"""

from __future__ import annotations

import re
import shutil
import zlib
from array import array
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import DTypeLike, NDArray

from daemon.separation.estimator import Observation
from daemon.storage import journal
from daemon.storage.durable import FULL, Damaged, atomic_write, fsync_file, fsync_folder, storage
from daemon.storage.journal import Journal
from daemon.storage.ledger import Ledger
from daemon.storage.shards import Layout
from protocol.errors import Code, UmbraError
from protocol.patterns import AnyPattern

ARRAY = "frames.zarr"
LINES = "frames.jsonl"
_NO_PIXELS = -1


class FrameRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is known of one frame, or why there is none: a line of frames.jsonl.

    `index` is the frame's place in the run and in the array. `start_ns` and `end_ns` bound the
    exposure on the rig's monotonic clock, `utc` is its start (ISO 8601), `stage_mm` the position
    at its middle. `checksum` is the CRC-32 of the pixels (C order, little endian), in hex.
    `exposing` counts what came since the record before: frames by the way in which they were
    exposed, exposures `repeated`, frames of a stream that were `passed` over.
    """

    index: int
    step: int
    sub: int = 0
    sequence: int = -1
    start_ns: int = 0
    end_ns: int = 0
    utc: str = ""
    exposure_us: float = 0.0
    gain: float = 0.0
    source: str = ""
    pattern: AnyPattern | None = None
    stage_mm: tuple[float, float] | None = None
    observation: Observation
    checksum: str = ""
    missing: str = ""
    exposing: dict[str, int] = {}


class NoPixels(UmbraError):
    """The frame's pixels are not in the run: it is missing, or the run keeps records only."""

    def __init__(self, message: str) -> None:
        super().__init__(Code.FRAMES_MISSING, message)


class FrameStore:
    """The frames of one run. One thread appends and commits; `read` may be called from any.

    Memory is 8 bytes a frame. On a full disk `append` may be repeated when there is room, and
    `commit` after a `rewrite` of what it was to make durable: a full disk may show at an fsync
    only, which has then dropped what was written. After any other failed fsync the store is
    closed, and nothing more is acknowledged until it has been opened again.
    """

    def __init__(self, folder: Path, layout: Layout | None, lines: Journal | None) -> None:
        """Use `create` or `open`."""
        self.folder = folder
        self._layout = layout
        self._lines = lines
        self._checksums = array("q")
        self._pending: list[FrameRecord] = []

    @classmethod
    def create(
        cls, folder: Path, shape: tuple[int, ...], dtype: DTypeLike, pixels: bool = True
    ) -> FrameStore:
        """A new, empty store in a run's folder, for frames of one shape (H, W) or (H, W, 3).

        With `pixels` False only records and checksums are kept, for recordings whose originals
        stay where they are. Raises StorageError, ValueError for a dtype but uint8 and uint16.
        """
        layout = None
        with storage("creating frames.zarr"):
            if pixels:
                layout = Layout(shape, np.dtype(dtype))
                if (folder / ARRAY).exists() and not (folder / LINES).exists():
                    shutil.rmtree(folder / ARRAY)  # left by a crash within this very function
                (folder / ARRAY).mkdir()
                atomic_write(folder / ARRAY / "zarr.json", layout.metadata(0))
            (folder / LINES).touch(exist_ok=False)
        return cls(folder, layout, Journal(folder / LINES))

    @classmethod
    def open(cls, folder: Path, readonly: bool = False) -> FrameStore:
        """An existing store, as it was acknowledged: what a crash left beyond that is removed.

        With `readonly` nothing is changed, and another process may be writing. Raises Damaged,
        naming the frame, when an acknowledged shard is gone or has another length; its checksum is
        compared by `read` and `verify`.
        """
        records = journal.read(folder / LINES, FrameRecord)
        layout = Layout.read(folder / ARRAY) if (folder / ARRAY).is_dir() else None
        store = cls(folder, layout, None)
        for i, record in enumerate(records):
            if record.index != i:
                raise Damaged(f"{folder / LINES}: frame {i} is not there; restore it from a copy")
            store._checksums.append(_NO_PIXELS if record.missing else int(record.checksum, 16))
        if layout:
            store._check_shards(layout)
            if not readonly:
                store._forget_unacknowledged(layout)
        if not readonly:
            store._lines = Journal(folder / LINES)
        return store

    @classmethod
    def begin(
        cls,
        folder: Path,
        shape: tuple[int, ...],
        dtype: DTypeLike,
        *,
        pixels: bool,
        resuming: bool,
    ) -> FrameStore:
        """The store of a run that begins, or (`resuming`) goes on where it has frames already."""
        if resuming and (folder / LINES).exists():
            return cls.open(folder)
        return cls.create(folder, shape, dtype, pixels)

    # ------------------------------------------------------------ writing

    def append(self, pixels: NDArray[Any], record: FrameRecord) -> FrameRecord:
        """Write a frame; it is acknowledged by the next `commit`. `pixels` is not kept.

        Gives the record with its checksum. Raises StorageError (the frame may be appended again),
        ValueError for pixels of another shape or dtype, or an index out of turn.
        """
        self._expect(record)
        data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<"))
        flat = data.reshape(-1).view(np.uint8)
        checksum = zlib.crc32(flat.data)
        if self._layout:
            self._layout.check(pixels)
            self._write(self._layout, data, record)
        record = msgspec.structs.replace(record, checksum=f"{checksum:08x}", missing="")
        self._add(record, checksum)
        return record

    def rewrite(self, pixels: NDArray[Any], record: FrameRecord) -> None:
        """Write a frame again that `append` took and no `commit` has made durable. StorageError."""
        if self._layout and any(pending.index == record.index for pending in self._pending):
            self._write(self._layout, np.ascontiguousarray(pixels, self._layout.dtype), record)

    def append_missing(self, record: FrameRecord) -> FrameRecord:
        """Record that a frame is missing, and why (`record.missing`)."""
        self._expect(record)
        if not record.missing:
            raise ValueError(f"frame {record.index} is missing for no reason")
        record = msgspec.structs.replace(record, checksum="")
        self._add(record, _NO_PIXELS)
        return record

    def commit(self) -> int:
        """Make everything appended durable; gives the number of records that now are.

        Raises StorageError: nothing that was appended since the last commit is acknowledged.
        """
        lines = self._writable()
        if self._pending:
            if self._layout:
                self._sync_shards(self._layout)
            for record in self._pending:
                lines.append(record)
            self._pending.clear()
        lines.commit()
        return len(self)

    def close(self) -> None:
        """Let go of the files; what was not committed is forgotten. Idempotent."""
        if self._lines:
            self._lines.close()
            self._lines = None

    @property
    def writable(self) -> bool:
        """Whether `append` and `commit` may be repeated: if an fsync failed, for want of room."""
        return self._lines is not None and self._lines.writable

    # ------------------------------------------------------------ reading

    def __len__(self) -> int:
        """Frames appended so far, missing ones included: the index of the next."""
        return len(self._checksums)

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Of each frame's pixels, or None when the run keeps none."""
        return self._layout.shape if self._layout else None

    @property
    def dtype(self) -> np.dtype[Any] | None:
        """Of each frame's pixels, or None when the run keeps none."""
        return self._layout.dtype if self._layout else None

    def records(self) -> list[FrameRecord]:
        """All durable records, in order, read from the disk. Raises Damaged."""
        return journal.read(self.folder / LINES, FrameRecord)

    def read(self, index: int, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """A frame's pixels, in `out` where it is given, compared with their checksum.

        Raises NoPixels, Damaged, StorageError, IndexError; ValueError for an unsuitable `out`.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        if self._layout is None:
            raise NoPixels(f"{self.folder.name} keeps no pixels: read the original recording")
        if self._checksums[index] == _NO_PIXELS:
            raise NoPixels(f"frame {index} of {self.folder.name} is missing")
        if out is None:
            out = np.empty(self._layout.shape, self._layout.dtype)
        self._layout.check(out)
        if not out.flags.c_contiguous:
            raise ValueError("frames are read into contiguous memory only")
        flat = out.reshape(-1).view(np.uint8)
        path = self._shard(index)
        with storage(f"reading frame {index}"), path.open("rb", buffering=0) as file:
            got = file.readinto(flat.data)
        if got != flat.nbytes or zlib.crc32(flat.data) != self._checksums[index]:
            raise _damaged(index, path)
        return out

    def verify(self) -> None:
        """Compare every frame with its checksum. Raises Damaged, naming the first that differs."""
        if self._layout is None:
            return
        buffer = np.empty(self._layout.shape, self._layout.dtype)
        for index, checksum in enumerate(self._checksums):
            if checksum != _NO_PIXELS:
                self.read(index, buffer)

    # ------------------------------------------------------------ inside

    def _writable(self) -> Journal:
        if self._lines is None:
            raise Damaged(f"{self.folder.name}: its frames are open for reading only")
        return self._lines

    def _expect(self, record: FrameRecord) -> None:
        self._writable()
        if record.index != len(self):
            raise ValueError(f"frame {record.index} is out of turn; the next is {len(self)}")

    def _add(self, record: FrameRecord, checksum: int) -> None:
        self._checksums.append(checksum)
        self._pending.append(record)

    def _write(self, layout: Layout, data: NDArray[Any], record: FrameRecord) -> None:
        with storage(f"recording frame {record.index}"):
            _write(self._shard(record.index), [data.reshape(-1).view(np.uint8).data, layout.tail])

    def _shard(self, index: int) -> Path:
        return self.folder / ARRAY / f"c.{index}{self._layout.suffix if self._layout else ''}"

    def _sync_shards(self, layout: Layout) -> None:
        for record in self._pending:
            if not record.missing:
                with storage(f"recording frame {record.index}"):
                    try:
                        fsync_file(self._shard(record.index))
                    except OSError as error:
                        if error.errno not in FULL:
                            self.close()  # its pages may be gone: a second fsync would lie
                        raise
        with storage("recording frames.zarr"):  # fsyncs the folder too, with the shards' names
            atomic_write(self.folder / ARRAY / "zarr.json", layout.metadata(len(self)))

    def _check_shards(self, layout: Layout) -> None:
        for index, checksum in enumerate(self._checksums):
            path = self._shard(index)
            if checksum != _NO_PIXELS and (
                not path.is_file() or path.stat().st_size != layout.shard_bytes
            ):
                raise _damaged(index, path)

    def _forget_unacknowledged(self, layout: Layout) -> None:
        pixels = {self._shard(i).name for i, c in enumerate(self._checksums) if c != _NO_PIXELS}
        with storage(f"opening {ARRAY}"):
            for path in (self.folder / ARRAY).iterdir():
                shard = re.fullmatch(r"c\.\d+" + re.escape(layout.suffix), path.name)
                if (shard and path.name not in pixels) or path.name.endswith(".part"):
                    path.unlink()
            atomic_write(self.folder / ARRAY / "zarr.json", layout.metadata(len(self)))
            fsync_folder(self.folder)


def _damaged(index: int, path: Path) -> Damaged:
    return Damaged(
        f"frame {index} is not what was recorded ({path}); restore it from a copy, or scan again"
    )


def _write(path: Path, parts: list[memoryview | bytes]) -> None:
    """Write a file from several buffers; on failure there is none. Raises OSError."""
    try:
        with path.open("wb", buffering=0) as file:
            for part in parts:
                view = memoryview(part)
                while view:
                    view = view[file.write(view) :]
    except OSError:
        path.unlink(missing_ok=True)
        raise


def count(folder: Path) -> Ledger:
    """What is in a run's folder, for what a crash left; nothing if there are no frames yet, or
    they are unreadable: `FrameStore.open` says what is wrong."""
    ledger = Ledger()
    try:
        records = journal.read(folder / LINES, FrameRecord)
    except UmbraError:
        return ledger
    for record in records:
        ledger.note(record)
    return ledger
