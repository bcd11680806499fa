"""`umbra scan METHOD`: queue a scan; its options are the fields of the method's spec."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from protocol.cli.delivery import Delivery
from protocol.cli.family import Family
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.output import print_json, say
from protocol.cli.runs import Force, fetch, wanted
from protocol.cli.watch import conclude, follow, goes_on
from protocol.cli.words import Fetched
from protocol.messages import Run
from protocol.scans import AnyCalibration, AnyScan, AnySeparation


def scan(
    spec: AnyScan,
    *,
    wait: Annotated[
        bool, typer.Option("-w", "--wait", help="Follow the run; exit as it ended.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Wait, then fetch the products to DIR."),
    ] = None,
    first: Annotated[bool, typer.Option("--first", help="Ahead of the queue.")] = False,
    force: Force = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> int | None:
    """Queue this scan, and with --wait see it through."""
    delivery = None if out is None else Delivery(out, force=force)
    if delivery is not None:
        delivery.check()
    with connect(rig, keys) as client:
        run = client.scan(spec, first=first)
        if delivery is None and not wait:
            if as_json:
                print_json(Run(run=run.info))
            else:
                print(run.id)
                if sys.stdout.isatty():
                    say(f"queued; umbra watch {run.id} follows it")
            return None
        with goes_on(run.id):
            follow(run)
        code = conclude(run.info)
        files = (
            []
            if delivery is None or code
            else fetch(client, run.info, delivery, wanted(run.info, ""))
        )
    if as_json:
        print_json(
            Fetched(run=run.info, files=tuple(map(str, files))) if files else Run(run=run.info)
        )
    elif files:
        for file in files:
            print(file)
    else:
        print(run.id)
    return code


class Methods(Family):
    """One command a scan method."""

    union = AnySeparation
    act = scan
    title = "Methods"


class Calibrations(Family):
    """One command a calibration."""

    union = AnyCalibration
    act = scan
    title = "Calibrations"
    prefix = "calibrate-"


app = typer.Typer(cls=Methods, rich_markup_mode=None, add_completion=False)


@app.callback(invoke_without_command=True)
def _scan(context: typer.Context, rig: Rig = None, keys: Keys = None) -> None:
    """Queue a scan; prints the run's id. --wait follows it, -o DIR fetches what it made.

    Each method has its own options: umbra scan METHOD --help.

    --json: a Run; with -o {"run": RunInfo, "files": [path, ...]}.
    """
    context.obj = {"rig": rig, "keys": keys}
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


calibrate = typer.Typer(cls=Calibrations, rich_markup_mode=None, add_completion=False)


@calibrate.callback(invoke_without_command=True)
def _calibrate(context: typer.Context, rig: Rig = None, keys: Keys = None) -> None:
    """Queue a calibration of the rig; prints the run's id. Later runs apply it by themselves.

    It is applied while the devices are the same ones and it is not too old (rig.toml:
    calibration.max_age_days). --wait and -o DIR as in `umbra scan`.

    --json: a Run; with -o {"run": RunInfo, "files": [path, ...]}.
    """
    context.obj = {"rig": rig, "keys": keys}
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


__all__: list[Any] = ["app", "calibrate", "scan"]
