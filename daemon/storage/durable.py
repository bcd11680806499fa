"""Writes that survive SIGKILL and power loss: in full, or as if they had never begun.

A file is durable when its bytes *and* its name are: the file is fsynced, then the folder that
names it. A replaced file is written beside its old version and renamed over it, so that a reader
sees one or the other.
"""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from protocol.errors import Code, UmbraError

FULL = {errno.ENOSPC, errno.EDQUOT}
_REMEDIES = {
    errno.EACCES: "let the daemon's user write there, or give it another data folder",
    errno.EPERM: "let the daemon's user write there, or give it another data folder",
    errno.EROFS: "mount it for writing, or give the daemon another data folder",
    errno.EMFILE: "raise the limit of open files",
}


class StorageError(UmbraError):
    """The disk said no: `storage_full` when room is what it lacks, else `storage_failed`."""


class Damaged(UmbraError):
    """Something recorded is not what was recorded; names the file and what can be done."""

    def __init__(self, message: str) -> None:
        super().__init__(Code.STORAGE_FAILED, message)


@contextlib.contextmanager
def storage(phase: str) -> Iterator[None]:
    """Name the phase in which the disk failed: an OSError becomes a StorageError.

    Nothing is repeated here: a full disk needs room first, and after a failed fsync the kernel
    may have dropped the pages, so that a second fsync would succeed without the data.
    """
    try:
        yield
    except OSError as error:
        place = f" ({error.filename})" if error.filename else ""
        if error.errno in FULL:
            raise StorageError(
                Code.STORAGE_FULL, f"{phase}: the disk is full{place}; delete old runs, then resume"
            ) from error
        remedy = _REMEDIES.get(error.errno or 0, "check the disk")
        raise StorageError(
            Code.STORAGE_FAILED, f"{phase}: {error.strerror or error}{place}; {remedy}"
        ) from error


def fsync_file(path: Path) -> None:
    """Make a file's bytes durable (not yet its name, see `fsync_folder`). Raises OSError."""
    _fsync(path, os.O_RDONLY)


def fsync_folder(path: Path) -> None:
    """Make durable which files a folder names, and under which names. Raises OSError."""
    _fsync(path, os.O_RDONLY | os.O_DIRECTORY)


def atomic_write(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Replace a file by `data`, durably: readers and crashes see the old file or the new one.

    Raises OSError; then the old file stands and nothing is left beside it.
    """
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    fsync_folder(path.parent)


def _fsync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
