"""Logging: JSON under systemd, readable on a terminal; the last records kept for clients.

What is said of a run is also kept in its folder, as `log.jsonl`: one JSON object a line, up to
1 MiB. It is for people and not fsynced: a restart leaves it whole, a power cut may take the end.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections import deque
from collections.abc import Callable, MutableMapping
from pathlib import Path
from typing import Any, TextIO, cast

import msgspec
import structlog

RUN_LOG = "log.jsonl"
_KEPT = 5000  # records of the daemon's own, in memory
_RUN_BYTES = 1 << 20  # of a run's log, at most


class LogBook:
    """The last records, by run; a structlog processor. Appending is atomic, so any thread may."""

    def __init__(self) -> None:
        self._records: deque[dict[str, Any]] = deque(maxlen=_KEPT)
        self._runs: Path | None = None
        self._on_record: Callable[[dict[str, Any]], None] = lambda _: None

    def open(self, runs: Path, on_record: Callable[[dict[str, Any]], None]) -> None:
        """From now on keep what is said of a run in its folder under `runs`, and tell of each
        record. `on_record` must be safe to call from any thread, and log nothing."""
        self._runs, self._on_record = runs, on_record

    def __call__(
        self, logger: Any, method: str, event: MutableMapping[str, Any]
    ) -> MutableMapping[str, Any]:
        """Keep a copy, JSON-able."""
        del logger, method
        record = {key: _plain(value) for key, value in event.items()}
        self._records.append(record)
        run = record.get("run")
        if isinstance(run, str) and run and self._runs is not None:
            _append(self._runs / run / RUN_LOG, record)
        self._on_record(record)
        return event

    def records(self, run: str, limit: int) -> tuple[dict[str, Any], ...]:
        """The last records of a run ("" : of everything), oldest first. Reads a file for a run."""
        kept = _read(self._runs / run / RUN_LOG) if run and self._runs is not None else []
        if kept:
            return tuple(kept[-limit:])
        chosen = [r for r in list(self._records) if not run or r.get("run") == run]
        return tuple(chosen[-limit:])


def _append(path: Path, record: dict[str, Any]) -> None:
    """Add a line, unless the file has had its share; a log that cannot be written stops nothing."""
    line = msgspec.json.encode(record) + b"\n"
    with contextlib.suppress(OSError):
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            size = os.fstat(file).st_size
            if size >= _RUN_BYTES:
                return
            if size + len(line) >= _RUN_BYTES:
                said = {"event": "the run's log is full: umbrad's own log has the rest"}
                line += msgspec.json.encode({**record, **said}) + b"\n"
            os.write(file, line)
        finally:
            os.close(file)


def _read(path: Path) -> list[dict[str, Any]]:
    """The records of a file; a line that a crash has torn is left out."""
    found = []
    with contextlib.suppress(OSError):
        for line in path.read_bytes().splitlines():
            with contextlib.suppress(msgspec.DecodeError):
                found.append(msgspec.json.decode(line, type=dict[str, Any]))
    return found


class _Stderr:
    """Standard error that may go away: a log nobody reads any more must not stop a rig."""

    def write(self, text: str) -> int:
        """Write, or lose, the text."""
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush what can be flushed."""
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()


def _plain(value: Any) -> Any:
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def configure(level: str = "info") -> LogBook:
    """Set logging up for the process; gives the book that clients read from."""
    book = LogBook()
    to_journal = "JOURNAL_STREAM" in os.environ or not sys.stderr.isatty()
    shared: list[Any] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.StackInfoRenderer(),
    ]
    if to_journal:
        renderers: list[Any] = [
            structlog.processors.format_exc_info,
            book,
            structlog.processors.JSONRenderer(),
        ]
    else:
        renderers = [book, structlog.dev.ConsoleRenderer(colors="NO_COLOR" not in os.environ)]
    structlog.configure(
        processors=[*shared, *renderers],
        wrapper_class=structlog.make_filtering_bound_logger(
            logging.getLevelNamesMapping()[level.upper()]
        ),
        logger_factory=structlog.PrintLoggerFactory(cast(TextIO, _Stderr())),
        cache_logger_on_first_use=True,
    )
    return book
