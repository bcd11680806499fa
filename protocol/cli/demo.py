"""`umbra demo`: the whole path on a simulated scene, whose true components are known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.cli.delivery import Delivery
from protocol.cli.family import tag_option
from protocol.cli.link import Json
from protocol.cli.methods import METHODS, spec_of, union_options
from protocol.cli.options import with_options
from protocol.cli.output import print_facts, print_json, say
from protocol.cli.private import private_daemon
from protocol.cli.runs import fetch, wanted
from protocol.cli.watch import follow, must_be_done
from protocol.cli.words import Fetched, frames
from protocol.errors import Code, UmbraError
from protocol.scans.anyscan import AnySeparation

if TYPE_CHECKING:
    from protocol.run import Run

OUT = Path("umbra-demo")
PROJECTED: dict[str, Any] = {kind: {"driver": "virtual"} for kind in ("camera", "projector")}
CARRIED = {"mesh": "mesh-square", "stick": "stick"}
"""What the virtual stage carries under the lamp, by method."""
HOLES = {"hole_mm": 6.25, "pitch_mm": 10.0}


class Demonstrated(Fetched, frozen=True, kw_only=True):
    """What `--json` prints: the run, its files, and how far from the truth it came."""

    truth: dict[str, Any]


def _demo(
    *,
    method: Annotated[
        str, tag_option(AnySeparation, "-m", "--method", help_text="The scan.")
    ] = "checkerboard",
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="OUT", help=f"Folder for the products; ./{OUT}."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace files in OUT (in ./umbra-demo: always).")
    ] = False,
    speed: Annotated[
        float,
        typer.Option(
            metavar="X", min=0.1, max=1000, help="Of the simulated clock; 1 is real time."
        ),
    ] = 1.0,
    as_json: Json = False,
    **given: Any,
) -> None:
    """Separate a simulated scene: the paper's 25 checkerboard images, compared with the truth.

    Starts a daemon of its own on a virtual projector and camera (a mesh or a stick: on a lamp, a
    stage and a camera), and stops it.

    --json: {"run": RunInfo, "files": [path, ...], "truth": {"rmse_direct", "rmse_global", "unit"}}.
    """
    delivery = Delivery(out or OUT, force=force or out is None)
    delivery.check()
    if method in CARRIED:
        given = {**_shaded(method), **{n: v for n, v in given.items() if v is not None}}
    spec = spec_of(method, given)
    config = {"rig": {"time_scale": speed}, "storage": {"reserve_mb": 0}, **_devices(method)}
    try:
        with private_daemon(config) as client:
            run = client.scan(spec)
            follow(run, title=f"virtual rig, {method}")
            must_be_done(run.info)
            truth, good = _truth(run)
            files = fetch(client, run.info, delivery, wanted(run.info, ""))
    except KeyboardInterrupt:
        say(f"\numbra: stopped; nothing was written to {delivery.folder}")
        raise
    if as_json:
        files_told = tuple(map(str, files))
        print_json(Demonstrated(run=run.info, files=files_told, truth=truth))
        return
    print_facts(
        [
            ("scan", f"{method}, {frames(run.info)}"),
            ("direct", _rmse(truth, "direct")),
            ("global", _rmse(truth, "global")),
            ("pixels", f"{good:.1%} of all carry no flag; the RMSE is over these"),
            ("report", str(next((f for f in files if f.suffix == ".html"), delivery.folder))),
        ]
    )


def _devices(method: str) -> dict[str, Any]:
    """The virtual rig's tables."""
    if method not in CARRIED:
        return PROJECTED
    return {
        "camera": {"driver": "virtual", "width": 320, "height": 240, "frame_rate_hz": 10},
        "stage": {"driver": "virtual", "occluder": CARRIED[method]},
        "light": [{"name": "lamp", "driver": "virtual"}],
    }


def _shaded(method: str) -> dict[str, Any]:
    """What a scan under the lamp is told, unless the user says otherwise."""
    return {"references": "ambient", **(HOLES if method == "mesh" else {})}


def _truth(run: Run) -> tuple[dict[str, Any], float]:
    """How far the separation is from the simulated scene's own components, and the share of the
    pixels that this is of."""
    facts = run.result().facts
    truth = facts.get("truth")
    if not isinstance(truth, dict):
        raise UmbraError(Code.INTERNAL, "the virtual rig's run came without its truth")
    return truth, float(facts.get("good", {}).get("fraction", 0.0))


def _rmse(truth: dict[str, Any], name: str) -> str:
    error = truth[f"rmse_{name}"]
    if error is None:
        return "not measured: no pixel is without a flag"
    return f"RMSE {error:.4f} ({truth['unit']}) against the scene's truth"


demo = with_options(_demo, [option.parameter() for option in union_options(METHODS)])
