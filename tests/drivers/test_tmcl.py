"""The TMCL driver against a byte-level module."""

from __future__ import annotations

import math
import random
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base.device import Context
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.stage import StageState, StageStatus
from drivers.tmcl import TmclOptions, TmclStage
from drivers.tmcl_protocol import checksum, encode, find_answer
from tests.drivers.moment import once
from tests.drivers.tmcl_peer import TmclPeer

R = 3.0
SEARCH = (13, 0, 0)  # as the peer hears it
TURN = 200 << 8
FEED = 45.0


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[TmclPeer]:
    with TmclPeer(tmp_path) as peer:
        yield peer


def make(peer: TmclPeer, **options: Any) -> TmclStage:
    usual = {"port": str(peer.link), "radius_mm": R, "centre_mm": [10.0, 5.0]}
    return TmclStage("stage", msgspec.convert(usual | options, TmclOptions), Context())


@pytest.fixture
def stage(peer: TmclPeer) -> Iterator[TmclStage]:
    stage = make(peer)
    stage.connect()
    yield stage
    stage.close()


@pytest.fixture
def homed(stage: TmclStage) -> TmclStage:
    stage.home(5.0)
    return stage


def pump_until(stage: TmclStage, done: Callable[[StageStatus], bool]) -> StageStatus:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        status = stage.pump()
        if done(status):
            return status
    raise AssertionError(f"{stage.pump()}")


def at_rest(status: StageStatus) -> bool:
    return status.state is StageState.IDLE


def point(angle: float) -> tuple[float, float]:
    return 10.0 + R * math.cos(angle), 5.0 + R * math.sin(angle)


def test_identifies_itself(stage: TmclStage) -> None:
    identity = stage.connect()
    assert (identity.model, identity.firmware) == ("TMCM-1140", "1.42")
    assert stage.info().travel_mm == ((7.0, 13.0), (2.0, 8.0))
    assert stage.status().state is StageState.UNKNOWN


def test_another_module_is_refused(peer: TmclPeer) -> None:
    with pytest.raises(DeviceRefused, match="1140, not a 1260"):
        make(peer, identity="1260").connect()


def test_nothing_moves_before_homing(peer: TmclPeer, stage: TmclStage) -> None:
    with pytest.raises(DeviceRefused, match="home"):
        stage.circle((10.0, 5.0), R, FEED, 1)
    with pytest.raises(DeviceRefused, match="home"):
        stage.move(13.0, 5.0, FEED)
    assert not {command for command, _, _ in peer.frames} & {1, 2, 4}
    assert stage.position_at(stage.clock.now_ns()) is None


@pytest.mark.parametrize(("homing", "angle"), [("reference", 0.0), ("here", 90.0)])
def test_homing(peer: TmclPeer, homing: str, angle: float) -> None:
    stage = make(peer, homing=homing, home_angle_deg=angle)
    stage.connect()
    stage.home(5.0)
    status = stage.status()
    assert status.state is StageState.IDLE
    assert status.position_mm == pytest.approx(point(math.radians(angle)), abs=1e-6)
    stage.close()


def test_a_reference_that_is_not_found_ends_at_the_deadline(
    peer: TmclPeer, stage: TmclStage
) -> None:
    peer.faults.no_reference = True
    with pytest.raises(DeviceTimeout, match="reference was not found"):
        stage.home(0.3)
    assert (13, 1, 0) in peer.frames
    assert stage.status().state is StageState.UNKNOWN


def test_halt_ends_homing(peer: TmclPeer, stage: TmclStage) -> None:
    peer.faults.no_reference = True
    with once(lambda: SEARCH in peer.frames, stage.halt), pytest.raises(DeviceError, match="halt"):
        stage.home(100.0)
    assert stage.status().state is StageState.UNKNOWN
    assert (13, 1, 0) in peer.frames


def test_moves_the_shorter_way_round(peer: TmclPeer, homed: TmclStage) -> None:
    homed.move(*point(-math.pi / 3), FEED)
    status = pump_until(homed, at_rest)
    assert status.position_mm == pytest.approx(point(-math.pi / 3), abs=1e-3)
    assert peer.position == pytest.approx(-TURN / 6, abs=1)


def test_a_target_off_the_circle_is_refused_with_the_nearest(
    peer: TmclPeer, homed: TmclStage
) -> None:
    sent = len(peer.frames)
    with pytest.raises(DeviceRefused, match=r"1\.000 mm off .* nearest point is \(13\.000, 5\.000"):
        homed.move(14.0, 5.0, FEED)
    with pytest.raises(DeviceRefused):
        homed.move(math.nan, 5.0, FEED)
    for centre, radius, words in [
        ((10.0, 5.0), 2.0, "goes round 3 mm"),
        ((0.0, 0.0), R, "goes round 3 mm"),
        ((math.nan, 5.0), R, "goes round 3 mm"),
        ((10.0, 5.0), math.nan, "radius is nan"),
    ]:
        with pytest.raises(DeviceRefused, match=words):
            homed.circle(centre, radius, FEED, 1)
    with pytest.raises(DeviceRefused, match="feed"):
        homed.circle((10.0, 5.0), R, 51.0, 1)
    with pytest.raises(DeviceRefused, match="turns"):
        homed.circle((10.0, 5.0), R, FEED, -1)
    assert len(peer.frames) == sent


@pytest.mark.parametrize("reverse", [False, True])
def test_circles_begin_at_angle_0_and_are_followed(peer: TmclPeer, reverse: bool) -> None:
    stage = make(peer, reverse=reverse)
    stage.connect()
    stage.home(5.0)
    stage.circle((10.0, 5.0), R, 40.0, 1.25)
    begun_ns = stage.pump().at_ns
    status = pump_until(stage, at_rest)
    positions = [stage.position_at(ns) for ns in range(begun_ns, status.at_ns, 5_000_000)]
    assert status.position_mm == pytest.approx(point(math.pi / 2), abs=1e-3)
    assert peer.position == pytest.approx((-1 if reverse else 1) * 1.25 * TURN, abs=1)
    seen = [p for p in positions if p is not None]
    assert len(seen) > 10
    assert all(math.dist(p, (10.0, 5.0)) == pytest.approx(R, abs=1e-9) for p in seen)
    angles = [math.atan2(y - 5, x - 10) for x, y in seen]
    assert any(a > 2 for a in angles)
    assert any(a < -2 for a in angles)
    stage.close()


def test_endless_turning_and_stop(peer: TmclPeer, homed: TmclStage) -> None:
    homed.circle((10.0, 5.0), R, FEED, math.inf)
    pump_until(homed, lambda s: peer.position > 3000)
    homed.stop()
    status = homed.status()
    assert status.state is StageState.IDLE
    assert status.position_mm == pytest.approx(point(peer.position / TURN * math.tau), abs=1e-3)


def test_the_counters_overflow_does_not_move_the_stage(peer: TmclPeer, homed: TmclStage) -> None:
    homed._raw = homed._position = 2**31 - 1000  # as after some hours
    peer.position = 2**31 - 1000
    before = homed.status().position_mm
    assert before is not None
    homed.circle((10.0, 5.0), R, FEED, math.inf)
    pump_until(homed, lambda s: peer.position > 2**31 + 1000)
    homed.stop()
    after = homed.status().position_mm
    assert after is not None
    assert after == pytest.approx(point(peer.position % TURN / TURN * math.tau), abs=1e-3)
    homed.circle((10.0, 5.0), R, FEED, 0.01)
    pump_until(homed, at_rest)


def test_hold_and_resume(peer: TmclPeer, homed: TmclStage) -> None:
    homed.circle((10.0, 5.0), R, 45.0, 1)
    pump_until(homed, lambda s: peer.position > 1000)
    homed.hold()
    assert homed.status().state is StageState.HELD
    with pytest.raises(DeviceRefused, match="held"):
        homed.move(*point(1.0), FEED)
    homed.resume()
    assert pump_until(homed, at_rest).position_mm == pytest.approx(point(0.0), abs=1e-3)
    assert peer.position == pytest.approx(TURN, abs=1)


def test_a_motor_that_stands_is_not_moving_for_ever(peer: TmclPeer, homed: TmclStage) -> None:
    peer.faults.blocked = True
    homed.move(*point(1.0), FEED)
    with pytest.raises(DeviceRefused, match="stopped short"):
        pump_until(homed, lambda s: False)
    assert homed.status().state is StageState.UNKNOWN


def test_damaged_and_dropped_answers_are_asked_for_again(peer: TmclPeer, homed: TmclStage) -> None:
    rng = random.Random(5)
    for fault in ("drop", "damage"):
        setattr(peer.faults, fault, 2)
        assert homed.status().state is StageState.IDLE
    peer.faults.before = [rng.randbytes(rng.randrange(1, 30)) for _ in range(16)]
    for _ in range(8):
        assert homed.status().position_mm == pytest.approx(point(0.0), abs=1e-6)
    peer.faults.damage = 1000
    with pytest.raises(DeviceGarbled, match="damaged"):
        homed.status()
    assert homed.facts()["damaged_frames"] >= 5


def test_silence_is_a_timeout(peer: TmclPeer, homed: TmclStage) -> None:
    peer.faults.mute = True
    with pytest.raises(DeviceTimeout, match="address 1, 9600 baud"):
        homed.pump()


def test_refusals_have_names(peer: TmclPeer, homed: TmclStage) -> None:
    peer.faults.statuses[5] = 4
    with pytest.raises(DeviceRefused, match="out of its range"):
        homed.move(*point(1.0), FEED)
    peer.faults.statuses[6] = 77
    with pytest.raises(DeviceRefused, match="status 77"):
        homed.status()


def test_pulled_and_connected_again(peer: TmclPeer, homed: TmclStage) -> None:
    homed.circle((10.0, 5.0), R, FEED, math.inf)
    peer.unplug()
    with pytest.raises(DeviceLost):
        pump_until(homed, lambda s: False)
    homed.halt()
    homed.close()
    peer._plug()
    homed.connect()
    assert homed.status().state is StageState.UNKNOWN
    assert homed.position_at(homed.clock.now_ns()) is None
    with pytest.raises(DeviceRefused, match="home"):
        homed.move(13.0, 5.0, FEED)


def test_old_firmware_counts_speed_in_units_of_its_own(peer: TmclPeer) -> None:
    stage = make(peer, velocity_unit="internal")
    stage.connect()
    stage.home(5.0)
    stage.move(*point(1.0), 15.0)
    microsteps = 15.0 / (math.tau * R) * TURN
    assert (5, 4, round(microsteps / (16e6 / (2**5 * 2048 * 32)))) in peer.frames
    stage.close()


def test_a_late_answer_is_not_taken_for_the_next_ones(peer: TmclPeer, homed: TmclStage) -> None:
    homed.move(*point(1.0), FEED)
    pump_until(homed, at_rest)
    for late in ([0.35, 0.2, 0.15], [0.0, 0.35, 0.2, 0.15]):  # position, speed, again
        peer.faults.late = list(late)
        for _ in range(3):
            status = homed.status()
            assert status.state is StageState.IDLE
            assert status.position_mm == pytest.approx(point(1.0), abs=1e-3)


def test_what_a_halt_left_on_the_line_does_not_end_the_next_homing(
    peer: TmclPeer, stage: TmclStage
) -> None:
    peer.faults.no_reference = True
    with once(lambda: SEARCH in peer.frames, stage.halt), pytest.raises(DeviceError, match="halt"):
        stage.home(100.0)
    peer.faults.late = [0.1, 0.1]
    stage.halt()
    with pytest.raises(DeviceTimeout, match="reference was not found"):
        stage.home(0.4)
    assert stage.status().state is StageState.UNKNOWN


def test_another_modules_answer_is_told_from_noise(peer: TmclPeer) -> None:
    peer.address = 7
    with pytest.raises(DeviceGarbled, match="has address 7, not 1"):
        make(peer).connect()


def test_an_unsafe_moment_for_a_lost_answer_does_no_harm(peer: TmclPeer, homed: TmclStage) -> None:
    """The target is absolute: sent twice it is reached once."""
    peer.faults.late = [0.0, 0.45]  # of MAX_SPEED, of MOVE_TO
    homed.move(*point(2.0), FEED)
    assert pump_until(homed, at_rest).position_mm == pytest.approx(point(2.0), abs=1e-3)
    assert peer.position == pytest.approx(2.0 / math.tau * TURN, abs=1)


def work_on(stage: TmclStage, rng: random.Random) -> None:
    while True:
        stage.home(5.0)
        stage.circle((10.0, 5.0), R, FEED, math.inf)
        pump_until(stage, lambda s: rng.random() < 0.05)
        rng.choice([stage.stop, stage.hold, stage.check])()


def test_pulled_at_random_moments(peer: TmclPeer, stage: TmclStage) -> None:
    rng = random.Random(12)
    for _ in range(12):
        timer = threading.Timer(rng.uniform(0.0, 0.25), peer.unplug)
        timer.start()
        with pytest.raises(DeviceLost):
            work_on(stage, rng)
        timer.join()
        assert stage.position_at(stage.clock.now_ns()) is None
        with pytest.raises(DeviceLost):
            stage.connect()
        peer._plug()
        stage.connect()
        assert stage.status().state is StageState.UNKNOWN
        count = len(peer.frames)
        with pytest.raises(DeviceRefused, match="home"):
            stage.circle((10.0, 5.0), R, FEED, 1)
        assert len(peer.frames) == count


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=40), st.integers(-(2**31), 2**31 - 1))
def test_an_answer_is_found_behind_any_noise(noise: bytes, value: int) -> None:
    body = bytes([2, 1, 100, 6]) + value.to_bytes(4, "big", signed=True)
    answer = body + bytes([checksum(body)])
    assert find_answer(noise + answer, 1, 6) == (100, value)
    find_answer(noise, 1, 6)


def test_a_frame_is_as_documented() -> None:
    assert encode(1, 1, 0, 0, 350).hex() == "01010000" + "0000015e" + "61"
    assert encode(1, 4, 0, 0, -1).hex() == "01040000" + "ffffffff" + "01"
