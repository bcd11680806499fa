"""Files that a client fetches: not there until they are whole."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from protocol.errors import Code, UmbraError
from protocol.messages.runs import Product


class Arrival:
    """A file beside its place, on its way there."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file = path, file

    def write(self, data: memoryview) -> None:
        """Add a part."""
        self._file.write(data)

    def finish(self, size: int) -> None:
        """Put the file in its place. Raises UmbraError(storage_failed) if it is not whole."""
        if (got := self._file.tell()) != size:
            raise UmbraError(
                Code.STORAGE_FAILED, f"{self._path}: {got} bytes of {size} came: fetch it again"
            )
        self._file.flush()
        os.fsync(self._file.fileno())
        Path(self._file.name).replace(self._path)


@contextlib.contextmanager
def arrival(path: Path) -> Iterator[Arrival]:
    """A new file for this place, gone again unless it was finished.

    Raises UmbraError(storage_failed) where it can't be written.
    """
    beside = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("xb") as file:
            try:
                yield Arrival(path, file)
            finally:
                beside.unlink(missing_ok=True)
    except OSError as error:
        raise UmbraError(
            Code.STORAGE_FAILED, f"{path} can't be written: {error.strerror or error}"
        ) from error


def place_for(to: Path | str, product: Product) -> Path:
    """Where one product goes: the path itself, or under its own file name in a folder."""
    path = Path(to)
    return path / _inside(product).name if path.is_dir() else path


def place_in(folder: Path | str, product: Product) -> Path:
    """Where a product goes among others of its run: as in the run's own folder."""
    return Path(folder) / _inside(product)


def _inside(product: Product) -> PurePosixPath:
    """The product's file, which must be inside whatever folder it is put in."""
    file = PurePosixPath(product.file)
    if not file.name or file.is_absolute() or ".." in file.parts:
        raise UmbraError(
            Code.STORAGE_FAILED, f"product {product.name!r} names no file: {product.file!r}"
        )
    return file
