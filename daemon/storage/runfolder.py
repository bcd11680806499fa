"""One run on disk: its folder, and `run.json`, the folder's first page."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from daemon.storage.durable import Damaged, atomic_write, storage
from protocol.errors import Code, UmbraError
from protocol.messages.runs import End, Product, RunInfo, RunState
from protocol.scans.anyscan import AnyScan

FORMAT = 1
"""Of run.json; a daemon reads its own and refuses later ones."""


class RunFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything in run.json: what `RunInfo` shows, and what explains or resumes the run.

    `order` is the place in the queue, the least first; `rig` the devices and settings at the
    start; `bench` what the method was told of them (`Bench`, without its calibration); `timings`
    seconds by name; `estimates` of frames and bytes before the start.
    """

    format: int = FORMAT
    id: str
    state: RunState
    spec: AnyScan
    submitted: str
    by: str = ""
    started: str = ""
    ended: str = ""
    planned: int | None = None
    recorded: int = 0
    missing: int = 0
    rejected: int = 0
    end: End | None = None
    products: tuple[Product, ...] = ()
    parents: tuple[str, ...] = ()
    request_id: str = ""
    order: int = 0
    rig: dict[str, Any] = {}
    bench: dict[str, Any] | None = None
    calibration: dict[str, Any] | None = None
    sequencing: dict[str, Any] | None = None
    versions: dict[str, str] = {}
    timings: dict[str, float] = {}
    estimates: dict[str, float] = {}

    @property
    def reprocessed(self) -> bool:
        """Whether it is made from another run's frames: it needs no devices."""
        return bool(self.parents)


class RunFolder:
    """One run on disk. `file` is run.json as it is; `update` changes both. Thread-safe."""

    def __init__(self, path: Path, file: RunFile) -> None:
        self.path = path
        self.file = file
        self.unwritten = False  # something is only remembered here
        self._lock = threading.Lock()

    @classmethod
    def read(cls, path: Path) -> RunFolder:
        """A run's folder. Raises Damaged when its run.json cannot be understood."""
        try:
            data = (path / "run.json").read_bytes()
            file = msgspec.json.decode(data, type=RunFile)
        except (OSError, msgspec.DecodeError) as error:
            raise Damaged(f"{path / 'run.json'}: {error}; restore it from a copy") from error
        if file.format != FORMAT or file.id != path.name:
            raise Damaged(f"{path / 'run.json'}: of run {file.id!r} in format {file.format}")
        return cls(path, file)

    @property
    def id(self) -> str:
        """The run's name, and its folder's."""
        return self.file.id

    def update(self, **changes: Any) -> RunFile:
        """Change fields of run.json, durably and all or none; gives the new contents.

        Raises StorageError: then `file` and the disk are as before. TypeError: no such field.
        """
        with self._lock:
            return self._replace(changes)

    def remember(self, **changes: Any) -> None:
        """Change fields here only, when the disk refuses them; `flush` writes them later."""
        with self._lock:
            self.file = msgspec.structs.replace(self.file, **changes)
            self.unwritten = True

    def flush(self) -> None:
        """Write what was only remembered. Raises StorageError."""
        if self.unwritten:
            self.update()
            self.unwritten = False

    def add_products(self, products: Iterable[Product]) -> RunFile:
        """Add to the list of products; one of the same name takes its place. As `update`."""
        with self._lock:
            named = {product.name: product for product in (*self.file.products, *products)}
            return self._replace({"products": tuple(named.values())})

    def product(self, name: str) -> Path:
        """A product's file. Raises UmbraError(unknown_product), naming those that there are."""
        for product in self.file.products:
            if product.name == name:
                path = self.path / product.file
                if path.is_file():
                    return path
                raise UmbraError(
                    Code.UNKNOWN_PRODUCT, f"{self.id}: {product.file} is no longer in its folder"
                )
        names = ", ".join(product.name for product in self.file.products) or "none yet"
        raise UmbraError(Code.UNKNOWN_PRODUCT, f"{self.id} has no product {name!r}; it has {names}")

    def info(self) -> RunInfo:
        """The run as clients see it."""
        file = self.file
        return RunInfo(**{name: getattr(file, name) for name in RunInfo.__struct_fields__})

    def size(self) -> int:
        """Bytes in the folder."""
        return sum(p.stat().st_size for p in self.path.rglob("*") if p.is_file())

    def _replace(self, changes: Mapping[str, Any]) -> RunFile:
        file = msgspec.structs.replace(self.file, **changes)
        with storage(f"{self.id}: writing run.json"):
            write(self.path, file)
        self.file = file
        return file


def write(folder: Path, file: RunFile) -> None:
    """Write run.json, durably and all or none. Raises OSError."""
    atomic_write(folder / "run.json", msgspec.json.format(msgspec.json.encode(file)) + b"\n")
