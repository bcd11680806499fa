import errno
import os
from pathlib import Path

import msgspec
import pytest

from daemon.storage.durable import Damaged, StorageError
from daemon.storage.journal import Journal, read
from protocol.errors import Code


class Line(msgspec.Struct, frozen=True):
    n: int
    text: str = ""


def write(path: Path, *numbers: int) -> None:
    journal = Journal(path)
    for n in numbers:
        journal.append(Line(n, "two\nlines\r"))
    journal.commit()
    journal.close()


def numbers(path: Path) -> list[int]:
    return [line.n for line in read(path, Line)]


def test_records_come_back_in_order_over_several_openings(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    write(path, 1, 2)
    write(path, 3)
    assert read(path, Line) == [Line(n, "two\nlines\r") for n in (1, 2, 3)]


def test_nothing_is_on_disk_before_commit(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    journal = Journal(path)
    journal.append({"n": 1})
    assert numbers(path) == []
    journal.commit()
    assert numbers(path) == [1]
    journal.append({"n": 2})
    journal.close()
    assert numbers(path) == [1]


@pytest.mark.parametrize("tail", [b'{"n":3,"te', b"{", b"\0" * 4096, b'{"n":3\0\0\0'])
def test_a_torn_end_is_dropped_and_written_over(tmp_path: Path, tail: bytes) -> None:
    path = tmp_path / "j.jsonl"
    write(path, 1, 2)
    whole = path.read_bytes()
    path.write_bytes(whole + tail)
    assert numbers(path) == [1, 2]
    assert path.read_bytes() == whole + tail, "reading changes nothing"
    write(path, 3)
    assert numbers(path) == [1, 2, 3]


def test_every_cut_gives_a_prefix(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    write(path, 1, 2, 3)
    whole = path.read_bytes()
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        assert numbers(path) == [1, 2, 3][: whole[:length].count(b"\n")]


def test_damage_in_the_middle_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    write(path, 1, 2, 3)
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([lines[0], b"{???", *lines[2:]]))
    with pytest.raises(Damaged, match=r"j\.jsonl: line 2 is damaged"):
        read(path, Line)


def test_a_full_disk_takes_nothing_and_can_be_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "j.jsonl"
    write(path, 1)
    journal = Journal(path)
    journal.append(Line(2))
    real = os.pwrite

    def half(file: int, data: memoryview, offset: int) -> int:
        if len(data) < 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(file, data[: len(data) // 2], offset)

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", half)
        with pytest.raises(StorageError) as caught:
            journal.commit()
    assert caught.value.code is Code.STORAGE_FULL
    assert path.read_bytes().count(b"\n") == 1
    assert path.read_bytes().endswith(b"\n"), "the half line is taken back"
    journal.commit()
    assert numbers(path) == [1, 2]


def commit_with_failing_fsync(
    journal: Journal, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing)
        with pytest.raises(StorageError):
            journal.commit()


def test_a_disk_that_is_found_full_by_fsync_can_be_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "j.jsonl"
    write(path, 1)
    journal = Journal(path)
    journal.append(Line(2))

    commit_with_failing_fsync(journal, errno.ENOSPC, monkeypatch)
    assert numbers(path) == [1], "what was not acknowledged is not there"
    journal.commit()
    assert numbers(path) == [1, 2]


def test_after_a_failed_fsync_it_promises_nothing_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path / "j.jsonl")
    journal.append(Line(1))

    commit_with_failing_fsync(journal, errno.EIO, monkeypatch)
    with pytest.raises(Damaged, match="open it again"):
        journal.commit()
