"""What commands print: structs as JSON, tables and lines for people.

Colour and boxes only on a terminal (and not with NO_COLOR); through a pipe, plain aligned text.
rich is imported when a terminal needs it, not before.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any, TextIO

import msgspec

from protocol.messages.replies import Done


def on_terminal(stream: TextIO | None = None) -> bool:
    """Whether a person looks at the stream (standard output if none is named)."""
    return (stream or sys.stdout).isatty()


def print_json(fact: Any, *, lines: bool = False) -> None:
    """A struct of the protocol as JSON: indented, or one a line for streams of them."""
    encoded = msgspec.json.encode(fact)
    print((encoded if lines else msgspec.json.format(encoded, indent=2)).decode(), flush=True)


def print_done(message: str, said: str = "", *, as_json: bool) -> None:
    """That something was done: as a Done, or for people, who may be `said` more."""
    if as_json:
        print_json(Done(message=message))
    else:
        print(said or message)


COLOURS = {
    "ready": "green", "done": "green", "idle": "green", "running": "cyan", "scanning": "cyan",
    "finishing": "cyan", "queued": "blue", "manual": "blue", "paused": "yellow",
    "interrupted": "yellow", "aborted": "yellow", "lost": "red", "fault": "red", "stuck": "red",
    "failed": "red", "estopped": "red", "stopping": "yellow", "homing": "cyan", "moving": "cyan",
    "held": "yellow", "alarm": "red", "ok": "green", "warning": "yellow",
}  # fmt: skip


def print_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A table; on a terminal by rich, states in their colours; else plain columns."""
    rows = [[*row] for row in rows]
    if on_terminal():
        from rich.console import Console
        from rich.table import Table

        table = Table(box=None, header_style="bold dim", pad_edge=False, padding=(0, 2, 0, 0))
        for i, heading in enumerate(headings):
            # the first column names things: the others give way before a name is cut short
            table.add_column(heading, no_wrap=i == 0)
        for row in rows:
            table.add_row(*map(coloured, row))
        Console(highlight=False).print(table)
        return
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    for row in [headings, *rows]:
        print(
            "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        )


def coloured(text: str) -> str:
    """rich markup of a text; a state that it begins with gets its colour."""
    from rich.markup import escape

    state, space, rest = text.partition(" ")
    colour = COLOURS.get(state)
    return f"[{colour}]{state}[/]{space}{escape(rest)}" if colour else escape(text)


def print_facts(facts: Iterable[tuple[str, str]]) -> None:
    """Name and value, one a line, aligned; empty values are left out."""
    shown = [(name, value) for name, value in facts if value]
    width = max((len(name) for name, _ in shown), default=0)
    if on_terminal():
        from rich.console import Console
        from rich.markup import escape

        console = Console(highlight=False)
        for name, value in shown:
            console.print(f"[dim]{escape(name):{width}}[/]  {coloured(value)}", soft_wrap=True)
        return
    for name, value in shown:
        print(f"{name:{width}}  {value}")


def say(message: str) -> None:
    """A remark on stderr, so that standard output stays what was asked for."""
    print(message, file=sys.stderr, flush=True)


# ---------------------------------------------------------------- figures for people


def seconds(value: float | None) -> str:
    """A duration: 4.2 s, 3 min 20 s, 2 h 05 min."""
    if value is None:
        return ""
    if value < 10:
        return f"{value:.1f} s"
    if value < 120:
        return f"{value:.0f} s"
    minutes, rest = divmod(round(value), 60)
    if minutes < 120:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def size(count: int) -> str:
    """Bytes: 812 B, 3.4 MB."""
    value = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.0f} B" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


def when(utc: str) -> str:
    """An ISO 8601 time in UTC as the local time."""
    if not utc:
        return ""
    try:
        moment = datetime.fromisoformat(utc)
    except ValueError:
        return utc
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return f"{moment.astimezone():%Y-%m-%d %H:%M:%S}"
