"""Work by hand: take a frame, set the camera, switch a light."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from protocol.cli.delivery import write_file
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.options import build, options_of, with_options
from protocol.cli.output import print_done, print_facts, print_json, say
from protocol.cli.preview import png_name, say_facts
from protocol.errors import Code, UmbraError
from protocol.messages.replies import Camera, Picture
from protocol.messages.rig import CameraSettings

if TYPE_CHECKING:
    from protocol.client import Client


class Switch(enum.StrEnum):
    """The two positions of a light."""

    ON = "on"
    OFF = "off"


def snap(
    *,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE.png", help="The PNG file; without: the facts."),
    ] = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="Keep a colour camera's mosaic as it is.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file.")] = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Take one frame as things are: how bright it is and what saturates, and with -o the frame
    itself as PNG, 8 or 16 bit as the camera gives it.

    --json: a Picture (its facts, no pixels).
    """
    if out is not None:
        png_name(out)
        if out.exists() and not force:
            raise UmbraError(
                Code.BAD_REQUEST, f"{out} is there already; give --force, or another name", "--out"
            )
        if not out.absolute().parent.is_dir():
            raise UmbraError(Code.BAD_REQUEST, f"{out.parent} is not a folder", "--out")
    with connect(rig, keys) as client:
        picture = client.snap(png=True, demosaic=not raw)
    if out is not None:
        write_file(out, picture.pixels.tobytes())
    if as_json:
        print_json(Picture(facts=picture.facts))
        return
    if out is not None:
        print(out)
    say_facts(picture.facts)


# ---------------------------------------------------------------- camera, lights


def _camera(
    *,
    auto_exposure: Annotated[
        bool,
        typer.Option(
            "--auto-exposure",
            help="Choose the exposure for the scene as it is lit now; one that is given is the "
            "longest.",
        ),
    ] = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
    **given: Any,
) -> None:
    """Read the camera's settings, or change those that are given.

    --auto-exposure takes a few pictures: show white or switch the lights on first (umbra show
    white). Under a projector the exposure is a whole number of its periods.

    --json: a Camera.
    """
    wanted = build(CameraSettings, given)
    facts: dict[str, Any] = {}
    with connect(rig, keys) as client:
        if auto_exposure:
            longest_us = wanted.exposure_us
            wanted = msgspec.structs.replace(wanted, exposure_us=None)
            if wanted != CameraSettings():
                _set(client, wanted)
            facts = client.auto_exposure(longest_us)
            wanted = CameraSettings()
        settings = _set(client, wanted)
    if as_json:
        print_json(Camera(settings=settings, facts=facts))
        return
    lines = [
        ("exposure", "" if settings.exposure_us is None else f"{settings.exposure_us:g} µs"),
        ("gain", "" if settings.gain is None else f"{settings.gain:g}"),
        ("pixel format", settings.pixel_format or ""),
        ("rate", "" if settings.frame_rate_hz is None else f"{settings.frame_rate_hz:g} Hz"),
        ("roi", "" if settings.roi is None else ",".join(map(str, settings.roi))),
    ]
    if facts:
        lines.insert(1, ("brightest", f"{facts['brightest']:.1%} of full scale"))
    print_facts(lines)
    if "problem" in facts:
        say(f"umbra: {facts['problem']}")


def _set(client: Client, wanted: CameraSettings) -> CameraSettings:
    return client.camera(
        exposure_us=wanted.exposure_us,
        gain=wanted.gain,
        pixel_format=wanted.pixel_format,
        frame_rate_hz=wanted.frame_rate_hz,
        roi=wanted.roi,
    )


camera = with_options(_camera, [option.parameter() for option in options_of(CameraSettings)])


def light(
    name: Annotated[str, typer.Argument(metavar="NAME", help="As in rig.toml.")],
    switch: Annotated[Switch, typer.Argument(metavar="on|off")],
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Switch a light.

    --json: a Done.
    """
    with connect(rig, keys) as client:
        client.light(name, switch is Switch.ON)
    print_done(f"{name} {switch.value}", as_json=as_json)
