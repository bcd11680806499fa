"""`umbra`: the table of commands, loaded one at a time so that none waits for the rest."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import typer
from typer.core import TyperGroup
from typer.main import get_command

from protocol.cli.exits import Exit, exit_of
from protocol.errors import UmbraError

SECTIONS: dict[str, dict[str, tuple[str, str]]] = {
    "Without a rig": {
        "demo": ("demo:demo", "Separate a simulated scene: a first look, no hardware needed."),
        "patterns": (
            "patterns:patterns",
            "Write a scan's patterns as images, to project them by other means.",
        ),
        "separate": ("separate:separate", "Separate photographs or a video that you already have."),
    },
    "Scans": {
        "scan": ("scan:app", "Queue a scan: checkerboard, two-image, mesh ..."),
        "calibrate": ("scan:calibrate", "Calibrate the rig: dark, noise, leak, tone, latency."),
        "verify": ("scan:verify", "Verify the separation at points, as the paper does (3.5)."),
        "plan": ("plan:app", "Work out radius, feed and frames of a mesh scan; no rig needed."),
        "advise": ("scan:advise", "Which pattern, images and exposure this scene needs."),
        "watch": ("watch:watch", "Follow a run: progress, rate, time left."),
        "runs": ("runs:runs", "List runs, the newest first."),
        "run": ("runs:run", "One run in detail."),
        "get": ("runs:get", "Fetch a run's products: direct, global, report ..."),
        "reprocess": ("reprocess:reprocess", "Separate a run's frames anew, with other numbers."),
        "queue": ("runs:queue", "List the waiting runs, or move one."),
        "pause": ("runs:pause", "Pause the run after the step under way."),
        "resume": ("runs:resume", "Go on with a paused or interrupted run."),
        "abort": ("runs:abort", "End a run, waiting or running; keep what was recorded."),
    },
    "The rig": {
        "status": ("rig:status", "What the rig is doing now."),
        "devices": ("rig:devices", "The devices and their health."),
        "doctor": ("doctor:doctor", "What is wrong with the rig, and what to do about it."),
        "methods": ("rig:methods", "The scan methods that the daemon knows."),
        "log": ("rig:log", "The last log records of a run, or of the daemon."),
        "stop": ("rig:stop", "Emergency stop: safe state now, until `umbra reset`."),
        "reset": ("rig:reset", "End an emergency stop."),
        "keys": ("keys:app", "Make, authorise, list and revoke CURVE keys."),
    },
    "By hand": {
        "preview": (
            "preview:preview",
            "Look through the camera, once or live.",
        ),
        "show": ("show:app", "Project a pattern: white, black, off, checker ..."),
        "snap": ("hand:snap", "Take one frame and save it as PNG."),
        "camera": ("hand:camera", "Read or change the camera's settings."),
        "light": ("hand:light", "Switch a light on or off."),
        "stage": ("stage:app", "Where the stage is; home, move, circle, stop, unlock."),
    },
}

EPILOG = (
    "Exit codes: 0 done, 1 failed, 2 usage or bad input, 3 no daemon (or another version), "
    "4 refused, 5 the run was aborted, 130 Ctrl-C (the run goes on)."
)


class LazyGroup(TyperGroup):
    """A group whose commands are imported when they are asked for.

    `sections` maps a heading to commands: name -> ("module:attribute" below protocol.cli, line).
    """

    sections: ClassVar[Mapping[str, Mapping[str, tuple[str, str]]]] = {}

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """Every name, in the order of the table."""
        return [name for table in self.sections.values() for name in table]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002
        """Import the command's module; None if there is no such command."""
        for table in self.sections.values():
            if cmd_name in table:
                module, _, attribute = table[cmd_name][0].partition(":")
                found = getattr(importlib.import_module(f"protocol.cli.{module}"), attribute)
                return command_of(cmd_name, found)
        return None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As typer does, with names to suggest that are not loaded yet."""
        names: Any = dict.fromkeys(self.list_commands(ctx))
        self.commands = names
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """The table as help, without loading a command."""
        for title, table in self.sections.items():
            with formatter.section(title):
                formatter.write_dl([(name, line) for name, (_, line) in table.items()])


def command_of(name: str, found: Any) -> Any:
    """A typer app, or a function, as the command `name`."""
    if not isinstance(found, typer.Typer):
        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        app.command(name)(found)
        found = app
    command = get_command(found)
    command.name = name
    return command


class Root(LazyGroup):
    """`umbra` itself."""

    sections = SECTIONS


app = typer.Typer(
    cls=Root,
    rich_markup_mode=None,  # help without rich's hundred milliseconds, and easy to grep
    pretty_exceptions_enable=False,
    epilog=EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        from protocol.messages.envelopes import PROTOCOL

        typer.echo(f"umbra {version('umbra-rig')} (protocol {PROTOCOL})")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    rig: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            envvar="UMBRA_RIG",
            help="Where umbrad listens; default tcp://127.0.0.1:5750.",
        ),
    ] = None,
    keys: Annotated[
        str | None,
        typer.Option(metavar="FOLDER", envvar="UMBRA_KEYS", help="Folder of the CURVE keys."),
    ] = None,
    version: Annotated[  # noqa: ARG001  (acted upon by its callback)
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Drive an Umbra rig: scans that part a scene's direct light from its global light."""
    context.obj = {"rig": rig, "keys": keys}
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def run(arguments: list[str]) -> int:
    """Run one command line; what goes wrong becomes one line on stderr and an exit code."""
    try:
        code = get_command(app)(arguments, prog_name="umbra", standalone_mode=False)
    except UmbraError as error:
        complain(error.message)
        return exit_of(error.code)
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    except typer.Abort:
        return Exit.INTERRUPTED
    except BrokenPipeError:
        # the reader of a pipe has gone (umbra runs | head): nothing to say, nobody to say it to
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.OK
    except Exception as error:
        if not hasattr(error, "format_message"):  # typer's usage errors have it
            raise
        where = getattr(getattr(error, "ctx", None), "command_path", "umbra")
        said = error.format_message().rstrip(".")
        complain(f"{said}{' See' if said.endswith('?') else '; see'} {where} --help")
        return Exit.USAGE
    return code if isinstance(code, int) else Exit.OK


def complain(message: str) -> None:
    """One line on stderr."""
    print("umbra: " + " ".join(message.split()), file=sys.stderr)


def main() -> None:
    """Entry point of the `umbra` script."""
    sys.exit(run(sys.argv[1:]))
