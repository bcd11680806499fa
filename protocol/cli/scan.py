"""`umbra scan METHOD`: queue a scan; its options are the fields of the method's spec."""

from __future__ import annotations

import inspect
import json
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from protocol.cli.delivery import Delivery
from protocol.cli.family import Family, command_for, members
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.options import with_options
from protocol.cli.output import print_json, say
from protocol.cli.runs import Force, fetch, wanted
from protocol.cli.watch import conclude, follow, goes_on, tell
from protocol.cli.words import Fetched
from protocol.errors import Code, UmbraError
from protocol.messages import replies
from protocol.scans.anyscan import AnyCalibration, AnyScan, AnySeparation, AnyVerification
from protocol.scans.measuring import Advise
from protocol.spelling import did_you_mean, fields_at

if TYPE_CHECKING:
    from protocol.client import Client
    from protocol.run import Run


Wait = Annotated[bool, typer.Option("-w", "--wait", help="Follow the run; exit as it ended.")]
WaitOut = Annotated[
    Path | None,
    typer.Option("-o", "--out", metavar="DIR", help="Wait, then fetch the products to DIR."),
]


def scan(
    spec: AnyScan,
    *,
    wait: Wait = False,
    out: WaitOut = None,
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
        return see_through(client, run, delivery, wait=wait, as_json=as_json)


def see_through(
    client: Client, run: Run, delivery: Delivery | None, *, wait: bool, as_json: bool
) -> int | None:
    """Follow a run that was asked for, if that is wished, and fetch what it made."""
    if delivery is None and not wait:
        if as_json:
            print_json(replies.Run(run=run.info))
        else:
            print(run.id)
            if sys.stdout.isatty():
                say(f"queued; umbra watch {run.id} follows it")
        return None
    with goes_on(run.id):
        follow(run)
    code = conclude(run.info)
    if not as_json and not code:
        tell(run.facts())
    files = (
        [] if delivery is None or code else fetch(client, run.info, delivery, wanted(run.info, ""))
    )
    if as_json:
        print_json(
            Fetched(run=run.info, files=tuple(map(str, files)))
            if files
            else replies.Run(run=run.info)
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


class Verifications(Family):
    """One command an experiment of §3.5."""

    union = AnyVerification
    act = scan
    title = "Experiments"
    prefix = "verify-"


def spec_in(file: Path) -> AnyScan:
    """The spec in a TOML or JSON file: `method` and its fields. Raises UmbraError(bad_request)."""
    table: Any = None
    try:
        text = file.read_text(encoding="utf-8")
        table = json.loads(text) if file.suffix == ".json" else tomllib.loads(text)
        spec: AnyScan = msgspec.convert(table, type=AnyScan)
    except OSError as error:
        raise UmbraError(Code.BAD_REQUEST, f"{file}: {error.strerror}", "--file") from error
    except ValueError as error:  # of either format, of the encoding, or msgspec's own
        message = str(error).replace("`", "").replace("Object contains", "there is an")
        raise UmbraError(
            Code.BAD_REQUEST, f"{file}: {message}{_meant(str(error), table)}", "--file"
        ) from error
    return spec


def _meant(problem: str, table: Any) -> str:
    """What msgspec's problem with a spec may be a typing error of."""
    what, _, path = problem.partition(" - at ")
    methods = members(AnyScan)
    method = table.get("method") if isinstance(table, dict) else None
    if method not in methods:
        return did_you_mean(method, methods) if isinstance(method, str) else ""
    if not what.startswith("Object contains unknown field"):
        return ""
    return did_you_mean(what.split("`")[1], fields_at(methods[method], path))


def _scan(
    context: typer.Context,
    file: Annotated[
        Path | None,
        typer.Option("--file", metavar="FILE", help="The scan, as TOML or JSON, for no METHOD."),
    ] = None,
    **given: Any,
) -> int | None:
    """Queue a scan; prints the run's id. --wait follows it, -o DIR fetches what it made.

    Each method has its own options: umbra scan METHOD --help.

    --json: a Run; with -o {"run": RunInfo, "files": [path, ...]}.
    """
    context.obj = {"rig": given["rig"], "keys": given["keys"]}
    method = context.invoked_subcommand
    misplaced = [n for n, value in given.items() if value and n not in {"rig", "keys"}]
    if method is not None and (file or misplaced):
        flag = "--file" if file else "--" + misplaced[0].removeprefix("as_")
        raise UmbraError(
            Code.BAD_REQUEST,
            f"{flag} and {method}: give one or the other"
            if file
            else f"{flag} belongs after the method: umbra scan {method} {flag} ...",
        )
    if file is not None:
        return scan(spec_in(file), **given)
    if method is None:
        typer.echo(context.get_help())
    return None


app = typer.Typer(cls=Methods, rich_markup_mode=None, add_completion=False)
app.callback(invoke_without_command=True)(
    with_options(_scan, list(inspect.signature(scan, eval_str=True).parameters.values())[1:])
)


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


verify = typer.Typer(cls=Verifications, rich_markup_mode=None, add_completion=False)


@verify.callback(invoke_without_command=True)
def _verify(context: typer.Context, rig: Rig = None, keys: Keys = None) -> None:
    """Queue a verification experiment of the paper (3.5); prints the run's id.

    Points of interest are camera pixels: --point 320,240 or --point wall=320,240, several times.
    --wait and -o DIR as in `umbra scan`.

    --json: a Run; with -o {"run": RunInfo, "files": [path, ...]}.
    """
    context.obj = {"rig": rig, "keys": keys}
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


advise = command_for(Advise, scan)
