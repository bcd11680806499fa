"""`umbra patterns`: a scan's patterns as images, for a projector and a camera of one's own."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from protocol.cli.delivery import Delivery, write_file
from protocol.cli.link import Json
from protocol.cli.methods import METHODS, spec_of, union_options
from protocol.cli.options import with_options
from protocol.cli.output import print_json, say
from protocol.cli.private import private_daemon
from protocol.cli.runs import Force
from protocol.errors import Code, UmbraError
from protocol.patterns import Axis
from protocol.scans.projected import GrayCode, PatternScan

SHOWN = {
    *("checker", "shift", "shifts", "periods", "phases", "axis", "weave", "patch", "seed"),
    *("axes", "bits", "patterns", "lit_fraction", "stripe"),
}
"""The fields of a scan that say what is projected."""
PATTERNED = [name for name, spec in METHODS.items() if issubclass(spec, PatternScan)]
OPTIONS = [option for option in union_options(PATTERNED) if option.name in SHOWN]
CAMERA = {"driver": "virtual"}  # a daemon has one; it is not looked through


def _patterns(
    *,
    method: Annotated[
        str, typer.Option("-m", "--method", metavar="|".join(PATTERNED), help="The scan.")
    ],
    size: Annotated[
        str, typer.Option(metavar="WxH", help="The projector's own resolution: 1920x1080.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder for the images.")],
    gamma: Annotated[
        float,
        typer.Option(
            metavar="X",
            min=0.1,
            max=10,
            help="The projector's light is level to this power: taken off, as sinusoids need.",
        ),
    ] = 1.0,
    force: Force = False,
    as_json: Json = False,
    **given: Any,
) -> None:
    """Write a scan's patterns as images, and say how to separate photographs of them.

    OUT gets black.png, white.png and pattern-01.png, pattern-02.png ... in the scan's order, 8-bit
    grey, one file pixel for each of the projector's: show them full screen and unscaled, and take
    one photograph of each, all of one exposure.

    --json: {"files": [path, ...], "command": the command that separates the photographs}.
    """
    width, height = _sized(size)
    spec: Any = spec_of(method, given)
    if isinstance(spec, GrayCode) and spec.bits is None:  # photographs need it told, for all axes
        side = max(width if axis is Axis.X else height for axis in spec.axes)
        given = {**given, "bits": max(1, (side - 1).bit_length())}
        spec = msgspec.structs.replace(spec, bits=given["bits"])
    delivery = Delivery(out, force=force)
    delivery.check(("black.png", "white.png"))
    with (
        private_daemon({"camera": CAMERA, "storage": {"reserve_mb": 0}}) as client,
        delivery.receive() as folder,
    ):
        names: list[str] = []
        count = 1
        while len(names) < count:
            picture = client.draw(spec, len(names), width, height, gamma=gamma)
            count = picture.facts["images"]
            light = picture.facts["lighting"]
            digits = len(str(count - 2))
            name = light if light != "pattern" else f"pattern-{len(names) - 1:0{digits}d}"
            names.append(f"{name}.png")
            write_file(folder / names[-1], picture.pixels.tobytes())
    command = _separation(method, given)
    files = [delivery.folder / name for name in names]
    if as_json:
        print_json({"files": [str(file) for file in files], "command": command})
        return
    for file in files:
        print(file)
    say(
        "photograph the scene under each; of the patterns' photographs, named in this order and in "
        f"a folder of their own, make\n  {command}"
    )


def _sized(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0
    if not (0 < width <= 16_384 and 0 < height <= 16_384):
        raise UmbraError(
            Code.BAD_REQUEST, f"--size: {text!r} is not a resolution such as 1920x1080", "--size"
        )
    return width, height


def _separation(method: str, given: dict[str, Any]) -> str:
    """The command for photographs of the patterns."""
    flags = {option.name: option.flag for option in OPTIONS}
    words = ["umbra", "separate", "PHOTOS", "-m", method]
    for name, value in given.items():
        if value is not None:
            words += [flags[name], str(value)]
    words += ["--black-frame", "BLACK", "--white-frame", "WHITE", "-o", "OUT"]
    return shlex.join(words)


patterns = with_options(_patterns, [option.parameter() for option in OPTIONS])
