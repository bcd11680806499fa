"""The options that every command shares: which rig, which keys, facts as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from protocol.client import Client


def _from_root(
    context: typer.Context, parameter: typer.CallbackParam, value: str | None
) -> str | None:
    """An option given before the command's name counts for it too: umbra --rig X status."""
    given = context.obj or {}
    return value or given.get(parameter.name)


Rig = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="ENDPOINT",
        callback=_from_root,
        help="Where umbrad listens; default UMBRA_RIG, or tcp://127.0.0.1:5750.",
    ),
]
Keys = Annotated[
    str | None,
    typer.Option(
        "--keys",
        metavar="FOLDER",
        callback=_from_root,
        help="Folder of the CURVE keys; default UMBRA_KEYS.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the protocol's own structs as JSON.")]
RunId = Annotated[
    str, typer.Argument(metavar="[RUN]", help="A run's id; without, the current or newest one.")
]


def connect(rig: str | None, keys: str | None) -> Client:
    """A client of the rig, which has said hello. Raises UmbraError: unreachable ..."""
    from protocol.client import Client

    return Client(rig, keys=keys)
