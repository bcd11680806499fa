"""The Grbl driver against a byte-level controller: what goes right, and what goes wrong."""

from __future__ import annotations

import math
import random
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base.device import Context
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.stage import StageState, StageStatus
from drivers.clock import NS, Clock, RealClock, ScaledClock
from drivers.grbl import GrblOptions, GrblStage, faults
from drivers.grbl import protocol as grbl
from tests.drivers.grbl_peer import GrblPeer, Settings
from tests.drivers.moment import once

FEED = 40.0  # mm/s
CENTRE = (-10.0, -10.0)


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[GrblPeer]:
    with GrblPeer(tmp_path, speed=2.0, resets_on_open=False) as peer:
        yield peer


def make(peer: GrblPeer, clock: Clock | None = None, **options: object) -> GrblStage:
    usual: dict[str, object] = {"port": str(peer.link), "boot_s": 1.0, "poll_hz": 20.0}
    return GrblStage(
        "stage",
        msgspec.convert(usual | options, GrblOptions),
        Context(clock=clock or ScaledClock(peer.speed)),
    )


@pytest.fixture
def stage(peer: GrblPeer) -> Iterator[GrblStage]:
    stage = make(peer)
    stage.connect()
    yield stage
    stage.close()


@pytest.fixture
def homed(stage: GrblStage) -> GrblStage:
    stage.home(10.0)
    return stage


def pump_until(
    stage: GrblStage, done: Callable[[StageStatus], bool], seconds: float = 60.0
) -> StageStatus:
    """Pump as the daemon does; the time is a limit, not a criterion."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        status = stage.pump()
        if done(status):
            return status
        time.sleep(0.005)
    raise AssertionError(f"not within {seconds} s: {stage.pump()}")


def at_rest(status: StageStatus) -> bool:
    return status.state is StageState.IDLE


def moving(status: StageStatus) -> bool:
    return status.state is StageState.MOVING and status.position_mm is not None


# ---------------------------------------------------------------- connecting


@pytest.mark.parametrize("resets", [True, False])
def test_connects_to_boards_that_reset_on_opening_and_to_those_that_do_not(
    tmp_path: Path, resets: bool
) -> None:
    made = Settings(label="BENCH-1")  # as Grbl keeps `$I=bench-1`
    with GrblPeer(tmp_path, resets_on_open=resets, boot_s=0.2, settings=made) as peer:
        stage = make(peer, identity="bench", boot_s=60.0 if resets else 0.5)
        identity = stage.connect()
        assert (identity.model, identity.serial) == ("Grbl", "BENCH-1")
        assert identity.firmware == "1.1h.20190830"
        info = stage.info()
        assert info.travel_mm == ((-40.0, 0.0), (-40.0, 0.0))
        assert info.max_feed_mm_s == 50.0
        assert info.max_acceleration_mm_s2 == 500.0
        assert stage.status().state is StageState.UNKNOWN
        assert (b"\x18" in peer.realtime) is not resets
        stage.close()
        stage.close()


FLUID_VERSION = "3.9 FluidNC v3.9.1 (esp32-wifi)"
HAL = Settings(banner="GrblHAL 1.1f ['$' or '$HELP' for help]", dialect="grblHAL", label="B")
DISGUISED = Settings(dialect="grblHAL")  # built for compatibility, its banner says Grbl
FLUID = Settings(
    banner="Grbl 3.9 [FluidNC v3.9.1 (esp32-wifi) '$' for help]",
    dialect="FluidNC",
    chatter=[
        b"ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\n",
        b"\xff\xfb\x01[MSG:INFO: FluidNC v3.9.1 https://github.com/bdring/FluidNC]\r\n",
        b"\x1b[0;32m[MSG:INFO: Machine: umbra]\x1b[0m\r\n[MSG:WARN: No SD]\r\n",
    ],
)


@pytest.mark.parametrize(
    ("made", "name", "version", "rx"),
    [
        (HAL, "grblHAL", "1.1f.20260817", 255),
        (DISGUISED, "grblHAL", "1.1f.20260817", 255),
        (FLUID, "FluidNC", "3.9 FluidNC v3.9.1 (esp32-wifi)", 127),
        (
            replace(FLUID, banner="Grbl 3.9 [mine]"),
            "FluidNC",
            "3.9 FluidNC v3.9.1 (esp32-wifi)",
            127,
        ),
    ],
)
def test_grblhal_and_fluidnc_are_worked_with(
    tmp_path: Path, made: Settings, name: str, version: str, rx: int
) -> None:
    with GrblPeer(
        tmp_path, resets_on_open=False, settings=replace(made), speed=2, rx_bytes=1024
    ) as peer:
        stage = make(peer)
        identity = stage.connect()
        assert (identity.model, identity.firmware) == (name, version)
        assert stage.info().travel_mm == ((-40.0, 0.0), (-40.0, 0.0))
        assert (stage.info().max_feed_mm_s, stage.info().max_acceleration_mm_s2) == (50.0, 500.0)
        facts = stage.facts()
        assert (facts["homing"], facts["soft_limits"], facts["rx_bytes"]) == (True, True, rx)
        peer.faults.homing_s = 0.6  # in which it reports Home
        stage.home(10.0)
        assert stage.status().state is StageState.IDLE
        stage.circle(CENTRE, 1.5, 25.0, math.inf)
        pump_until(stage, lambda s: len(peer.path) > 100)
        stage.stop()
        assert stage.status().state is StageState.IDLE
        assert peer.most_buffered <= rx
        stage.close()


def test_a_fluidnc_axis_that_is_not_told_is_asked_for_by_name(tmp_path: Path) -> None:
    made = replace(FLUID, homing=False, soft_limits=False)
    with GrblPeer(tmp_path, resets_on_open=False, settings=made) as peer:
        stage = make(peer, homing="here", travel_mm=[[-5, 5], [-5, 5]])
        stage.connect()
        assert stage.info().max_feed_mm_s == 50.0
        assert not stage.facts()["homing"]
        stage.home(5.0)
        assert stage.status().position_mm == (0.0, 0.0)
        stage.close()


def test_numbers_mean_what_each_firmware_means_by_them() -> None:
    assert "dual-motor" in faults.alarm(10)[0]
    assert "emergency stop" in faults.alarm(10, "grblHAL")[0]
    assert "spindle" in faults.alarm(10, "FluidNC")[0]
    for code in range(10, 23):
        assert "in alarm" not in faults.alarm(code, "grblHAL")[0]
    for code in range(10, 19):
        assert "in alarm" not in faults.alarm(code, "FluidNC")[0]
    for firmware in ("grblHAL", "FluidNC"):
        assert faults.alarm(9, firmware) == faults.alarm(9)
        assert faults.refusal(9, firmware) == faults.refusal(9)
        assert faults.refusal(200, firmware)[0] == "it refused (error:200)"
    assert "emergency stop" in faults.refusal(50, "grblHAL")[0]
    assert "another interface" in faults.refusal(120, "FluidNC")[0]
    assert faults.is_critical(10, "grblHAL")
    assert not faults.is_critical(10, "Grbl")
    assert not faults.is_critical(None, "FluidNC")


@pytest.mark.parametrize(
    ("made", "options", "words"),
    [
        (Settings(banner="Grbl 0.9j ['$' for help]"), {}, "install Grbl 1.1"),
        (Settings(label="other"), {"identity": "bench"}, "not 'bench'"),
        (Settings(), {"homing": "here"}, "travel_mm"),
        (Settings(), {"travel_mm": [[5, 5], [0, 1]]}, "empty"),
    ],
)
def test_refuses_what_it_cannot_work_with(
    tmp_path: Path, made: Settings, options: dict[str, Any], words: str
) -> None:
    with GrblPeer(tmp_path, resets_on_open=False, settings=made) as peer:
        stage = make(peer, **options)
        with pytest.raises(DeviceRefused, match=words):
            stage.connect()
        with pytest.raises(DeviceLost, match="not connected"):
            stage.status()


def test_nothing_answers(tmp_path: Path) -> None:
    with GrblPeer(tmp_path, resets_on_open=False) as peer:
        peer.faults.mute = True
        with pytest.raises(DeviceTimeout, match=r"no answer .* 115200 baud"):
            make(peer, ScaledClock(10)).connect()


def test_something_else_answers(tmp_path: Path) -> None:
    made = Settings(banner="Marlin 2.1 ready")
    with (
        GrblPeer(tmp_path, boot_s=0.0, settings=made) as peer,
        pytest.raises(DeviceGarbled, match="Marlin"),
    ):
        make(peer, ScaledClock(5)).connect()


def test_there_is_no_port(tmp_path: Path) -> None:
    stage = GrblStage("stage", GrblOptions(port=str(tmp_path / "none")), Context())
    with pytest.raises(DeviceLost, match="there is no"):
        stage.connect()
    stage.halt()
    stage.safe()
    stage.close()


def test_a_second_opener_is_refused(peer: GrblPeer, stage: GrblStage) -> None:
    with pytest.raises(DeviceRefused, match="in use by another program"):
        make(peer).connect()
    assert stage.status().state is StageState.UNKNOWN


# ---------------------------------------------------------------- homing and limits


def test_nothing_moves_before_homing(peer: GrblPeer, stage: GrblStage) -> None:
    sent = list(peer.lines)
    motions: tuple[Callable[[], None], ...] = (
        lambda: stage.move(-5, -5, FEED),
        lambda: stage.circle(CENTRE, 1.5, FEED, 1),
        lambda: stage.jog(-5, -5, FEED),
    )
    for motion in motions:
        with pytest.raises(DeviceRefused, match="home"):
            motion()
    assert stage.position_at(stage.clock.now_ns()) is None
    assert peer.lines == sent
    stage.unlock()
    assert stage.status().state is StageState.UNKNOWN
    with pytest.raises(DeviceRefused, match="home"):
        stage.move(-5, -5, FEED)


def test_homing_gives_a_position(homed: GrblStage) -> None:
    status = homed.status()
    assert (status.state, status.position_mm) == (StageState.IDLE, (-1.0, -1.0))
    assert homed.position_at(homed.clock.now_ns()) == (-1.0, -1.0)


def test_a_missing_switch_is_named_with_its_remedy(peer: GrblPeer, stage: GrblStage) -> None:
    peer.faults.switch_missing = True
    with pytest.raises(DeviceRefused, match=r"switch was not found while homing .*ALARM:9.*wiring"):
        stage.home(10.0)
    status = stage.status()
    assert status.state is StageState.ALARM
    assert "umbra stage home" in status.detail
    stage.check()  # an alarm is no fault: connecting again would forget it
    assert stage.status().state is StageState.ALARM
    peer.faults.switch_missing = False
    stage.home(10.0)
    assert stage.status().state is StageState.IDLE
    stage.check()


def test_homing_has_a_deadline_of_its_own(peer: GrblPeer, stage: GrblStage) -> None:
    peer.faults.homing_s = 60.0
    with pytest.raises(DeviceTimeout, match=r"did not end within 0\.5 s"):
        stage.home(0.5)
    assert stage.status().state is StageState.ALARM
    peer.faults.homing_s = 0.1
    stage.home(10.0)


def test_halt_ends_homing(peer: GrblPeer, stage: GrblStage) -> None:
    peer.faults.homing_s = 60.0
    with (
        once(lambda: peer.state == "Home", stage.halt),
        pytest.raises(DeviceError, match="halt"),
    ):
        stage.home(120.0)
    assert stage.status().state is not StageState.HOMING
    assert peer.state != "Home"
    peer.faults.homing_s = 0.1
    stage.home(10.0)


def test_homing_switched_off_says_what_to_do(tmp_path: Path) -> None:
    made = Settings(homing=False)
    with GrblPeer(tmp_path, resets_on_open=False, settings=made) as peer:
        stage = make(peer)
        stage.connect()
        with pytest.raises(DeviceRefused, match=r"\$22=1"):
            stage.home(5.0)
        stage.close()


def test_homing_here_makes_the_present_place_the_origin(tmp_path: Path) -> None:
    made = Settings(homing=False, soft_limits=False, work_positions=True, inches=True)
    with GrblPeer(tmp_path, resets_on_open=False, settings=made, speed=2) as peer:
        peer.x, peer.y = 7.0, -2.0
        stage = make(peer, homing="here", travel_mm=[[-5, 5], [-5, 5]])
        stage.connect()
        stage.home(5.0)
        assert stage.status().position_mm == pytest.approx((0.0, 0.0), abs=0.005)
        stage.move(3.0, 1.0, FEED)
        pump_until(stage, at_rest)
        assert (peer.x, peer.y) == pytest.approx((10.0, -1.0), abs=0.005)
        with pytest.raises(DeviceRefused, match=r"x = 5\.1 mm"):
            stage.move(5.1, 0.0, FEED)
        stage.close()


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (lambda s: s.move(0.5, -5, FEED), "x = 0.5 mm is outside -40 to 0 mm"),
        (lambda s: s.move(-5, -41, FEED), "y = -41 mm"),
        (lambda s: s.move(math.nan, -5, FEED), "x = nan"),
        (lambda s: s.move(-5, -math.inf, FEED), "y = -inf"),
        (lambda s: s.circle((-1.0, -10.0), 1.5, FEED, 0.1), "x = 0.5 mm"),
        (lambda s: s.circle((-10.0, -39.0), 1.5, FEED, 1), "y = -40.5 mm"),
        (lambda s: s.circle(CENTRE, -1.0, FEED, 1), "radius"),
        (lambda s: s.circle(CENTRE, math.nan, FEED, 1), "radius"),
        (lambda s: s.circle(CENTRE, 1.0, FEED, 0), "turns"),
        (lambda s: s.circle(CENTRE, 1.0, FEED, math.nan), "turns"),
        (lambda s: s.move(-5, -5, 0.0), "feed"),
        (lambda s: s.move(-5, -5, 51.0), "takes up to 50 mm/s"),
        (lambda s: s.jog(1, 1, 10.0), "x = 1 mm"),
    ],
)
def test_limits_are_checked_before_anything_is_sent(
    peer: GrblPeer, homed: GrblStage, motion: Callable[[GrblStage], None], words: str
) -> None:
    sent = list(peer.lines)
    with pytest.raises(DeviceRefused, match=words):
        motion(homed)
    assert peer.lines == sent


# ---------------------------------------------------------------- motion


def test_move_goes_there_and_says_when(peer: GrblPeer, homed: GrblStage) -> None:
    homed.move(-12.5, -7.25, FEED)
    assert homed.status().state is StageState.MOVING
    status = pump_until(homed, at_rest)
    assert status.position_mm == pytest.approx((-12.5, -7.25), abs=0.002)
    assert (peer.x, peer.y) == pytest.approx((-12.5, -7.25), abs=1e-3)


def test_status_alone_sees_the_end_of_a_move(homed: GrblStage) -> None:
    homed.move(-5.0, -5.0, FEED)
    end = time.monotonic() + 60
    while (status := homed.status()).state is StageState.MOVING and time.monotonic() < end:
        time.sleep(0.01)
    assert status.state is StageState.IDLE
    assert status.position_mm == pytest.approx((-5.0, -5.0), abs=0.002)


def test_circles_keep_the_planner_full_and_never_overflow(tmp_path: Path) -> None:
    made = Settings(work_positions=True)  # and so an offset that arcs must not depend on
    with GrblPeer(tmp_path, resets_on_open=False, speed=4, settings=made) as peer:
        stage = make(peer)
        stage.connect()
        stage.home(10.0)
        stage.circle(CENTRE, 1.5, 25.0, 8.25)
        pump_until(stage, at_rest)
        assert peer.overflowed == 0
        assert peer.starved == 0
        assert 64 < peer.most_buffered <= 127
        assert (peer.x, peer.y) == pytest.approx((-10.0, -8.5), abs=0.01)
        arcs = [line for line in peer.lines if "G3" in line]
        assert len(arcs) == 9
        radii = [math.dist((x, y), CENTRE) for _, x, y in peer.path]
        round_it = radii[next(k for k, r in enumerate(radii) if r < 1.51) :]
        assert min(round_it) > 1.49
        assert max(round_it) < 1.51
        stage.close()


def test_position_at_follows_the_circle_and_not_its_chords(tmp_path: Path) -> None:
    with GrblPeer(tmp_path, resets_on_open=False, speed=2) as peer:
        clock = ScaledClock(2)
        real = time.monotonic_ns()
        skew = clock.now_ns() - 2 * real  # the clock at a moment of the peer's own
        stage = make(peer, clock, poll_hz=10.0)
        stage.connect()
        stage.home(10.0)
        stage.circle(CENTRE, 1.5, 25.0, math.inf)
        followed: list[tuple[float, float]] = []  # how far off, and how far from the centre

        def enough(_: StageStatus) -> bool:
            if len(peer.path) < 800:
                return False
            for seconds, x, y in peer.path[300:-100:7]:
                at = stage.position_at(round(seconds * NS) * 2 + skew)
                if at is not None:  # the machine stood still for longer than it is followed
                    followed.append((math.dist(at, (x, y)), math.dist(at, CENTRE)))
            del peer.path[:]
            return len(followed) > 50

        pump_until(stage, enough)
        stage.stop()
        stage.close()
        assert all(abs(r - 1.5) < 1e-6 for _, r in followed)  # a chord would be down to .9 mm
        # A wrong time is wrong in all of them; what a busy machine's late threads add, at 25 mm/s,
        # is not.
        assert statistics.quantiles((error for error, _ in followed), n=10)[0] < 0.5


def test_moves_queue_up_behind_each_other(peer: GrblPeer, homed: GrblStage) -> None:
    homed.move(-5.0, -5.0, FEED)
    homed.move(-5.0, -8.0, FEED)
    homed.circle((-10.0, -8.0), 2.0, FEED, 1)
    pump_until(homed, at_rest)
    assert (peer.x, peer.y) == pytest.approx((-8.0, -8.0), abs=0.002)


def test_hold_and_resume(peer: GrblPeer, homed: GrblStage) -> None:
    homed.circle(CENTRE, 1.5, 25.0, 4)
    pump_until(homed, moving)
    homed.hold()
    assert peer.state == "Hold"
    held = homed.status()
    assert held.state is StageState.HELD
    assert held.position_mm is not None
    assert math.dist(held.position_mm, (peer.x, peer.y)) < 0.002
    assert homed.position_at(homed.clock.now_ns()) == held.position_mm
    homed.hold()
    with pytest.raises(DeviceRefused, match="held"):
        homed.move(-5.0, -5.0, FEED)
    homed.resume()
    pump_until(homed, at_rest)
    assert (peer.x, peer.y) == pytest.approx((-8.5, -10.0), abs=0.002)


def test_stop_ends_an_endless_circle_and_keeps_the_position(
    peer: GrblPeer, homed: GrblStage
) -> None:
    homed.circle(CENTRE, 1.5, 25.0, math.inf)
    pump_until(homed, lambda s: len(peer.path) > 200)
    homed.stop()
    status = homed.status()
    assert status.state is StageState.IDLE
    assert status.position_mm == pytest.approx((peer.x, peer.y), abs=0.002)
    count = len([line for line in peer.lines if "G3" in line])
    homed.move(-5.0, -5.0, FEED)  # and the modes are right after the reset
    pump_until(homed, at_rest)
    assert (peer.x, peer.y) == pytest.approx((-5.0, -5.0), abs=0.002)
    assert len([line for line in peer.lines if "G3" in line]) == count
    homed.stop()
    homed.stop()


def test_jog_is_cancelled_by_stop_and_by_hold(peer: GrblPeer, homed: GrblStage) -> None:
    for end in (homed.stop, homed.hold):
        homed.jog(-35.0 if end == homed.stop else -5.0, -20.0, 10.0)
        pump_until(homed, moving)
        end()
        assert peer.state == "Idle"
        assert homed.status().state is StageState.IDLE
        assert homed.status().position_mm == pytest.approx((peer.x, peer.y), abs=0.002)


def test_homing_ends_a_jog_that_takes_long_to_stand(peer: GrblPeer, homed: GrblStage) -> None:
    """A jog cancel at that moment leaves Grbl idle and deaf: `$H` was never answered."""
    peer.settings.acceleration = 50.0
    homed.jog(-35.0, -20.0, 20.0)
    pump_until(homed, lambda s: s.position_mm is not None and s.position_mm[0] < -6.0)
    homed.home(5.0)
    assert homed.status().position_mm == pytest.approx((-1.0, -1.0))


def test_a_homing_that_was_not_heard_is_no_wait(peer: GrblPeer, stage: GrblStage) -> None:
    """Its line was lost by the line's end: the controller stands, and says so."""
    stage.unlock()
    peer.faults.deaf_to = "$H"
    with pytest.raises(DeviceGarbled, match=r"lost on the line.*check cable"):
        stage.home(60.0)
    peer.faults.deaf_to = ""
    stage.home(5.0)
    assert stage.status().state is StageState.IDLE


def test_unlocking_what_is_not_locked_disturbs_nothing(peer: GrblPeer, homed: GrblStage) -> None:
    homed.move(-20.0, -20.0, FEED)
    homed.unlock()
    pump_until(homed, at_rest)
    assert homed.status().position_mm == pytest.approx((-20.0, -20.0), abs=0.002)


def test_halt_from_another_thread_holds_at_once(peer: GrblPeer, homed: GrblStage) -> None:
    homed.circle(CENTRE, 1.5, 25.0, math.inf)
    pump_until(homed, moving)
    thread = threading.Thread(target=homed.halt)
    thread.start()
    thread.join()
    assert pump_until(homed, lambda s: s.state is StageState.HELD)
    homed.safe()
    assert homed.status().state is StageState.IDLE
    assert homed.status().position_mm == pytest.approx((peer.x, peer.y), abs=0.002)
    homed.halt()  # at rest, too
    assert pump_until(homed, lambda s: s.state is StageState.HELD)
    homed.move(-5.0, -5.0, FEED)  # nothing was left to resume, so it may move on
    pump_until(homed, at_rest)


# ---------------------------------------------------------------- things that go wrong


def test_dropped_reports_are_asked_for_again(peer: GrblPeer, homed: GrblStage) -> None:
    peer.faults.drop_reports = 2
    assert homed.status().state is StageState.IDLE
    peer.faults.drop_every = 3
    homed.circle(CENTRE, 1.5, FEED, 3)
    pump_until(homed, at_rest)


def test_silence_is_a_timeout_not_a_hang(peer: GrblPeer, homed: GrblStage) -> None:
    homed.circle(CENTRE, 1.5, FEED, math.inf)
    pump_until(homed, moving)
    peer.faults.mute = True
    with pytest.raises(DeviceTimeout, match="no status report"):
        pump_until(homed, lambda s: False)
    for call in (homed.status, homed.safe, homed.resume):
        with pytest.raises(DeviceTimeout, match=r"within 0\.6 s"):  # it is known to be silent
            call()
    peer.faults.mute = False
    homed.safe()
    assert homed.status().state is StageState.IDLE


def test_an_unacknowledged_move_is_not_sent_again(peer: GrblPeer, homed: GrblStage) -> None:
    peer.faults.swallow_acks = 1
    with pytest.raises(DeviceError):
        homed.move(-5.0, -5.0, FEED)
    assert len([line for line in peer.lines if line.startswith("G53G1X-5")]) == 1


def test_a_lost_acknowledgement_ends_in_unknown(peer: GrblPeer, homed: GrblStage) -> None:
    peer.speed = 0.05  # until the fault is there
    homed.circle(CENTRE, 1.5, FEED, 3)
    peer.faults.swallow_acks = 1
    peer.speed = 2.0
    with pytest.raises(DeviceGarbled, match="acknowledgement was lost"):
        pump_until(homed, lambda s: False)
    assert homed.status().state is StageState.UNKNOWN
    with pytest.raises(DeviceRefused, match="home"):
        homed.move(-5.0, -5.0, FEED)
    homed.home(10.0)
    assert homed.status().state is StageState.IDLE


def test_noise_on_the_line_is_counted_and_survived(peer: GrblPeer, homed: GrblStage) -> None:
    rng = random.Random(4)
    lines = [
        b"\xff\x00\x81garbage\r\n", b"<Idle|MPos:nan,1,2>\r\n", b"<Run|MPos:1,2\r\n",
        b"error:\r\n", b"error:x9\r\n", b"ALARM:\r\n", b"<>\r\n", b"<Idle>\r\n", b"\r\n" * 50,
        b"<Idle|MPos:1e300,0,0|FS:1>\r\n", b"[VER:\r\n", b"$110=fast\r\n", bytes(3000) + b"\n",
        *(rng.randbytes(200).replace(b"\n", b"") + b"\r\n" for _ in range(40)),
    ]  # fmt: skip
    peer.faults.noise.extend(lines)
    homed.circle(CENTRE, 1.5, FEED, 3)
    pump_until(homed, at_rest)
    assert not peer.faults.noise
    assert homed.status().position_mm == pytest.approx((-8.5, -10.0), abs=0.002)
    assert homed.facts()["garbled_lines"] > 20


def test_a_refused_line_stops_the_stream_by_its_name(peer: GrblPeer, homed: GrblStage) -> None:
    homed.move(-11.0, -10.0, FEED)
    pump_until(homed, at_rest)
    homed.circle(CENTRE, 1.5, 25.0, math.inf)
    pump_until(homed, moving)
    peer.faults.refuse["G3"] = 33
    with pytest.raises(DeviceRefused, match=r"impossible \(error:33\)"):
        pump_until(homed, lambda s: False)
    assert peer.state == "Idle"
    assert homed.status().position_mm == pytest.approx((peer.x, peer.y), abs=0.002)


def test_a_first_line_that_is_refused_is_heard_in_the_call(
    peer: GrblPeer, homed: GrblStage
) -> None:
    peer.faults.refuse["G53G1"] = 20
    with pytest.raises(DeviceRefused, match="unsupported"):
        homed.move(-5.0, -5.0, FEED)


def test_a_hard_limit_blocks_until_unlocked_and_loses_the_position(
    peer: GrblPeer, homed: GrblStage
) -> None:
    peer.faults.hard_limit_at = -8.0
    homed.move(-20.0, -5.0, FEED)
    with pytest.raises(DeviceRefused, match=r"limit switch was hit in motion \(ALARM:1\)"):
        pump_until(homed, lambda s: False)
    status = homed.status()  # which it does not answer: known without asking
    assert (status.state, status.position_mm) == (StageState.ALARM, None)
    assert homed.position_at(homed.clock.now_ns()) is None
    homed.safe()
    with pytest.raises(DeviceRefused, match="ALARM:1"):
        homed.move(-5.0, -5.0, FEED)
    peer.faults.hard_limit_at = None
    homed.unlock()
    assert homed.status().state is StageState.UNKNOWN
    homed.home(10.0)
    assert homed.status().state is StageState.IDLE


def beyond(stage: GrblStage) -> None:
    stage.move(-60.0, -5.0, FEED)
    pump_until(stage, lambda s: False)


def test_the_controllers_own_soft_limit_is_a_named_alarm(tmp_path: Path) -> None:
    with GrblPeer(tmp_path, resets_on_open=False, speed=2) as peer:
        stage = make(peer, travel_mm=[[-100, 0], [-100, 0]])  # more than the controller's 40
        stage.connect()
        stage.home(10.0)
        with pytest.raises(DeviceRefused, match=r"ALARM:2.*\$130"):
            beyond(stage)
        stage.home(10.0)
        assert stage.status().state is StageState.IDLE
        stage.close()


def test_a_reset_behind_its_back_is_a_loss(peer: GrblPeer, homed: GrblStage) -> None:
    homed.circle(CENTRE, 1.5, FEED, math.inf)
    pump_until(homed, moving)
    peer.power_cycle()
    with pytest.raises(DeviceLost, match="was reset"):
        pump_until(homed, lambda s: False)
    with pytest.raises(DeviceLost, match="was reset"):
        homed.status()
    assert homed.position_at(homed.clock.now_ns()) is None
    homed.connect()
    assert homed.status().state is StageState.UNKNOWN
    with pytest.raises(DeviceRefused, match="home"):
        homed.move(-5.0, -5.0, FEED)


def test_pulled_and_back_under_another_name(peer: GrblPeer, homed: GrblStage) -> None:
    homed.circle(CENTRE, 1.5, FEED, math.inf)
    pump_until(homed, moving)
    before = peer.name
    peer.unplug()
    with pytest.raises(DeviceLost):
        pump_until(homed, lambda s: False)
    assert homed.position_at(homed.clock.now_ns()) is None
    homed.halt()
    with pytest.raises(DeviceLost):
        homed.connect()
    assert homed.position_at(homed.clock.now_ns()) is None
    peer.plug()
    assert peer.name != before
    homed.connect()
    assert homed.status().state is StageState.UNKNOWN
    count = len(peer.lines)
    with pytest.raises(DeviceRefused, match="home"):
        homed.circle(CENTRE, 1.5, FEED, 1)
    assert len(peer.lines) == count
    homed.home(10.0)
    homed.move(-5.0, -5.0, FEED)
    pump_until(homed, at_rest)


def work_on(stage: GrblStage, rng: random.Random) -> None:
    while True:
        stage.home(10.0)
        stage.circle(CENTRE, 1.5, FEED, math.inf)
        end = time.monotonic() + rng.uniform(0.0, 0.2)
        while time.monotonic() < end:
            stage.pump()
            time.sleep(0.005)
        rng.choice([stage.stop, stage.hold, stage.check])()
        stage.stop()


def test_pulled_at_random_moments(peer: GrblPeer, stage: GrblStage) -> None:
    rng = random.Random(13)
    for _ in range(6):
        timer = threading.Timer(rng.uniform(0.0, 0.5), peer.unplug)
        timer.start()
        with pytest.raises(DeviceLost):
            work_on(stage, rng)
        timer.join()
        assert stage.position_at(stage.clock.now_ns()) is None
        with pytest.raises(DeviceLost):
            stage.connect()
        peer.plug()
        stage.connect()
        assert stage.status().state is StageState.UNKNOWN
        count = len(peer.lines)
        with pytest.raises(DeviceRefused, match="home"):
            stage.circle(CENTRE, 1.5, FEED, 1)
        assert len(peer.lines) == count


def test_a_line_that_dies_under_a_write_loses_the_position(
    homed: GrblStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Met with the real firmware: the write saw the hang-up before the reader did."""

    def dead(_data: bytes) -> None:
        raise DeviceLost("stage", "write", "the line is dead")

    monkeypatch.setattr(homed._link.port, "write", dead)
    with pytest.raises(DeviceLost):
        homed.check()
    assert homed.position_at(homed.clock.now_ns()) is None


def test_a_controller_that_runs_without_moving_is_told(peer: GrblPeer, homed: GrblStage) -> None:
    homed.circle(CENTRE, 1.5, FEED, math.inf)
    pump_until(homed, moving)
    peer.faults.stalled = True
    with pytest.raises(DeviceTimeout, match="has not moved for 2 s"):
        pump_until(homed, lambda s: False)
    peer.faults.stalled = False
    homed.stop()
    assert homed.status().state is StageState.IDLE


def test_a_wrong_digit_in_a_report_moves_nothing(peer: GrblPeer, homed: GrblStage) -> None:
    before = homed.status().position_mm
    garbled = homed.facts()["garbled_lines"]
    peer.faults.noise.append(b"<Idle|MPos:-31.000,-1.000,0.000|FS:0,0>\r\n")
    end = time.monotonic() + 60
    while homed.facts()["garbled_lines"] == garbled and time.monotonic() < end:
        assert homed.status().position_mm == before
    assert homed.facts()["garbled_lines"] == garbled + 1
    assert homed.position_at(homed.clock.now_ns()) == before
    peer.x = -31.0  # two that agree are believed: it was moved by somebody else
    assert homed.status().position_mm == (-31.0, -1.0)


@pytest.mark.parametrize("seed", range(2))
def test_whatever_comes_on_the_line_every_call_ends(tmp_path: Path, seed: int) -> None:
    """Cut, doubled, spoilt and foreign bytes at any boundary: a DeviceError at worst, and soon."""
    rng = random.Random(seed)
    with GrblPeer(tmp_path, resets_on_open=False, speed=4) as peer:
        stage = make(peer)
        peer.faults.spoil = lambda data: spoilt(data, rng)
        ended = 0
        for _ in range(12):
            began = time.monotonic()
            try:
                stage.connect()
                stage.home(5.0)
                stage.circle(CENTRE, 1.5, FEED, 2)
                for _ in range(20):
                    stage.pump()
                stage.stop()
                ended += 1
            except DeviceError:
                ended += 1
            if time.monotonic() > began + 0.8:
                break  # enough of it
        assert ended
        peer.faults.spoil = None
        stage.connect()
        stage.home(10.0)
        assert stage.status().state is StageState.IDLE
        stage.close()


def spoilt(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    noise: list[bytes] = [
        rng.randbytes(rng.randrange(1, 40)),
        bytes(30),
        b"x" * 10_000,
        b"ok\r\n",
        b"error:9\r\n",
        b"ALARM:1\r\n",
        b"<Idle|MPos:1,1,1>\n",
    ]
    kind = rng.randrange(50)
    if kind < len(noise):
        return data[:at] + noise[kind] + data[at:]
    if kind == len(noise):
        return data[:at]  # half a line
    if kind == len(noise) + 1:
        return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
    return data


def test_pulled_while_homing(peer: GrblPeer, stage: GrblStage) -> None:
    peer.faults.homing_s = 60.0
    with once(lambda: peer.state == "Home", peer.unplug), pytest.raises(DeviceLost):
        stage.home(120.0)


# ---------------------------------------------------------------- what it says


@settings(max_examples=40, deadline=None)
@given(st.text(max_size=60))
def test_no_line_makes_the_parsers_raise(text: str) -> None:
    for line in (text, f"<{text}>", f"<Idle|{text}>", f"<Idle|MPos:{text}>", f"[OPT:{text}]"):
        grbl.parse_report(line)
        grbl.parse_banner(line)
        grbl.parse_build([line, f"[VER:{text}]"])
        grbl.parse_settings([line, f"${text}", f"$110={text}"])
        assert len(grbl.plain(line)) <= len(line)
        grbl.parse_item([line, f"$/axes/x/{text}"], "/axes/x/max_travel_mm")


def test_a_report_is_read_in_full() -> None:
    report = grbl.parse_report(
        "<Hold:1|WPos:1.000,-2.000,0.000|Bf:15,128|FS:1500,0|Pn:XYP|WCO:-5.000,3.000,0.000>"
    )
    assert report is not None
    assert (report.state, report.substate, report.pins) == ("Hold", 1, "XYP")
    assert report.position == (-4.0, 1.0)
    assert report.speed == 25.0
    later = grbl.parse_report("<Idle|WPos:0,0,0>", offset=report.offset)
    assert later is not None
    assert later.position == (-5.0, 3.0)
    inches = grbl.parse_report("<Run|MPos:1.0000,0.0000,0.0000|F:60.0>", scale=25.4)
    assert inches is not None
    assert inches.position == (25.4, 0.0)
    assert inches.speed == 25.4


@pytest.mark.parametrize(
    "line",
    ["<Idle>", "<Idle|MPos:>", "<Idle|MPos:1>", "<Nap|MPos:1,2,3>", "<Idle|MPos:1_0,2,3>",
     "<Hold:x|MPos:1,2,3>", "Idle|MPos:1,2,3", "<Idle|MPos:inf,2,3>", "<Idle|WPos:1,2,3|WCO:a>"],
)  # fmt: skip
def test_a_damaged_report_is_none(line: str) -> None:
    assert grbl.parse_report(line) is None


def test_every_documented_alarm_and_error_has_words_and_a_remedy() -> None:
    for code in range(1, 11):
        words, remedy = faults.alarm(code)
        assert f"ALARM:{code}" in words
        assert remedy
    for code in [*range(1, 18), *range(20, 39)]:
        words, remedy = faults.refusal(code)
        assert f"error:{code}" in words
        assert "refused" not in words
        assert remedy


def test_the_clock_is_the_contexts(peer: GrblPeer) -> None:
    clock = RealClock()
    stage = make(peer, clock)
    stage.connect()
    before = clock.now_ns()
    assert before <= stage.status().at_ns <= clock.now_ns()
    stage.close()
