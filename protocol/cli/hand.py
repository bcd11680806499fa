"""Work by hand: look through the camera, take a frame, set the camera, switch a light."""

from __future__ import annotations

import enum
import math
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from protocol.cli.delivery import write_file
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.options import build, options_of, with_options
from protocol.cli.output import on_terminal, print_facts, print_json, say
from protocol.errors import Code, UmbraError
from protocol.messages import Camera, CameraSettings, Done, Picture


class What(enum.StrEnum):
    """What a preview shows."""

    FRAME = "frame"
    DIRECT = "direct"
    GLOBAL = "global"


class Switch(enum.StrEnum):
    """The two positions of a light."""

    ON = "on"
    OFF = "off"


def preview(
    *,
    what: Annotated[What, typer.Argument(help="The latest frame, or the separation so far.")] = (
        What.FRAME
    ),
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE.png", help="Write a PNG file.")
    ] = None,
    width: Annotated[int, typer.Option(min=16, max=4096, help="Of the picture, pixels.")] = 640,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """The latest frame, small: drawn in the terminal, or written with -o.

    --json: a Picture (its facts, no pixels).
    """
    if out is None and not as_json and not on_terminal():
        raise UmbraError(
            Code.BAD_REQUEST, "standard output is no terminal to draw in: give -o FILE.png"
        )
    _png_name(out)
    columns, lines = shutil.get_terminal_size()
    if out is None:
        width = max(16, min(width, columns))  # a character cell shows one pixel of the width
    with connect(rig, keys) as client:
        picture = client.preview(width, what.value)
    from protocol.cli.picture import in_terminal, png

    if out is not None:
        write_file(out, png(picture.pixels))
    if as_json:
        print_json(Picture(facts=picture.facts))
    elif out is not None:
        print(out)
    else:
        sys.stdout.write(in_terminal(picture.pixels, columns, lines - 3) + "\n")
    if not as_json:
        _say_facts(picture.facts)


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
    _png_name(out)
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
        _say_facts(picture.facts)


def _png_name(out: Path | None) -> None:
    if out is not None and out.suffix.lower() != ".png":
        raise UmbraError(Code.BAD_REQUEST, f"{out}: pictures are PNG files: name it {out}.png")


def _say_facts(facts: dict[str, Any]) -> None:
    """What one wants to know when setting the exposure; the histogram as a line of bars."""
    told = []
    if "exposure_us" in facts:
        told.append(f"exposure {facts['exposure_us']:g} µs")
    if "mean" in facts and "full_scale" in facts:
        told.append(f"mean {facts['mean']:.0f} of {facts['full_scale']:.0f}")
    if "saturated" in facts:
        told.append(f"{100 * facts['saturated']:.2f} % saturated")
    if told:
        say(" · ".join(told))
    if facts.get("histogram") and on_terminal(sys.stderr):
        say(bars(facts["histogram"]))


def bars(histogram: Sequence[float]) -> str:
    """A histogram as one line of block characters, its height the square root of the count."""
    most = max(histogram) or 1
    return "".join(" ▁▂▃▄▅▆▇█"[math.ceil(8 * math.sqrt(count / most))] for count in histogram)


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
