"""Following a run: a bar with rate and time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from protocol.cli.exits import Exit
from protocol.cli.link import Json, Keys, Rig, RunId, connect
from protocol.cli.output import on_terminal, print_json, say, seconds
from protocol.cli.words import ending, frames
from protocol.errors import Code, UmbraError
from protocol.messages.runs import Progress, RunInfo, RunState

if TYPE_CHECKING:
    from protocol.run import Run

ENDS = {RunState.DONE: Exit.OK, RunState.ABORTED: Exit.ABORTED}


def watch(run: RunId = "", rig: Rig = None, keys: Keys = None, as_json: Json = False) -> int:
    """Follow a run until it ends, and say what it found. Ctrl-C only ends the watching: the run
    goes on.

    --json: a Progress a line, and at the end the RunInfo. Exits as the run ended: 0, 1 or 5.
    """
    with connect(rig, keys) as client:
        followed = client.run(run)
        with goes_on(followed.id):
            follow(followed, as_json=as_json)
        if as_json:
            print_json(followed.info, lines=True)
        code = conclude(followed.info, quiet=as_json)
        if not as_json and not code:
            tell(followed.facts())
    return code


@contextmanager
def goes_on(run: str) -> Iterator[None]:
    """Ctrl-C in here says that the run is not ended by it."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"\numbra: run {run} goes on; umbra watch {run} follows it, umbra abort {run} ends it")
        raise


def follow(run: Run, *, as_json: bool = False, title: str = "") -> RunInfo:
    """Show a run's progress on stderr until it has ended; the run as it is then."""
    news = run.progress()
    if as_json:
        for progress in news:
            print_json(progress, lines=True)
    else:
        show_progress(news, title or run.id)
    return run.info


def show_progress(news: Iterable[Progress], title: str) -> None:
    """Progress on stderr: a bar on a terminal, else lines."""
    if on_terminal(sys.stderr):
        _bar(news, title)
    else:
        _lines(news)


def conclude(info: RunInfo, *, quiet: bool = False) -> Exit:
    """Say how a run ended; the exit code for it."""
    code = ENDS.get(info.state, Exit.FAILED)
    if code is not Exit.OK:
        say(f"umbra: run {info.id} {info.state.value}: {ending(info) or 'no reason given'}")
    elif not quiet:
        say(f"run {info.id} done: {frames(info)}")
    return code


def tell(facts: Mapping[str, Any]) -> None:
    """Say what a run found out: a measurement's figures and commands, and advice of any run."""
    for name, value in facts.get("figures", ()):
        say(f"{name}: {value}")
    for line in facts.get("advice", ()):
        say(f"advice: {line}")
    for command in facts.get("commands", ()):
        say(f"  {command}")


def must_be_done(info: RunInfo) -> None:
    """Raise the UmbraError of a run that did not end well."""
    if info.state is RunState.DONE:
        return
    try:
        code = Code(info.end.code) if info.end else Code.INTERNAL
    except ValueError:
        code = Code.INTERNAL
    raise UmbraError(code, f"the run {info.state.value}: {ending(info) or 'no reason given'}")


def _bar(news: Iterable[Progress], title: str) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        TextColumn("{task.fields[count]}"),
        TextColumn("[dim]{task.fields[phase]}"),
    )
    with Bar(*columns, console=Console(stderr=True, highlight=False), expand=True) as bar:
        task = bar.add_task(title, total=None, count="", phase="")
        for now in news:
            bar.update(
                task,
                total=1.0 if now.fraction is not None else None,
                completed=now.fraction or 0.0,
                count=count(now),
                phase=now.phase,
            )


def count(now: Progress) -> str:
    """Frames, rate and time left: 12/27 · 9.8 Hz · 1.5 s left."""
    parts = [f"{now.recorded}/{now.planned}" if now.planned else f"{now.recorded} frames"]
    if now.missing:
        parts.append(f"{now.missing} missing")
    if now.rate_hz and not now.state.ended:
        parts.append(f"{now.rate_hz:.1f} Hz")
    if now.remaining_s is not None and not now.state.ended:
        parts.append(f"{seconds(now.remaining_s)} left")
    return " · ".join(parts)


def _lines(news: Iterable[Progress]) -> None:
    """A line when the state changes, and one a tenth of the way: a log stays readable."""
    told: tuple[RunState, int] | None = None
    for now in news:
        step = (now.state, int((now.fraction or 0.0) * 10))
        if step != told:
            phase = "" if now.phase in ("", now.state.value) else f" · {now.phase}"
            say(f"{now.state.value}: {count(now)}{phase}")
            told = step
