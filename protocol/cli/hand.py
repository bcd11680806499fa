"""Work by hand: take a frame, set the camera, switch a light."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated, Any

import typer

from protocol.cli.delivery import write_file
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.options import build, options_of, with_options
from protocol.cli.output import print_facts, print_json
from protocol.cli.preview import png_name, say_facts
from protocol.errors import Code, UmbraError
from protocol.messages import Camera, CameraSettings, Done, Picture


class Switch(enum.StrEnum):
    """The two positions of a light."""

    ON = "on"
    OFF = "off"


def snap(
    *,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.png", help="The PNG file.")],
    raw: Annotated[
        bool, typer.Option("--raw", help="Keep a colour camera's mosaic as it is.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file.")] = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Take one frame as things are and save it as PNG, 8 or 16 bit as the camera gives it.

    --json: a Picture (its facts, no pixels).
    """
    png_name(out)
    if out.exists() and not force:
        raise UmbraError(
            Code.BAD_REQUEST, f"{out} is there already; give --force, or another name", "--out"
        )
    if not out.absolute().parent.is_dir():
        raise UmbraError(Code.BAD_REQUEST, f"{out.parent} is not a folder", "--out")
    with connect(rig, keys) as client:
        picture = client.snap(png=True, demosaic=not raw)
    write_file(out, picture.pixels.tobytes())
    if as_json:
        print_json(Picture(facts=picture.facts))
    else:
        print(out)
        say_facts(picture.facts)


# ---------------------------------------------------------------- camera, lights


def _camera(rig: Rig = None, keys: Keys = None, as_json: Json = False, **given: Any) -> None:
    """Read the camera's settings, or change those that are given.

    --json: a Camera.
    """
    wanted = build(CameraSettings, given)
    with connect(rig, keys) as client:
        settings = client.camera(
            exposure_us=wanted.exposure_us,
            gain=wanted.gain,
            pixel_format=wanted.pixel_format,
            frame_rate_hz=wanted.frame_rate_hz,
            roi=wanted.roi,
        )
    if as_json:
        print_json(Camera(settings=settings))
        return
    print_facts(
        [
            ("exposure", "" if settings.exposure_us is None else f"{settings.exposure_us:g} µs"),
            ("gain", "" if settings.gain is None else f"{settings.gain:g}"),
            ("pixel format", settings.pixel_format or ""),
            ("rate", "" if settings.frame_rate_hz is None else f"{settings.frame_rate_hz:g} Hz"),
            ("roi", "" if settings.roi is None else ",".join(map(str, settings.roi))),
        ]
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
    if as_json:
        print_json(Done(message=f"{name} {switch.value}"))
    else:
        print(f"{name} {switch.value}")
