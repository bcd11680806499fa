"""The log book: the last records, and those of a run in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon import logs
from daemon.logs import LogBook

RUN = "20260301-142233-checkerboard-k7m2"


def opened(runs: Path) -> tuple[LogBook, list[dict[str, Any]]]:
    book = LogBook()
    told: list[dict[str, Any]] = []
    (runs / RUN).mkdir(parents=True, exist_ok=True)
    book.open(runs, told.append)
    return book, told


def say(book: LogBook, event: str, **rest: Any) -> None:
    book(None, "info", {"event": event, **rest})


def test_a_runs_records_are_read_by_the_next_book(tmp_path: Path) -> None:
    book, told = opened(tmp_path)
    say(book, "one", run=RUN, path=tmp_path)
    say(book, "of the daemon")
    say(book, "two", run=RUN)
    assert [record["event"] for record in told] == ["one", "of the daemon", "two"]
    again, _ = opened(tmp_path)
    assert again.records(RUN, 10) == book.records(RUN, 10)
    assert [record["event"] for record in again.records(RUN, 1)] == ["two"]
    assert again.records(RUN, 10)[0]["path"] == str(tmp_path)
    assert again.records("", 10) == ()


def test_a_torn_line_hides_no_other(tmp_path: Path) -> None:
    book, _ = opened(tmp_path)
    say(book, "one", run=RUN)
    file = tmp_path / RUN / logs.RUN_LOG
    file.write_bytes(file.read_bytes() + b'{"event": "to\n')
    say(book, "two", run=RUN)
    assert [record["event"] for record in book.records(RUN, 10)] == ["one", "two"]


def test_it_is_bounded_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "_RUN_BYTES", 2000)
    book, told = opened(tmp_path)
    for number in range(100):
        say(book, "frame missing", run=RUN, number=number)
    kept = book.records(RUN, 1000)
    assert (tmp_path / RUN / logs.RUN_LOG).stat().st_size < 2300
    assert "the run's log is full" in kept[-1]["event"]
    assert [record["number"] for record in kept[:-1]] == list(range(len(kept) - 1))
    assert len(told) == 100


def test_a_folder_that_is_gone_stops_nothing(tmp_path: Path) -> None:
    book, _ = opened(tmp_path)
    say(book, "about another", run="20260301-142233-mesh-aaaa")
    assert book.records("20260301-142233-mesh-aaaa", 10)[0]["event"] == "about another"
    assert not (tmp_path / "20260301-142233-mesh-aaaa").exists()
