"""An append-only journal: one JSON object a line, durable from `commit` on.

A crash can only tear what was not committed, and only at the end: text after the last newline is
dropped, as are the NULs that some file systems leave where a size was written before its bytes.
Anything else that does not parse is damage, and an error.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from daemon.storage.durable import FULL, Damaged, fsync_folder, storage

T = TypeVar("T")


class Journal:
    """Appends records to a file; one writer, one thread. Opening drops a torn end.

    A commit that found the disk full has taken nothing back from its caller: the records stay in
    the buffer and the file is as before, so that it can be repeated when there is room; so it is
    where only the fsync found it out, for all that it may have dropped is written again. After
    any other failure nothing is known of the file until it has been opened again.
    """

    def __init__(self, path: Path) -> None:
        """Raises StorageError."""
        self.path = path
        self._encoder = msgspec.json.Encoder()
        self._pending = bytearray()
        with storage(f"opening {path.name}"):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            self._size = len(_sound(path.read_bytes()))
            os.ftruncate(self._file, self._size)
            os.fsync(self._file)
            fsync_folder(path.parent)

    def append(self, record: msgspec.Struct | dict[str, Any]) -> None:
        """Add a record to what the next `commit` makes durable; no I/O."""
        self._pending += self._encoder.encode(record)
        self._pending += b"\n"

    def commit(self) -> None:
        """Make everything appended durable. Raises StorageError; see the class for what then."""
        if self._file < 0:
            raise Damaged(f"{self.path.name}: closed, or an earlier write failed; open it again")
        if not self._pending:
            return
        with storage(f"writing {self.path.name}"):
            try:
                _write_at(self._file, bytes(self._pending), self._size)
            except OSError:
                os.ftruncate(self._file, self._size)
                raise
            try:
                os.fsync(self._file)
            except OSError as error:
                if error.errno in FULL:
                    os.ftruncate(self._file, self._size)
                else:
                    self.close()
                raise
        self._size += len(self._pending)
        self._pending.clear()

    @property
    def writable(self) -> bool:
        """Whether it is open, and no write has left it in doubt."""
        return self._file >= 0

    def close(self) -> None:
        """Let go of the file; what was not committed is forgotten. Idempotent."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
        self._pending.clear()


def read(path: Path, type: type[T]) -> list[T]:
    """All whole records of a journal, in order; a torn end is left out.

    Raises Damaged, naming the line, and StorageError.
    """
    with storage(f"reading {path.name}"):
        data = _sound(path.read_bytes())
    decoder = msgspec.json.Decoder(type)
    records = []
    for number, line in enumerate(data.split(b"\n")[:-1], 1):
        try:
            records.append(decoder.decode(line))
        except msgspec.DecodeError as error:
            raise Damaged(
                f"{path}: line {number} is damaged ({error}); restore the file from a copy"
            ) from error
    return records


def _sound(data: bytes) -> bytes:
    """The part of a journal's bytes that ends with a whole line."""
    data = data.rstrip(b"\0")
    return data[: data.rfind(b"\n") + 1]


def _write_at(file: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(file, view, offset)
        view, offset = view[written:], offset + written
