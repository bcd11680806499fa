"""`umbra separate`: photographs that were taken already, through the same daemon and pipeline."""

from __future__ import annotations

import enum
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.cli.delivery import Delivery
from protocol.cli.family import tag_option
from protocol.cli.link import Json
from protocol.cli.methods import METHODS, spec_of, union_options
from protocol.cli.options import with_options
from protocol.cli.output import print_json, say
from protocol.cli.private import private_daemon
from protocol.cli.runs import Force, fetch, wanted
from protocol.cli.watch import follow, must_be_done, tell
from protocol.cli.words import Fetched, frames
from protocol.errors import Code, UmbraError
from protocol.messages.rig import Health
from protocol.messages.runs import RunInfo
from protocol.scans.anyscan import AnySeparation
from protocol.scans.projected import PatternScan
from protocol.scans.spec import Reference

if TYPE_CHECKING:
    from protocol.client import Client

LIVE = {
    *("exposure_us", "gain", "references", "lights", "frame_rate_hz", "feed_mm_s"),
    *("coverage", "time_limit_s", "sweeps", "sweep_mm", "radius_mm", "centre_mm"),
    *("auto_exposure", "deadline_s", "light_min", "light_max", "steady", "look_s"),
}
"""Fields that are no options here: the photographs have them, or the files given say them."""
TYPED = {"path": "DIR", "match": "--match", "bayer": "--bayer", "bits": "--depth"}
"""What is typed for the keys of the recording's driver."""
OPTIONS = union_options(METHODS, without=LIVE)


class Depth(enum.StrEnum):
    """Significant bits of a sample."""

    TEN = "10"
    TWELVE = "12"
    FOURTEEN = "14"
    SIXTEEN = "16"


class Bayer(enum.StrEnum):
    """The upper left corner of a colour mosaic."""

    RG = "RG"
    GR = "GR"
    GB = "GB"
    BG = "BG"


def _frame(what: str) -> Any:
    text = f"A photograph of the scene {what}; of a bracket once for each exposure."
    return typer.Option(metavar="FILE", help=text)


def _separate(
    *,
    source: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder of images in natural order, or a video.")
    ],
    method: Annotated[
        str, tag_option(AnySeparation, "-m", "--method", help_text="How the scene was lit.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="OUT", help="Folder for the products.")
    ],
    black_frame: Annotated[list[Path] | None, _frame("with the projector showing black")] = None,
    white_frame: Annotated[list[Path] | None, _frame("with the projector showing white")] = None,
    ambient_frame: Annotated[list[Path] | None, _frame("with the source off")] = None,
    open_frame: Annotated[
        list[Path] | None, _frame("with no occluder before the source (mesh)")
    ] = None,
    bayer: Annotated[
        Bayer | None, typer.Option(help="The images are a raw colour mosaic that begins so.")
    ] = None,
    depth: Annotated[
        Depth | None,
        typer.Option(
            metavar="<10|12|14|16>",
            help="Bits of a sample, where files of 16 hold fewer: 12 for counts up to 4095.",
        ),
    ] = None,
    match: Annotated[
        str, typer.Option(metavar="GLOB", help="Which of the folder's names are frames.")
    ] = "*",
    force: Force = False,
    as_json: Json = False,
    **given: Any,
) -> None:
    """Separate photographs or a video that you already have into direct and global light.

    With --bracket, DIR holds each pattern's images one after the other, in the bracket's order.

    OUT gets direct.tiff and global.tiff (float32, linear, RGB), quality, preview and report: all
    of them, or nothing if anything is wrong.

    --json: {"run": RunInfo, "files": [path, ...]}.
    """
    shots = {
        Reference.BLACK: black_frame,
        Reference.WHITE: white_frame,
        Reference.AMBIENT: ambient_frame,
        Reference.OPEN: open_frame,
    }
    first = {kind: [file.absolute() for file in files] for kind, files in shots.items() if files}
    spec = spec_of(method, given, references=list(first))
    bracket = spec.bracket if isinstance(spec, PatternScan) else None
    _each_exposure(first, bracket or (1.0,))
    ahead = [file for files in first.values() for file in files]
    delivery = Delivery(out, force=force)
    delivery.check()
    for file in (source, *ahead):
        if not file.exists():
            raise UmbraError(Code.BAD_INPUT, f"{file} does not exist")
    config = {
        "camera": {
            "driver": "replay",
            "path": str(source.absolute()),
            "first": [str(file) for file in ahead],
            "match": match,
            "bayer": bayer.value if bayer else None,
            "bits": int(depth.value) if depth else None,
        },
        # the photographs are the originals: no second copy of them
        "storage": {"keep_frames": False, "reserve_mb": 0},
    }
    try:
        with private_daemon(config) as client:
            usable(client)
            run = client.scan(spec)
            follow(run, title=f"{source.name or source} {method}")
            must_be_done(run.info)
            files = fetch(client, run.info, delivery, wanted(run.info, ""))
            facts = run.facts()
    except KeyboardInterrupt:
        say(f"\numbra: stopped; nothing was written to {out}")
        raise
    if not as_json and given.get("tone") is None and curved(source, match):
        say(
            "advice: JPEG files and videos are usually encoded as sRGB, and were taken as linear: "
            "give --tone srgb, or --tone linear if they are"
        )
    report(run.info, files, facts, as_json)


def curved(source: Path, match: str = "*") -> bool:
    """Whether the recording is a video, or JPEG: seldom linear, whoever took it."""
    if source.is_file():
        return True
    return any(file.suffix.lower() in (".jpg", ".jpeg") for file in source.glob(match))


def _each_exposure(first: Mapping[Reference, list[Path]], exposures: tuple[float, ...]) -> None:
    """Raise UmbraError(bad_input) unless each kind of photograph is there at each exposure."""
    for kind, files in first.items():
        if len(files) != len(exposures):
            each = ", ".join(f"{exposure:g}" for exposure in exposures)
            wanted = (
                f"the {len(exposures)} exposures of the bracket ({each}) take --{kind}-frame "
                f"{len(exposures)} times, in that order"
                if len(exposures) > 1
                else f"--{kind}-frame is given once, unless exposures are bracketed (--bracket)"
            )
            raise UmbraError(Code.BAD_REQUEST, f"{wanted}: {len(files)} files were given")


def as_typed(message: str) -> str:
    """A message of the recording's driver with its keys as they were given: options, or DIR."""
    return re.sub(r"`(\w+)`", lambda key: TYPED.get(key[1], key[0]), message)


def usable(client: Client) -> None:
    """Raise UmbraError(bad_input) with the camera's own words if it cannot read its recording."""
    for device in client.devices():
        if device.health is not Health.READY:
            said = device.message.removeprefix("connect: ")
            raise UmbraError(Code.BAD_INPUT, as_typed(said))


def report(info: RunInfo, files: Iterable[Path], facts: Mapping[str, Any], as_json: bool) -> None:
    """Say what was written, and what is to be known of it."""
    if as_json:
        print_json(Fetched(run=info, files=tuple(map(str, files))))
        return
    good = facts.get("good", {}).get("fraction")
    share = f", {good:.1%} of the pixels without a flag" if isinstance(good, float) else ""
    say(f"separated {frames(info)}{share}")
    tell(facts)
    for file in files:
        print(file)


separate = with_options(_separate, [option.parameter() for option in OPTIONS])
