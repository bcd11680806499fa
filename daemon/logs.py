"""Logging: JSON under systemd, readable on a terminal; the last records kept for clients."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections import deque
from collections.abc import MutableMapping
from typing import Any, TextIO, cast

import structlog

_KEPT = 5000


class LogBook:
    """The last records, by run; a structlog processor. Appending is atomic, so any thread may."""

    def __init__(self) -> None:
        self._records: deque[dict[str, Any]] = deque(maxlen=_KEPT)

    def __call__(
        self, logger: Any, method: str, event: MutableMapping[str, Any]
    ) -> MutableMapping[str, Any]:
        """Keep a copy, JSON-able."""
        del logger, method
        self._records.append({key: _plain(value) for key, value in event.items()})
        return event

    def records(self, run: str, limit: int) -> tuple[dict[str, Any], ...]:
        """The last records of a run ("" : of everything), oldest first."""
        chosen = [r for r in list(self._records) if not run or r.get("run") == run]
        return tuple(chosen[-limit:])


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
