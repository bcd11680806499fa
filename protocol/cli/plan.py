"""`umbra plan`: what a scan should be like, worked out without a rig."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Annotated

import typer

from protocol.cli.link import Json
from protocol.cli.output import print_facts, print_json
from protocol.errors import Code, UmbraError
from protocol.penumbra import penumbra_mm
from protocol.scans.occluded import SUN_DEG, Grid

app = typer.Typer(rich_markup_mode=None, add_completion=False)


@app.callback(invoke_without_command=True)
def _plan(context: typer.Context) -> None:
    """Work out a scan before it is made; no daemon is needed."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command("mesh")
def mesh(
    *,
    hole: Annotated[float, typer.Option("--hole-mm", metavar="X", help="Diameter of a hole.")],
    pitch: Annotated[float, typer.Option("--pitch-mm", metavar="X", help="From hole to hole.")],
    grid: Annotated[Grid, typer.Option(help="How the holes lie.")] = Grid.SQUARE,
    scene: Annotated[
        float, typer.Option("--scene-mm", metavar="X", help="From the mesh to the scene.")
    ] = 0.0,
    source: Annotated[
        float,
        typer.Option(
            "--source-deg",
            metavar="X",
            help="Angular diameter of the source, as the scene sees it; the sun's 0.53.",
        ),
    ] = SUN_DEG,
    exposure: Annotated[
        float, typer.Option("--exposure-us", "--exposure", metavar="X", help="Of a frame.")
    ] = 10_000.0,
    rate: Annotated[
        float, typer.Option("--frame-rate-hz", metavar="X", help="Of the camera.")
    ] = 30.0,
    feed: Annotated[
        float, typer.Option("--max-feed-mm-s", metavar="X", help="That the stage can do.")
    ] = math.inf,
    radius: Annotated[
        float | None, typer.Option("--radius-mm", metavar="X", help="Instead of the best one.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Radius, feed and frames with which every point is seen in full light and in the umbra.

    A larger circle is not always a better one: some leave points that are never lit.

    --json: {"hole_fraction", "radius_mm", "lit", "unlit", "leak", "penumbra_mm", "feed_mm_s",
    "frame_rate_hz", "frames_a_turn", "turn_s", "blur_mm"}.
    """  # fmt: skip
    from protocol import mesh as geometry

    if min(exposure, rate, feed) <= 0 or (radius is not None and radius <= 0):
        raise UmbraError(Code.BAD_REQUEST, "exposure, frame rate, feed and radius are above 0")
    try:
        sheet = geometry.Mesh(hole, pitch, grid)
        penumbra = penumbra_mm(scene, source_deg=source)
        best = geometry.plan(
            sheet,
            penumbra=penumbra,
            exposure_s=exposure * 1e-6,
            frame_rate_hz=rate,
            max_feed_mm_s=feed,
            radius_mm=radius,
        )
    except ValueError as error:
        raise UmbraError(Code.BAD_REQUEST, str(error)) from None
    found = asdict(best)
    round_ = found.pop("circle")
    found.pop("mesh")
    facts = {"hole_fraction": sheet.hole_fraction, **round_, **found}
    if as_json:
        print_json(facts)
        return
    worst = "of a turn, at the point that has least"
    print_facts(
        [
            ("hole fraction", f"{sheet.hole_fraction:.4f}"),
            ("radius", f"{best.circle.radius_mm:.3g} mm, {best.circle.radius_mm / pitch:.2f} of "
             "the pitch"),
            ("full light", f"{best.circle.lit:.0%} {worst}"),
            ("umbra", f"{best.circle.unlit:.0%} {worst}"),
            ("penumbra", f"{penumbra:.2g} mm wide in the mesh's plane"),
            ("feed", f"{best.feed_mm_s:.3g} mm/s, {best.blur_mm:.2g} mm in an exposure"),
            ("frames", f"{best.frames_a_turn} a turn at {rate:g} Hz"),
            ("one turn", f"{best.turn_s:.3g} s"),
        ]
    )  # fmt: skip


__all__ = ["app"]
