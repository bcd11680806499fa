"""`umbra doctor`: what is wrong, here and on the rig, and what to do about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from importlib import metadata
from typing import Annotated

import typer

from protocol.cli.exits import Exit, exit_of
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.output import coloured, on_terminal, print_json
from protocol.errors import Code, UmbraError
from protocol.messages.findings import Check, Outcome
from protocol.messages.replies import Examined


def doctor(
    *,
    passive: Annotated[
        bool,
        typer.Option("--passive", help="Expose nothing, move nothing: also while a run goes on."),
    ] = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> int:
    """Check the rig: configuration, permissions, devices, clocks, disk, keys; and, by exposing,
    the projector's refresh, the trigger, the light and its latency.

    Takes some seconds, during which the projector flashes; what is shown by hand is taken down.
    Refused while a run goes on or somebody holds the rig, unless --passive. Exits with 0 when
    nothing failed (warnings are no failures), 1 when something did, 3 without a daemon.

    --json: an Examined.
    """
    checks, code = _examined(rig, keys, passive)
    if as_json:
        print_json(Examined(checks=tuple(checks)))
    else:
        _print(checks)
    return code


def _examined(rig: str | None, keys: str | None, passive: bool) -> tuple[list[Check], Exit]:
    try:
        with connect(rig, keys) as client:
            checks = list(client.examine(passive=passive))
    except UmbraError as error:
        code = exit_of(error.code)
        if code is not Exit.UNREACHABLE and error.code is not Code.BAD_KEYS:
            raise
        remedy = (
            "start it: systemctl start umbrad, or umbrad --config rig.toml; "
            "umbrad --check --config rig.toml says whether the configuration is good"
        )
        lost = Check(name="daemon", outcome=Outcome.FAILED, message=error.message, remedy=remedy)
        return [*_environment(), lost], code
    failed = any(check.outcome is Outcome.FAILED for check in checks)
    return checks, Exit.FAILED if failed else Exit.OK


def _environment() -> list[Check]:
    """Why a daemon in this environment might not even start."""
    try:
        version = metadata.version("python-daemon")
    except metadata.PackageNotFoundError:
        return []
    return [
        Check(
            name="environment",
            outcome=Outcome.FAILED,
            message=f"python-daemon {version} is in this environment, and its package `daemon` is "
            "Umbra's too",
            remedy="give Umbra an environment of its own; or pip uninstall python-daemon, then "
            "pip install --force-reinstall --no-deps umbra-rig",
        )
    ]


def _print(checks: Sequence[Check]) -> None:
    """One line a check, and what to do below those that need it."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{check.outcome.value:7}  {check.name:{width}}  {check.message}")
        if check.remedy and check.outcome is not Outcome.OK:
            lines.append(f"{'':7}  {'':{width}}  -> {check.remedy}")
    counts = Counter(check.outcome for check in checks)
    told = [f"{counts[outcome]} {outcome.value}" for outcome in Outcome if counts[outcome]]
    lines.append(", ".join(told))
    if not on_terminal():
        print("\n".join(lines))
        return
    from rich.console import Console

    console = Console(highlight=False)
    for line in lines:
        console.print(coloured(line), soft_wrap=True)
