"""`umbra keys`: make CURVE keys, and say who may talk to a rig. Works on folders, not on a rig."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Annotated

import typer
from msgspec import Struct

from protocol.cli.link import Json
from protocol.cli.output import print_json, print_table, say
from protocol.messages.access import Role

SERVER_FOLDER = Path("/etc/umbra/keys")

Folder = Annotated[
    Path,
    typer.Option(
        "--keys-dir",
        metavar="DIR",
        help="The daemon's folder of keys, [network] keys in rig.toml.",
    ),
]


class Allowed(Struct, frozen=True, kw_only=True):
    """A key that may come in."""

    name: str
    role: Role
    public: str


app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@app.callback()
def _keys(context: typer.Context) -> None:
    """Make, authorise, list and revoke CURVE keys.

    On the rig: umbra keys new server --into /etc/umbra/keys. On your machine: umbra keys new, and
    copy the rig's server.key beside it. On the rig again: umbra keys authorize NAME.key --role
    operator.
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def new(
    name: Annotated[
        str, typer.Argument(metavar="[NAME]", help="Default: this machine's name.")
    ] = "",
    into: Annotated[
        Path | None,
        typer.Option("--into", metavar="DIR", help="Default: UMBRA_KEYS, or ~/.config/umbra/keys."),
    ] = None,
) -> None:
    """Make a key pair: NAME.key may be given away, NAME.key_secret stays here."""
    from protocol import keys

    public, secret = keys.new(
        into or keys.default_folder(), name or socket.gethostname().partition(".")[0]
    )
    print(public)
    say(f"the secret half is {secret}: it stays on this machine")


@app.command()
def authorize(
    key: Annotated[Path, typer.Argument(metavar="NAME.key", help="A client's public key.")],
    role: Annotated[Role, typer.Option(help="observer reads; operator may do everything.")] = (
        Role.OBSERVER
    ),
    keys_dir: Folder = SERVER_FOLDER,
) -> None:
    """Let a client in; a role that it had before ends. The daemon sees it at once."""
    from protocol import keys

    print(keys.authorize(keys_dir, key, role))


@app.command("list")
def list_(keys_dir: Folder = SERVER_FOLDER, as_json: Json = False) -> None:
    """Who may come in.

    --json: a list of {"name", "role", "public"}.
    """
    from protocol import keys

    found = [
        Allowed(name=name, role=role, public=public)
        for public, (role, name) in keys.allowed(keys_dir).items()
    ]
    if as_json:
        print_json(found)
    elif found:
        print_table(
            ["name", "role", "public key"], [[k.name, k.role.value, k.public] for k in found]
        )
    else:
        say(f"{keys_dir} lets nobody in; see umbra keys authorize --help")


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME")], keys_dir: Folder = SERVER_FOLDER
) -> None:
    """Let a client in no longer, whatever its role."""
    from protocol import keys

    keys.revoke(keys_dir, name)
    print(f"{name} is revoked")
