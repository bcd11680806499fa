"""Runs: list them, look at one, steer them, fetch what they made."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.cli.delivery import Delivery
from protocol.cli.exits import Exit
from protocol.cli.link import Json, Keys, Rig, RunId, connect
from protocol.cli.output import print_facts, print_json, print_table, say, size, when
from protocol.cli.watch import conclude
from protocol.cli.words import HEADINGS, Fetched, ending, frames, method, rows, settings
from protocol.errors import Code, UmbraError
from protocol.messages.replies import Run, Runs
from protocol.messages.runs import RunInfo, RunState

if TYPE_CHECKING:
    from protocol.client import Client

Out = Annotated[
    Path,
    typer.Option(
        "-o",
        "--out",
        metavar="DIR",
        help="Folder for the products; made if new, its parent is not.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace files that are there already.")]


def runs(
    limit: Annotated[int, typer.Option("-n", "--limit", min=1, max=10_000)] = 20,
    state: Annotated[RunState | None, typer.Option(help="Only runs in this state.")] = None,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """List runs, the newest first.

    --json: a Runs.
    """
    with connect(rig, keys) as client:
        found = client.runs(limit, state)
    if as_json:
        print_json(Runs(runs=found))
    elif found:
        print_table(HEADINGS, rows(found))
    else:
        say("no runs yet; `umbra scan checkerboard --wait` makes one")


def run(run: RunId = "", rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """One run in detail: what was asked, how it went, what it made.

    --json: a Run.
    """
    with connect(rig, keys) as client:
        info = client.run_info(run)
    if as_json:
        print_json(Run(run=info))
    else:
        show_run(info)


def show_run(info: RunInfo) -> None:
    """A run's facts and its products."""
    print_facts(
        [
            ("run", info.id),
            ("method", method(info)),
            ("settings", settings(info)),
            ("state", info.state.value),
            ("frames", frames(info)),
            ("submitted", " by ".join(part for part in (when(info.submitted), info.by) if part)),
            ("started", when(info.started)),
            ("ended", when(info.ended)),
            ("reason", ending(info)),
            ("parents", ", ".join(info.parents)),
        ]
    )
    if info.products:
        print()
        print_table(
            ["product", "kind", "file", "unit", "size"],
            [[p.name, p.kind, p.file, p.unit, size(p.bytes)] for p in info.products],
        )


def get(
    *,
    run: RunId = "",
    out: Out = Path(),
    names: Annotated[
        str, typer.Option("--only", metavar="NAME,...", help="These products; default: all.")
    ] = "",
    force: Force = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Fetch a run's products into a folder: all of them, or nothing is written.

    --json: {"run": RunInfo, "files": [path, ...]}.
    """
    with connect(rig, keys) as client:
        info = client.run_info(run)
        files = fetch(client, info, Delivery(out, force=force), wanted(info, names))
    if as_json:
        print_json(Fetched(run=info, files=tuple(map(str, files))))
        return
    for file in files:
        print(file)


def wanted(info: RunInfo, names: str) -> list[str]:
    """The products asked for by name, or all. Raises UmbraError(unknown_product, no_result)."""
    there = [product.name for product in info.products]
    asked = [name.strip() for name in names.split(",") if name.strip()]
    for name in asked:
        if name not in there:
            raise UmbraError(
                Code.UNKNOWN_PRODUCT,
                f"run {info.id} has no product {name!r}; it has: {', '.join(there) or 'none'}",
            )
    if not there:
        hint = f"; umbra watch {info.id} waits for them" if not info.state.ended else ""
        raise UmbraError(
            Code.NO_RESULT, f"run {info.id} is {info.state.value} and has no products{hint}"
        )
    return asked or there


def fetch(client: Client, info: RunInfo, delivery: Delivery, names: list[str]) -> list[Path]:
    """Download products; they appear in the folder together, when all are whole."""
    files = {p.name: Path(p.file).name for p in info.products}
    delivery.check(files[name] for name in names)
    with delivery.receive() as folder:
        for name in names:
            client.download(info.id, name, folder / files[name])
    return [delivery.folder / files[name] for name in names]


# ---------------------------------------------------------------- steering


_SOON = {"pause": "pauses after this step", "abort": "is being aborted", "resume": "goes on"}
_QUEUED = "is queued, ahead of the others, to go on where it stopped"


def _steer(verb: str, run: str, rig: str | None, keys: str | None, as_json: bool) -> RunInfo:
    with connect(rig, keys) as client:
        which = run or client.run_info().id
        getattr(client, verb)(which)
        info = client.run_info(which)
    if as_json:
        print_json(Run(run=info))
    else:
        under_way = not info.state.ended and info.state is not RunState.PAUSED
        soon = _QUEUED if verb == "resume" and info.state is RunState.QUEUED else _SOON[verb]
        print(f"run {info.id}: {soon if under_way else info.state.value}")
    return info


def pause(run: RunId = "", rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """Pause the run after the step under way; the projector goes dark, the stage holds.

    --json: a Run.
    """
    _steer("pause", run, rig, keys, as_json)


def resume(run: RunId = "", rig: Rig = None, keys: Keys = None, as_json: Json = False) -> int:
    """Go on with a paused run, or queue an interrupted one again where it stopped.

    --json: a Run. Exits with 1 if it has failed again already; of later `umbra watch` tells.
    """
    info = _steer("resume", run, rig, keys, as_json)
    return conclude(info) if info.state is RunState.FAILED else Exit.OK


def abort(run: RunId = "", rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """End a run, waiting or running, and go to the safe state; what was recorded is kept.

    --json: a Run.
    """
    _steer("abort", run, rig, keys, as_json)


queue = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@queue.callback()
def _queue(
    context: typer.Context, rig: Rig = None, keys: Keys = None, as_json: Json = False
) -> None:
    """List the runs that wait, in order; `umbra abort RUN` removes one.

    --json: a Runs.
    """
    context.obj = {"rig": rig, "keys": keys}
    if context.invoked_subcommand is None:
        with connect(rig, keys) as client:
            found = client.queue()
        _show_queue(found, as_json)


@queue.command("move")
def move(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A waiting run's id.")],
    position: Annotated[int, typer.Argument(metavar="POS", min=0, help="0 is next.")],
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Put a waiting run at another place in the queue.

    --json: a Runs, the queue afterwards.
    """
    with connect(rig, keys) as client:
        client.move_queued(run, position)
        found = client.queue()
    _show_queue(found, as_json)


def _show_queue(found: tuple[RunInfo, ...], as_json: bool) -> None:
    if as_json:
        print_json(Runs(runs=found))
    elif found:
        print_table(["pos", *HEADINGS], [[str(i), *row] for i, row in enumerate(rows(found))])
    else:
        say("nothing waits")
