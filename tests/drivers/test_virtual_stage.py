"""The virtual stage, its occluder, and the lights that it stands under."""

from __future__ import annotations

import math
import threading
from itertools import pairwise
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.camera import Acquisition
from drivers.base.device import Context
from drivers.base.errors import DeviceRefused, DeviceTimeout, OutOfRange
from drivers.base.stage import StageState
from drivers.clock import NS, ScaledClock
from drivers.registry import build
from drivers.virtual.camera import VirtualCamera
from drivers.virtual.light import PIXELS, VirtualLight
from drivers.virtual.motion import Circle, Line, Motion
from drivers.virtual.occluder import Occluder, OccluderKind, Shade
from drivers.virtual.sky import Clouds
from drivers.virtual.stage import VirtualStage
from drivers.virtual.view import view
from tests.jumping import Jumping


def context() -> Context:
    return Context(clock=Jumping())


def make(here: Context, device_kind: str, name: str, /, **options: Any) -> Any:
    device = build(device_kind, "virtual", name, options, here)
    device.connect()
    return device


def homed(here: Context, **options: Any) -> VirtualStage:
    stage = cast(VirtualStage, make(here, "stage", "stage", **options))
    stage.home(60)
    return stage


def picture(camera: VirtualCamera) -> NDArray[np.float32]:
    info = camera.info()
    out = np.zeros(info.shape, info.pixel_format.dtype)
    camera.trigger()
    camera.grab(out, 5)
    return out.astype(np.float32) - np.float32(info.black_level)


def small_camera(here: Context, **options: Any) -> VirtualCamera:
    chosen = {"width": 160, "height": 120, "pixel_format": "RGB16", "noise": False, "ambient": 0.0}
    camera = cast(VirtualCamera, make(here, "camera", "camera", **(chosen | options)))
    camera.start(Acquisition.SOFTWARE)
    return camera


# ---------------------------------------------------------------- motion


def test_a_motion_is_a_trapezoid_of_speed() -> None:
    motion = Motion(Line((0, 0), (100, 0)), 0, 0, 100, 50, 200)
    assert motion.duration_s == pytest.approx(100 / 50 + 50 / 200)
    times = np.arange(0, motion.end_ns, NS // 1000)
    x = np.array([motion.at(int(t))[0] for t in times])
    speed = np.gradient(x, 1e-3)
    assert speed.max() == pytest.approx(50, rel=1e-3)
    assert np.abs(np.gradient(speed, 1e-3)).max() <= 200 * 1.001
    assert motion.at(motion.end_ns) == (100, 0)


def test_a_short_motion_is_a_triangle() -> None:
    motion = Motion(Line((0, 0), (1, 0)), 0, 0, 1, 50, 200)
    assert motion.duration_s == pytest.approx(2 * math.sqrt(1 / 200))
    assert motion.at(motion.end_ns // 2)[0] == pytest.approx(0.5, abs=1e-6)


def test_a_circle_stays_on_its_radius_and_within_its_acceleration() -> None:
    here = context()
    stage = homed(here)
    stage.move(52, 50, 200)
    stage.circle((50, 50), 2, 200, 3)
    end = stage._latest.end_ns
    start = stage._latest.start_ns
    times = np.arange(start, end, NS // 2000)
    way = np.array([stage.position_at(int(t)) for t in times])
    np.testing.assert_allclose(np.hypot(*(way - 50).T), 2, atol=1e-6)
    speed = np.hypot(*np.gradient(way, 5e-4, axis=0).T)
    assert speed.max() ** 2 / 2 <= stage.info().max_acceleration_mm_s2 * 1.001
    turned = np.unwrap(np.arctan2(*(way - 50).T[::-1]))
    assert turned[-1] - turned[0] == pytest.approx(6 * math.pi, abs=0.01)
    assert Circle((0, 0), 2, 3).length == pytest.approx(12 * math.pi)


def test_position_is_unknown_until_it_is_homed_and_after_a_reconnect() -> None:
    here = context()
    stage = cast(VirtualStage, make(here, "stage", "stage"))
    assert stage.status().state is StageState.UNKNOWN
    assert stage.position_at(here.clock.now_ns()) is None
    with pytest.raises(DeviceRefused, match="stage: move: its position is not known; home it"):
        stage.move(1, 1, 10)
    stage.home(60)
    status = stage.status()
    assert (status.state, status.position_mm) == (StageState.IDLE, (0, 0))
    stage.connect()
    assert stage.status().position_mm is None


def test_moves_are_accepted_at_once_and_seen_on_their_way() -> None:
    here = context()
    stage = homed(here)
    before = here.clock.now_ns()
    stage.move(100, 0, 50)
    stage.move(100, 80, 50)
    assert here.clock.now_ns() == before
    assert stage.pump().state is StageState.MOVING
    here.clock.wait(1)
    position = stage.status().position_mm
    assert position is not None
    assert 0 < position[0] < 100
    assert position[1] == 0
    here.clock.wait(5)
    assert stage.status().state is StageState.IDLE
    assert stage.status().position_mm == (100, 80)


def test_hold_slows_down_and_resume_goes_on_to_the_end() -> None:
    here = context()
    stage = homed(here)
    stage.move(100, 0, 50)
    stage.move(100, 80, 50)
    here.clock.wait(1)
    at = stage.status().position_mm
    stage.hold()
    stage.hold()
    here.clock.wait(3)
    held = stage.status()
    assert held.state is StageState.HELD
    assert at is not None
    assert held.position_mm is not None
    assert held.position_mm[0] - at[0] == pytest.approx(50**2 / 2 / 1000)
    with pytest.raises(DeviceRefused, match="held; resume"):
        stage.move(0, 0, 10)
    stage.resume()
    here.clock.wait(10)
    assert stage.status().state is StageState.IDLE
    assert stage.status().position_mm == pytest.approx((100, 80))


def test_halt_stops_and_forgets_the_rest() -> None:
    here = context()
    stage = homed(here)
    stage.move(400, 0, 100)
    here.clock.wait(1)
    stage.halt()
    here.clock.wait(1)
    status = stage.status()
    assert status.state is StageState.IDLE
    assert status.position_mm is not None
    assert 80 < status.position_mm[0] < 110
    stage.move(0, 0, 100)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda s: s.move(501, 0, 10), "x from 501 to 501 mm is past the soft limit"),
        (lambda s: s.circle((3, 50), 5, 10, 1), "x from -2 to 8"),
        (lambda s: s.move(1, 1, 500), "up to 200 mm/s"),
        (lambda s: s.circle((50, 50), 0, 10, 1), "above 0"),
    ],
)
def test_limits_are_checked_before_anything_moves(call: Any, says: str) -> None:
    stage = homed(context())
    with pytest.raises(OutOfRange, match=says):
        call(stage)
    assert stage.status().position_mm == (0, 0)


def test_homing_that_is_halted_leaves_the_position_unknown() -> None:
    stage = cast(VirtualStage, make(Context(clock=ScaledClock(0.01)), "stage", "stage"))
    raised: list[BaseException] = []

    def work() -> None:
        try:
            stage.home(60)
        except DeviceTimeout as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    while thread.is_alive():
        stage.halt()
        thread.join(0.01)
    assert "halted; home it again" in str(raised[0])
    assert stage.status().state is StageState.UNKNOWN


def test_a_missing_switch_is_an_alarm() -> None:
    stage = cast(VirtualStage, make(context(), "stage", "stage", faults=["no-switch@1"]))
    with pytest.raises(DeviceRefused, match="limit switch X"):
        stage.home(60)
    assert stage.status().state is StageState.ALARM
    stage.unlock()
    assert stage.status().state is StageState.UNKNOWN
    stage.home(60)
    stage.move(500, 300, 200)
    stage.clock.wait(10)
    with pytest.raises(DeviceTimeout, match=r"within 0\.1 s"):
        stage.home(0.1)


# ---------------------------------------------------------------- shade


@pytest.mark.parametrize("kind", [OccluderKind.SQUARE, OccluderKind.HEX])
@pytest.mark.parametrize("penumbra", [0.0, 2.0])
def test_a_mesh_lets_its_hole_fraction_through(kind: OccluderKind, penumbra: float) -> None:
    mesh = Occluder(kind, hole_mm=6, pitch_mm=10)
    shade = Shade(mesh, ((0.0, 0.0), (3.3, 1.2)), 0.5, penumbra).draw((800, 800))
    assert shade.mean() == pytest.approx(mesh.hole_fraction, rel=0.02)
    assert shade.min() >= 0
    assert shade.max() <= 1 + 1e-6


def test_a_shade_moves_with_its_occluder() -> None:
    mesh = Occluder(OccluderKind.HEX)
    rest = Shade(mesh, ((0.0, 0.0),), 0.5, 1.0).draw((200, 160))
    moved = Shade(mesh, ((4.0, -3.0),), 0.5, 1.0).draw((200, 160))
    np.testing.assert_allclose(moved[20:100, 20:100], rest[26:106, 12:92], atol=1e-4)


def test_exposures_see_the_occluder_where_it_was() -> None:
    """A stick that moves during the exposure leaves the mean of its shadows."""
    here = context()
    stage = homed(here, occluder="stick", stick_mm=30.0)
    lamp = cast(VirtualLight, make(here, "light", "left"))
    camera = small_camera(here)
    lamp.set(True)
    stage.move(200, 150, 100)
    here.clock.wait(10)
    still = picture(camera)
    stage.move(300, 150, 100)
    here.clock.wait(0.3)
    moving = picture(camera)
    here.clock.wait(10)
    stage.move(200, 150, 100)
    here.clock.wait(10)
    np.testing.assert_array_equal(picture(camera), still)
    assert np.abs(moving - still).max() > 5000


@pytest.mark.parametrize("kind", ["lamp", "sun"])
def test_a_small_circle_of_the_mesh_covers_and_separates_the_scene(kind: str) -> None:
    here = context()
    stage = homed(here)
    lamp = cast(VirtualLight, make(here, "light", "left", kind=kind, drift_deg_per_hour=0.0))
    camera = small_camera(here, exposure_us=4000.0)
    lamp.set(True)
    radius = 0.85 * 10
    stage.move(250 + radius, 150, 200)
    here.clock.wait(10)
    stage.circle((250, 150), radius, 40, 1)
    frames = []
    while stage.status().state is StageState.MOVING:
        here.clock.wait(0.03)
        frames.append(picture(camera))
    assert 30 < len(frames) < 50
    most, least = np.maximum.reduce(frames), np.minimum.reduce(frames)
    truth = camera.truth(("left",))
    smooth = view(160, 120).smooth
    scale = camera.info().pixel_format.full_scale * 4000 / (1e6 / 60)
    beta = stage.facts()["hole_fraction"]
    for got, want in ((most - least, truth["direct"]), (least / beta, truth["global"])):
        error = ((got - want) / scale)[smooth]
        assert np.median(np.abs(error)) < 0.02
        assert np.sqrt((error**2).mean()) < 0.06


def test_an_occluder_may_stand_under_one_light_only() -> None:
    here = context()
    homed(here, light="left")
    left = cast(VirtualLight, make(here, "light", "left"))
    right = cast(VirtualLight, make(here, "light", "right"))
    now = here.clock.now_ns()
    assert left._shade(now, now + 1, 0) is not None
    assert right._shade(now, now + 1, 0) is None
    assert right._draw(None).shape == PIXELS[::-1]


# ---------------------------------------------------------------- lights


def test_a_lamp_shines_from_the_moment_it_is_switched() -> None:
    here = context()
    lamp = cast(VirtualLight, make(here, "light", "right"))
    camera = small_camera(here)
    assert picture(camera).max() == 0
    lamp.set(True)
    assert lamp.is_on()
    full = picture(camera)
    start, end = camera.trigger()
    here.clock.wait_until((3 * start + end) // 4)
    lamp.safe()
    out = np.zeros(camera.info().shape, np.uint16)
    camera.grab(out, 5)
    part = (out - camera.info().black_level).mean() / full.mean()
    assert part == pytest.approx(0.25, abs=0.01)
    assert not lamp.is_on()


def test_the_sun_cannot_be_switched_off_but_drifts() -> None:
    here = context()
    sun = cast(VirtualLight, make(here, "light", "sun", kind="sun", drift_deg_per_hour=15.0))
    homed(here)
    camera = small_camera(here)
    assert sun.is_on()
    with pytest.raises(DeviceRefused, match=r"sun: set: .*; shade the scene"):
        sun.set(False)
    sun.safe()
    first = picture(camera)
    here.clock.wait(60)
    assert np.abs(picture(camera) - first).max() > 3000
    shade = sun._shade(here.clock.now_ns(), here.clock.now_ns() + 1, 3600.0)
    assert shade is not None
    base = sun._shade(here.clock.now_ns(), here.clock.now_ns() + 1, 0.0)
    assert base is not None
    assert shade.places[0][0] - base.places[0][0] == pytest.approx(
        400 * math.tan(math.radians(15)), abs=1e-3
    )


def test_clouds_follow_their_schedule_and_their_seed() -> None:
    assert Clouds(((0.0, 1.0), (10.0, 0.5))).strength(5) == pytest.approx(0.75)
    random = [Clouds(depth=0.6, seed=4).strength(t) for t in range(300)]
    assert random == [Clouds(depth=0.6, seed=4).strength(t) for t in range(300)]
    assert random != [Clouds(depth=0.6, seed=5).strength(t) for t in range(300)]
    assert 0.4 <= min(random) < 0.6
    assert 0.8 < max(random) <= 1
    assert max(abs(a - b) for a, b in pairwise(random)) < 0.1


def test_clouds_dim_the_picture() -> None:
    here = context()
    lamp = cast(
        VirtualLight,
        make(here, "light", "sun", kind="sun", clouds=[[0, 1.0], [100, 1.0], [101, 0.5]]),
    )
    camera = small_camera(here)
    bright = picture(camera)
    here.clock.wait(200)
    assert picture(camera).mean() == pytest.approx(0.5 * bright.mean(), rel=0.01)
    assert lamp.facts()["source"] == "sun"
