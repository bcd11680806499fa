"""`umbra stage`: the occluder's stage by hand."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.output import print_facts, print_json
from protocol.errors import Code, UmbraError
from protocol.messages.replies import StageStatus
from protocol.messages.rig import StageState

if TYPE_CHECKING:
    from protocol.client import Client

_BUSY = {StageState.HOMING, StageState.MOVING}
_LOOK_S = 0.5
"""How often the state is asked for while waiting, where no event tells it sooner."""

Wait = Annotated[bool, typer.Option("-w", "--wait", help="Come back when the stage rests.")]
Feed = Annotated[
    float | None,
    typer.Option("--feed", metavar="MM_S", min=0.001, help="Default: half of the fastest."),
]

_SIGNED = {"ignore_unknown_options": True}
"""-10 is a place, not an option: after Grbl's homing every coordinate is negative."""

app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@app.callback()
def _stage(context: typer.Context, rig: Rig = None, keys: Keys = None) -> None:
    """Where the stage is, or move it by hand. Commands answer when the stage has accepted.

    --json: a StageStatus.
    """
    context.obj = {"rig": rig, "keys": keys}
    if context.invoked_subcommand is None:
        _act(rig, keys, as_json=False, wait=False, act=lambda client: client.stage())


@app.command()
def status(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """What the stage is doing, and where it is."""
    _act(rig, keys, as_json=as_json, wait=False, act=lambda client: client.stage())


@app.command()
def home(
    timeout_s: Annotated[
        float, typer.Option("--timeout", metavar="SECONDS", min=0.1, max=600)
    ] = 60.0,
    wait: Wait = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Find the origin: the position is known after that."""
    _act(rig, keys, as_json=as_json, wait=wait, act=lambda client: client.stage_home(timeout_s))


@app.command(context_settings=_SIGNED)
def move(
    x: Annotated[float, typer.Argument(metavar="X", help="mm.")],
    y: Annotated[float, typer.Argument(metavar="Y", help="mm.")],
    feed: Feed = None,
    wait: Wait = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Go straight to a point."""
    _act(
        rig,
        keys,
        as_json=as_json,
        wait=wait,
        act=lambda client: client.stage_move(x, y, _feed(client, feed)),
    )


@app.command(context_settings=_SIGNED)
def circle(
    x: Annotated[float, typer.Argument(metavar="X", help="Of the centre, mm.")],
    y: Annotated[float, typer.Argument(metavar="Y")],
    radius: Annotated[float, typer.Argument(metavar="RADIUS", min=0.001, help="mm.")],
    turns: Annotated[
        float | None,
        typer.Option("--turns", metavar="N", min=0.001, help="Default: until `umbra stage stop`."),
    ] = None,
    feed: Feed = None,
    wait: Wait = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Go round a circle, counter-clockwise."""
    if wait and turns is None:
        raise UmbraError(Code.BAD_REQUEST, "there is no end to wait for: give --turns", "--wait")
    _act(
        rig,
        keys,
        as_json=as_json,
        wait=wait,
        act=lambda client: client.stage_circle((x, y), radius, _feed(client, feed), turns),
    )


@app.command()
def stop(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """End every motion by hand, homing too; the stage holds. A run is ended by `umbra abort`."""
    _act(rig, keys, as_json=as_json, wait=False, act=lambda client: client.stage_stop())


@app.command()
def unlock(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """Leave the alarm without homing; the position stays unknown."""
    _act(rig, keys, as_json=as_json, wait=False, act=lambda client: client.stage_unlock())


def _feed(client: Client, feed: float | None) -> float:
    return client.stage().max_feed_mm_s / 2 if feed is None else feed


def _act(
    rig: str | None,
    keys: str | None,
    *,
    as_json: bool,
    wait: bool,
    act: Callable[[Client], StageStatus],
) -> None:
    with connect(rig, keys) as client:
        now = act(client)
        if wait:
            now = _rested(client)
    if as_json:
        print_json(now)
    else:
        print_facts(lines(now))
    if wait and now.detail and now.state is not StageState.IDLE:
        raise UmbraError(Code.DEVICE_REFUSED, now.detail)


def _rested(client: Client) -> StageStatus:
    """The status once the stage neither homes nor moves."""
    with client.subscribe("stage") as events:
        while (now := client.stage()).state in _BUSY:
            look = time.monotonic() + _LOOK_S
            while (left := look - time.monotonic()) > 0:
                notice = events.next(left)
                if notice is not None and getattr(notice.body, "state", None) not in _BUSY:
                    break
    return now


def lines(now: StageStatus) -> list[tuple[str, str]]:
    """What there is to say of a stage, as name and value."""
    (x0, x1), (y0, y1) = now.travel_mm
    where = "unknown: `umbra stage home` finds it"
    if now.position_mm is not None:
        where = f"{now.position_mm[0]:.3f}, {now.position_mm[1]:.3f} mm"
    elif now.state is StageState.HOMING:
        where = "not known yet"
    return [
        ("state", now.state.value),
        ("position", where),
        ("travel", f"x {x0:g} to {x1:g}, y {y0:g} to {y1:g} mm"),
        ("fastest", f"{now.max_feed_mm_s:g} mm/s"),
        ("detail", now.detail),
    ]
