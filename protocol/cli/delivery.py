"""Where products go: a folder that is checked before the work and changed only at its end."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.errors import Code, UmbraError

PRODUCTS = (
    "direct.tiff", "global.tiff", "quality.png", "quality.json", "preview.png", "report.html",
)  # fmt: skip


def _refuse(message: str) -> UmbraError:
    return UmbraError(Code.BAD_REQUEST, message, "--out")


def _writable(folder: Path) -> bool:
    # root may write anywhere, but a folder without a single write bit was closed on purpose
    return os.access(folder, os.W_OK | os.X_OK) and bool(folder.stat().st_mode & 0o222)


class Delivery:
    """A folder for products. `check` it before the work; `receive` them when they are there."""

    def __init__(self, folder: Path, *, force: bool = False) -> None:
        self.folder = folder.absolute()
        self.force = force

    def check(self, expected: Iterable[str] = PRODUCTS) -> None:
        """Raises UmbraError(bad_request) if the products could not be put there."""
        if not self.folder.exists() and not self.folder.is_symlink():
            parent = self.folder.parent
            if not parent.exists():
                raise _refuse(
                    f"there is no folder {parent} to make {self.folder.name} in: make it first, or "
                    "choose another with -o"
                )
            if not parent.is_dir():
                raise _refuse(f"{parent} is not a folder; choose another with -o")
            if not _writable(parent):
                raise _refuse(f"{parent} is read-only: cannot make {self.folder.name} in it")
            return
        if not self.folder.is_dir():
            raise _refuse(f"{self.folder} is not a folder; choose another with -o")
        if not _writable(self.folder):
            raise _refuse(f"{self.folder} is read-only; choose another folder with -o")
        self._check_names(expected)

    def _check_names(self, names: Iterable[str]) -> None:
        there = [name for name in names if (self.folder / name).exists()]
        if there and not self.force:
            raise _refuse(
                f"{self.folder} already has {', '.join(there)}; "
                "give --force to replace, or another folder with -o"
            )

    @contextmanager
    def receive(self) -> Iterator[Path]:
        """A folder to fill. On success its files are moved in; on any error nothing is changed."""
        new = not self.folder.exists()
        beside = self.folder.parent if new else self.folder  # the same file system, for rename
        try:
            filling = Path(tempfile.mkdtemp(prefix=".umbra-", dir=beside))
        except OSError as error:
            raise _refuse(f"{beside}: {error.strerror}; choose another folder with -o") from error
        try:
            yield filling
            if new:
                filling.chmod(0o777 & ~_umask())
                filling.rename(self.folder)
            else:
                self._check_names(p.name for p in filling.iterdir())
                for file in sorted(filling.iterdir()):
                    file.replace(self.folder / file.name)
        except OSError as error:
            raise UmbraError(
                Code.STORAGE_FAILED, f"{self.folder}: {error.strerror or error}; nothing was kept"
            ) from error
        finally:
            shutil.rmtree(filling, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def make_folder(path: Path) -> None:
    """Make a folder, not its parents, where it is not there yet. Raises UmbraError."""
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise _refuse(f"cannot make {path}: {error.strerror}; choose another with -o") from error


def write_file(path: Path, data: bytes | memoryview) -> None:
    """Write a file whole or not at all. Raises UmbraError(storage_failed)."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UmbraError(
            Code.STORAGE_FAILED, f"cannot write {path}: {error.strerror or error}", "--out"
        ) from error
