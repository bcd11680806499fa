"""Which circles light and shade every point of a mesh's shadow."""

from __future__ import annotations

import json

import numpy as np
import pytest

from protocol import mesh as geometry
from protocol.cli.app import run
from protocol.mesh import Mesh
from protocol.penumbra import penumbra_mm
from protocol.scans.occluded import SUN_DEG, Grid

SQUARE = Mesh(6.25, 10.0)


@pytest.mark.parametrize(
    ("radius", "lit"),
    [(0.2, False), (0.4, False), (0.65, False), (0.7, True), (0.85, True), (1.0, True),
     (1.1, False), (1.2, False)],
)  # fmt: skip
def test_a_larger_circle_is_not_always_better(radius: float, lit: bool) -> None:
    found = geometry.circle(SQUARE, radius * SQUARE.pitch_mm)
    assert (found.lit > 0) is lit
    assert found.unlit > 0 or radius < 0.3


def test_the_best_circle_serves_its_worst_point_and_is_small() -> None:
    best = geometry.best_circle(SQUARE)
    assert 0.8 <= best.radius_mm / SQUARE.pitch_mm <= 1.0
    assert best.covers
    assert best.leak == 0.0
    for off in (-0.04, 0.04):  # it needn't be met exactly
        assert geometry.circle(SQUARE, best.radius_mm * (1 + off)).covers


@pytest.mark.parametrize("grid", Grid)
def test_the_hole_fraction_is_that_of_the_drawing(grid: Grid) -> None:
    mesh = Mesh(6.0, 10.0, grid)
    width, height = mesh.cell_mm
    x, y = np.meshgrid(np.arange(400) / 400 * width, np.arange(400) / 400 * height)
    assert np.mean(mesh.clearance(x, y) > 0) == pytest.approx(mesh.hole_fraction, abs=0.003)


def test_a_penumbra_costs_time_in_light_and_at_last_everything() -> None:
    sun = penumbra_mm(400.0, source_deg=SUN_DEG)
    assert sun == pytest.approx(0.00925 * 400, rel=0.01)
    sharp, soft = (geometry.circle(SQUARE, 9.0, width) for width in (0.0, 1.0))
    assert soft.lit < sharp.lit
    assert soft.unlit < sharp.unlit
    with pytest.raises(ValueError, match=r"nearer to the scene, take a coarser one.*--source-deg"):
        geometry.best_circle(SQUARE, 7.0)


def test_an_umbra_that_is_never_reached_leaks() -> None:
    assert geometry.circle(SQUARE, 9.0, 1.0).leak == 0.0
    assert 0.0 < geometry.circle(Mesh(8.0, 10.0), 9.0, 7.0).leak < 1.0


def test_a_plan_keeps_to_frame_rate_blur_and_feed() -> None:
    plan = geometry.plan(SQUARE, exposure_s=0.01, frame_rate_hz=30.0)
    assert plan.frames_a_turn * min(plan.circle.lit, plan.circle.unlit) >= 3
    assert plan.blur_mm <= 0.05 * SQUARE.hole_mm + 1e-9
    assert plan.turn_s * plan.feed_mm_s == pytest.approx(2 * np.pi * plan.circle.radius_mm)
    slow = geometry.plan(SQUARE, exposure_s=0.1, frame_rate_hz=30.0)
    assert slow.feed_mm_s < plan.feed_mm_s
    assert geometry.plan(SQUARE, max_feed_mm_s=2.0).feed_mm_s == 2.0


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(ValueError, match="run into each other"):
        Mesh(10.0, 10.0)
    with pytest.raises(ValueError, match="never lit"):
        geometry.plan(SQUARE, radius_mm=4.0)


def test_the_command_line_plans_without_a_rig(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["plan", "mesh", "--hole-mm", "6.25", "--pitch-mm", "10"]
    assert run([*asked, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    best = geometry.best_circle(SQUARE)
    assert told["radius_mm"] == pytest.approx(best.radius_mm)
    assert told["hole_fraction"] == pytest.approx(SQUARE.hole_fraction)
    assert run([*asked, "--scene-mm", "100"]) == 0
    assert "full light" in capsys.readouterr().out
    assert run([*asked, "--radius-mm", "4"]) == 2
    assert "never lit" in capsys.readouterr().err
