"""The stage by hand, through a real daemon: homing, motions, who may and when."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import umbra
from protocol.client import EventStream
from protocol.errors import Code, UmbraError
from protocol.messages.events import StageChanged
from protocol.messages.rig import RigState, StageState
from protocol.messages.runs import RunState
from tests.drivers.grbl_peer import GrblPeer
from tests.system.harness import ENDLESS, Daemon, recorded, until

pytestmark = pytest.mark.system

STAGE = '[stage]\ndriver = "virtual"\nparked_mm = [20, 10]\n{}\n'


@pytest.fixture
def staged(daemon: Daemon) -> Daemon:
    daemon.configure(more=STAGE.format(""), scale=8)
    return daemon


def at(rig: umbra.Client, state: StageState) -> bool:
    return rig.stage().state is state


def told(events: EventStream, state: StageState) -> None:
    """Wait until it is published that the stage is in a state."""
    while True:
        notice = events.next(60.0)
        assert notice is not None
        assert isinstance(notice.body, StageChanged)
        if notice.body.state is state:
            return


def homed(rig: umbra.Client) -> None:
    rig.stage_home(30.0)
    until(lambda: at(rig, StageState.IDLE))


def test_homed_moved_and_followed_to_the_end(staged: Daemon) -> None:
    with staged.start() as rig, rig.subscribe("stage") as events:
        assert rig.stage().state is StageState.UNKNOWN
        with pytest.raises(UmbraError, match="home it") as caught:
            rig.stage_move(10, 10, 50)
        assert caught.value.code is Code.WRONG_STATE
        begun = rig.stage_home(30.0)
        assert (begun.state, begun.position_mm) == (StageState.HOMING, None)
        told(events, StageState.HOMING)
        told(events, StageState.IDLE)
        assert rig.stage().position_mm == pytest.approx((0, 0))
        moving = rig.stage_move(400, 200, 1)  # 56 s
        assert moving.state is StageState.MOVING
        assert rig.status().state is RigState.MANUAL
        told(events, StageState.MOVING)
        rig.stage_move(40, 30, 100)
        told(events, StageState.IDLE)
        assert rig.stage().position_mm == pytest.approx((40, 30))
        with pytest.raises(UmbraError, match="past the soft limit"):
            rig.stage_move(-1, 0, 20)
        until(lambda: rig.status().state is RigState.IDLE)  # manual work ends with the motion
        assert rig.stage().position_mm == pytest.approx((40, 30))


def test_an_endless_circle_goes_on_until_it_is_stopped(staged: Daemon) -> None:
    with staged.start() as rig, staged.connect() as other:
        homed(rig)
        rig.stage_circle((100, 100), 10, 100)
        until(lambda: (rig.stage().position_mm or (0, 0))[0] > 80)
        other.stage_stop()
        here = rig.stage()
        assert here.state is StageState.IDLE
        assert here.position_mm is not None
        assert rig.stage().position_mm == here.position_mm


def test_homing_is_stopped_and_its_failure_told(staged: Daemon) -> None:
    slowly = 'faults = ["no-switch@2"]\nhoming_feed_mm_s = 0.01'
    staged.configure(more=STAGE.format(slowly), scale=2)
    with staged.start() as rig:
        rig.stage_home(600.0)
        with pytest.raises(UmbraError, match="homing") as caught:
            rig.stage_home(30.0)
        assert caught.value.code is Code.BUSY
        stopped = rig.stage_stop()
        assert stopped.state is StageState.UNKNOWN
        assert "halted" in stopped.detail
        rig.stage_home(30.0)
        until(lambda: at(rig, StageState.ALARM))
        assert "limit switch X was not found" in rig.stage().detail
        unlocked = rig.stage_unlock()
        assert (unlocked.state, unlocked.detail) == (StageState.UNKNOWN, "")


def test_refused_while_held_by_another_or_scanning(staged: Daemon) -> None:
    with staged.start() as rig, staged.connect() as other:
        homed(rig)
        with rig.hold("ada"):
            with pytest.raises(UmbraError, match="held by ada") as caught:
                other.stage_move(10, 10, 50)
            assert caught.value.code is Code.LOCKED
            rig.stage_circle((100, 100), 10, 100)
            assert other.stage_stop().state is StageState.IDLE  # to stop is never refused
        run = rig.scan(ENDLESS)
        recorded(rig, run.id, 2)
        assert rig.stage().position_mm is not None
        for act in (rig.stage_stop, rig.stage_home, lambda: rig.stage_move(10, 10, 50)):
            with pytest.raises(UmbraError, match=run.id) as caught:
                act()
            assert caught.value.code is Code.BUSY
        rig.abort()


def test_a_scan_waits_for_the_end_of_a_motion(staged: Daemon) -> None:
    with staged.start() as rig:
        rig.stage_home(30.0)
        assert rig.scan(umbra.TwoImage()).wait(60).state is RunState.DONE
        assert rig.stage().position_mm == pytest.approx((0, 0))


def test_an_emergency_stop_ends_it(staged: Daemon) -> None:
    with staged.start() as rig:
        homed(rig)
        rig.stage_move(400, 200, 1)  # 56 s
        rig.estop()
        until(lambda: not at(rig, StageState.MOVING))
        position = rig.stage().position_mm
        assert position is not None
        assert position[0] < 400
        with pytest.raises(UmbraError) as caught:
            rig.stage_move(10, 10, 50)
        assert caught.value.code is Code.ESTOPPED


def test_a_real_controller(daemon: Daemon, tmp_path: Path) -> None:
    """The same over Grbl's own protocol: homing is silent, an arc is many lines."""
    with GrblPeer(tmp_path, speed=4.0, resets_on_open=False) as peer:
        daemon.configure(scale=1, more=f'[stage]\ndriver = "grbl"\nport = "{peer.link}"')
        peer.faults.homing_s = 1e6
        with daemon.start() as rig:
            begun = rig.stage_home(100.0)
            assert rig.stage().state is begun.state is StageState.HOMING
            peer.faults.homing_s = 0.0
            until(lambda: at(rig, StageState.IDLE))
            rig.stage_move(-10, -10, 20)
            until(lambda: at(rig, StageState.IDLE))
            assert rig.stage().position_mm == pytest.approx((-10, -10), abs=0.01)
            rig.stage_circle((-10, -10), 4, 20)
            until(lambda: (rig.stage().position_mm or (0, 0))[0] < -13)
            stopped = rig.stage_stop()
            assert stopped.state is StageState.IDLE
            assert stopped.position_mm is not None
            rig.stage_circle((-10, -10), 4, 20, turns=0.5)
            until(lambda: at(rig, StageState.IDLE))
            assert rig.stage().position_mm == pytest.approx((-14, -10), abs=0.01)
            peer.faults.switch_missing = True
            rig.stage_home(100.0)
            until(lambda: at(rig, StageState.ALARM))
            assert "switch" in rig.stage().detail
            assert rig.stage_unlock().state is StageState.UNKNOWN


def test_a_rig_without_a_stage(daemon: Daemon) -> None:
    with daemon.start() as rig, pytest.raises(UmbraError, match=r"add \[stage\]") as caught:
        rig.stage()
    assert caught.value.code is Code.DEVICE_MISSING


def test_the_command_line(staged: Daemon) -> None:
    def umbra_stage(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "protocol.cli", "--rig", staged.endpoint, "stage", *arguments],
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )

    with staged.start():
        assert "unknown" in umbra_stage().stdout
        unhomed = umbra_stage("move", "12.5", "40")
        assert unhomed.returncode == 4
        assert "umbra stage home" in unhomed.stderr
        assert umbra_stage("home", "--wait").returncode == 0
        done = umbra_stage("move", "12.5", "40", "--wait", "--json")
        assert json.loads(done.stdout)["position_mm"] == pytest.approx([12.5, 40])
        beyond = umbra_stage("move", "1000", "0")
        assert beyond.returncode == 2
        assert "past the soft limit" in beyond.stderr
        assert "position  12.500, 40.000 mm" in umbra_stage("status").stdout
