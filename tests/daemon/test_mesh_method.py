"""A mesh scan's plan from its spec and the rig: circle, feed, warnings, what is refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from daemon.scans.catalog import method_for
from daemon.scans.mesh import MeshMethod
from daemon.scans.method import Bench, Circle, Sweep, Taken, Unsuitable, Watch
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.stage import StageInfo
from protocol import mesh as geometry
from protocol.patterns import Axis
from protocol.scans.occluded import Mesh, Stick
from protocol.scans.spec import Radiometry, Reference

STAGE = StageInfo(((0.0, 100.0), (0.0, 60.0)), 50.0)
CAMERA = CameraInfo(64, 48, PixelFormat.MONO12)
RIG = Bench(CAMERA, stage=STAGE, lights=("lamp",))
KNOWN = Mesh(hole_mm=6.25, pitch_mm=10.0)


def planned(spec: Mesh, bench: Bench = RIG) -> tuple[MeshMethod, Circle]:
    method = method_for(spec, bench)
    assert isinstance(method, MeshMethod)
    step = method.step(len(spec.references or ()), {})
    assert isinstance(step, Watch)
    assert isinstance(step.motion, Circle)
    assert step.lights == ("lamp",)
    return method, step.motion


def test_the_circle_is_the_best_one_in_the_middle_of_the_travel() -> None:
    method, motion = planned(KNOWN)
    best = geometry.best_circle(geometry.Mesh(6.25, 10.0))
    assert motion.centre_mm == (50.0, 30.0)
    assert motion.radius_mm == best.radius_mm
    assert 0 < motion.feed_mm_s <= STAGE.max_feed_mm_s
    assert method.warnings == ()
    assert method.hole_fraction == pytest.approx(0.3068, abs=1e-4)
    assert method.planned() is None  # coverage decides


def test_a_request_that_does_worse_is_done_with_warnings() -> None:
    method, motion = planned(replace_spec(KNOWN, radius_mm=4.0, feed_mm_s=45.0))
    assert (motion.radius_mm, motion.feed_mm_s) == (4.0, 45.0)
    assert "never in full light; 9 mm leaves none" in method.warnings[0]
    assert "45 mm/s" in method.warnings[1]


def test_an_eccentric_goes_round_its_own_circle() -> None:
    eccentric = StageInfo(((-9, 9), (-9, 9)), 50.0, only_circle_mm=((0.0, 0.0), 9.0))
    method, motion = planned(KNOWN, replace(RIG, stage=eccentric))
    assert (motion.centre_mm, motion.radius_mm) == ((0.0, 0.0), 9.0)
    assert method.warnings == ()
    small = StageInfo(((-4, 4), (-4, 4)), 50.0, only_circle_mm=((0.0, 0.0), 4.0))
    method, _ = planned(KNOWN, replace(RIG, stage=small))
    assert "never in full light" in method.warnings[0]


def test_it_ends_when_covered_or_out_of_time() -> None:
    method, _ = planned(replace_spec(KNOWN, coverage=0.9, time_limit_s=60.0))
    assert method.enough({"coverage": 0.5}, 10.0) == ""
    assert method.enough({"coverage": 0.93}, 10.0).startswith("93.0% of the lit pixels")
    assert method.enough({"coverage": 0.5}, 61.0).startswith("the time limit of 60 s: 50.0% of")
    assert not method.short()


def test_a_circle_that_covers_no_more_ends_after_some_turns_in_use() -> None:
    method, motion = planned(replace_spec(KNOWN, feed_mm_s=40.0))
    turn_s = math.tau * motion.radius_mm / motion.feed_mm_s
    rate, said, used, clouded = 25.0, "", 0.0, 0.0
    for k in range(100_000):
        seconds = k / rate
        if 4.0 < seconds < 4.0 + 10 * turn_s:
            clouded += 1  # nothing can be covered then, and it is no turn
        else:
            used += 1
        coverage = min(0.97, 0.4 * seconds) + 0.0002 * (k % 2)
        summary = {"frames": used, "unused": clouded, "coverage": coverage}
        if said := method.enough(summary, seconds):
            break
    assert "97.0% of the lit pixels are covered, 99.5% wanted: 5 turns covered no more" in said
    assert seconds == pytest.approx(15 * turn_s, rel=0.6)
    assert seconds > 12 * turn_s


def lossy(every: int, spec: Mesh = KNOWN) -> tuple[MeshMethod, str, int]:
    """A scan whose coverage does not grow from .97 on, of which one frame in `every` arrives; why
    it ended, and after how many."""
    method, motion = planned(replace_spec(spec, feed_mm_s=40.0))
    step = method.step(0, {})
    assert step is not None
    turn_s = math.tau * motion.radius_mm / motion.feed_mm_s
    for k in range(100_000):
        pixels = None if k % every else np.zeros((48, 64), np.uint16)
        seen = method.observe(step, Taken(0, k, incomplete=pixels is None, pixels=pixels))
        assert seen.reason == ("lost frame" if k % every else "")
        summary = {"frames": float(k // every + 1), "coverage": 0.97}
        if said := method.enough(summary, k * turn_s / 50):
            return method, said, k // every + 1
    pytest.fail("it went on for ever")


def test_lost_frames_are_named_where_coverage_ends() -> None:
    method, said, _ = lossy(5)
    assert re.search(r"5 turns covered no more, but \d+ of \d+ frames were lost", said)
    assert "lower --frame-rate-hz" in said
    assert "does not reach" not in said
    assert method.short()  # most were lost
    assert not lossy(2)[0].short()
    whole, said, _ = lossy(1)
    assert "lights and shades every point for 20% of a turn at least: what is left" in said
    assert not whole.short()
    short_of = lossy(1, replace_spec(KNOWN, radius_mm=4.0))[1]
    assert "what is left this circle does not reach" in short_of


def test_how_long_the_circle_serves_each_point_is_known_of_recordings_too() -> None:
    told = replace_spec(KNOWN, radius_mm=9.0)
    for bench in (RIG, replace(RIG, camera=replace(CAMERA, recorded=True, frame_count=72))):
        method = method_for(told, bench)
        assert isinstance(method, MeshMethod)
        assert method.least == pytest.approx(0.2, abs=0.01)
    unknown = method_for(Mesh(hole_fraction=0.3, radius_mm=9.0), RIG)
    assert isinstance(unknown, MeshMethod)
    assert unknown.least is None


def test_turns_with_hardly_a_frame_do_not_tell_that_the_circle_reaches_no_more() -> None:
    _, said, frames = lossy(40)
    assert "5 turns covered no more" in said
    assert frames > 100
    method, said, frames = lossy(40, replace_spec(KNOWN, time_limit_s=60.0))
    assert said.startswith("the time limit of 60 s: 97.0% of the lit pixels are covered, 99.5%")
    assert frames < 100
    assert method.short()


def test_the_camera_as_it_is_set_bounds_the_feed() -> None:
    quick, slow = (planned(KNOWN, replace(RIG, exposure_us=us))[1] for us in (2e3, 30e3))
    assert slow.feed_mm_s == pytest.approx(0.05 * 6.25 / 30e-3)
    assert quick.feed_mm_s > slow.feed_mm_s


@pytest.mark.parametrize(
    ("spec", "bench", "said"),
    [
        (KNOWN, replace(RIG, stage=None), "needs a stage"),
        (Mesh(hole_fraction=0.3), RIG, "circle's radius"),
        (Mesh(hole_mm=5.0), RIG, "go together"),
        (Mesh(hole_mm=12.0, pitch_mm=10.0), RIG, "run into each other"),
        (Mesh(hole_fraction=0.3, radius_mm=40.0), RIG, "leaves the stage's travel"),
        (Mesh(hole_mm=6.25, pitch_mm=10.0, scene_mm=900.0), RIG, r"too wide.*--source-deg"),
        (Mesh(hole_mm=6.25, pitch_mm=10.0, lights=("sun",)), RIG, "no light 'sun', but lamp"),
        (
            Mesh(hole_mm=6.25, pitch_mm=10.0, references=(Reference.OPEN,)),
            RIG,
            "cannot take the mesh away",
        ),
        (
            Mesh(hole_mm=6.25, pitch_mm=10.0, references=(Reference.BLACK,)),
            RIG,
            r"only ambient \(the source off\) and open",
        ),
        (
            Mesh(hole_mm=6.25, pitch_mm=10.0, radiometry=Radiometry(leakage=0.1)),
            RIG,
            "leaks into an umbra",
        ),
    ],
)
def test_what_cannot_be_is_refused(spec: Mesh, bench: Bench, said: str) -> None:
    with pytest.raises(Unsuitable, match=said):
        method_for(spec, bench)


def test_a_stick_goes_to_and_fro_along_its_axis() -> None:
    step = method_for(Stick(axis=Axis.Y, sweeps=2, sweep_mm=(10.0, 50.0)), RIG).step(0, {})
    assert isinstance(step, Watch)
    assert step.motion == Sweep(((50.0, 10.0), (50.0, 50.0), (50.0, 10.0)), 4.0)
    with pytest.raises(Unsuitable, match="leaves the stage's travel"):
        method_for(Stick(sweep_mm=(0.0, 200.0)), RIG)


def replace_spec(spec: Mesh, **changes: Any) -> Mesh:
    import msgspec

    changed: Mesh = msgspec.structs.replace(spec, **changes)
    return changed
