import errno
import os
from pathlib import Path

import pytest

from daemon.storage.durable import StorageError, atomic_write, fsync_folder, storage
from protocol.errors import Code


def test_replaces_the_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    atomic_write(path, b"a long first version")
    atomic_write(path, b"second")
    assert path.read_bytes() == b"second"
    assert [p.name for p in tmp_path.iterdir()] == ["run.json"]


def test_bytes_then_name_then_folder_are_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(b"old")
    seen: list[tuple[str, bytes]] = []

    def fsync(descriptor: int) -> None:
        seen.append((Path(f"/proc/self/fd/{descriptor}").readlink().name, path.read_bytes()))

    monkeypatch.setattr(os, "fsync", fsync)
    atomic_write(path, b"new")
    (first, before), (second, after) = seen
    assert first.endswith(".part")
    assert before == b"old"
    assert (second, after) == (tmp_path.name, b"new")


def test_a_failed_write_leaves_the_old_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.json"
    atomic_write(path, b"old")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (errno.ENOSPC, Code.STORAGE_FULL),
        (errno.EDQUOT, Code.STORAGE_FULL),
        (errno.EIO, Code.STORAGE_FAILED),
        (errno.EROFS, Code.STORAGE_FAILED),
    ],
)
def test_disk_errors_name_phase_and_place(number: int, code: Code) -> None:
    expected = pytest.raises(StorageError, match=r"recording frame 7: .*c\.7\.0\.0")
    with expected as caught, storage("recording frame 7"):
        raise OSError(number, os.strerror(number), "/data/c.7.0.0")
    assert caught.value.code is code


def test_a_read_only_disk_has_its_own_remedy() -> None:
    with pytest.raises(StorageError, match="mount it for writing"), storage("creating a run"):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))


def test_a_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        fsync_folder(tmp_path / "file")
