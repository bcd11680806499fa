"""`umbra show PATTERN`: project a pattern by hand, for focusing and exposing."""

from __future__ import annotations

from typing import Annotated

import typer

from protocol.cli.family import Family
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.output import print_done
from protocol.patterns import BLACK, WHITE, AnyPattern

Lease = Annotated[
    float,
    typer.Option("--for", metavar="SECONDS", min=0.1, max=86_400, help="Then it goes dark."),
]


def show(
    pattern: AnyPattern,
    lease_s: Lease = 600.0,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Show this pattern."""
    with connect(rig, keys) as client:
        client.show(pattern, lease_s)
    print_done("shown", f"shown for {lease_s:g} s; umbra show off ends it", as_json=as_json)


def white(
    lease_s: Lease = 600.0, rig: Rig = None, keys: Keys = None, as_json: Json = False
) -> None:
    """Every pixel lit: for focus and exposure."""
    show(WHITE, lease_s, rig, keys, as_json)


def black(
    lease_s: Lease = 600.0, rig: Rig = None, keys: Keys = None, as_json: Json = False
) -> None:
    """Every pixel at level 0: the projector's own leakage remains."""
    show(BLACK, lease_s, rig, keys, as_json)


def off(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """End manual work: projector dark, lights off, stage held."""
    with connect(rig, keys) as client:
        client.dark()
    print_done("dark", as_json=as_json)


class Patterns(Family):
    """One command a pattern, and three that need no options."""

    union = AnyPattern
    act = show
    more = {"white": white, "black": black, "off": off}  # noqa: RUF012  (a ClassVar in Family)
    title = "Patterns"


app = typer.Typer(cls=Patterns, rich_markup_mode=None, add_completion=False)


@app.callback(invoke_without_command=True)
def _show(context: typer.Context, rig: Rig = None, keys: Keys = None) -> None:
    """Project a pattern by hand; it goes dark by itself after a while.

    --json: a Done.
    """
    context.obj = {"rig": rig, "keys": keys}
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
