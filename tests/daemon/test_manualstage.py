"""One motion by hand ends the other: nothing waits behind it, nothing halts it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from daemon import config
from daemon.devices.rig import Rig
from daemon.manual.manual import Manual
from daemon.manual.manualstage import ManualStage
from daemon.pictures.viewfinder import Viewfinder
from drivers.base.errors import DeviceLost, DeviceRefused
from protocol.errors import Code, UmbraError
from protocol.messages.events import StageChanged
from protocol.messages.rig import Health, StageState

RIG = """
[rig]
time_scale = 20
[stage]
driver = "virtual"
parked_mm = [20, 10]
"""


class Told:
    """What was published of the stage."""

    def __init__(self) -> None:
        self.states: list[StageState] = []
        self._news = threading.Condition()

    def __call__(self, event: object) -> None:
        assert isinstance(event, StageChanged)
        with self._news:
            self.states.append(event.state)
            self._news.notify_all()

    def until(self, true: Callable[[], bool]) -> None:
        with self._news:
            assert self._news.wait_for(true, 60.0)

    def at_rest(self) -> None:
        self.until(lambda: self.states[-1:] == [StageState.IDLE])


@pytest.fixture
def told() -> Told:
    return Told()


@contextmanager
def by_hand(told: Told, options: str = "") -> Iterator[ManualStage]:
    rig = Rig(config.parse(RIG + options, "test"), lambda _: None)
    rig.connect()
    stage = Manual(rig, Viewfinder(lambda _: None), lambda: None, told).stage
    yield stage
    stage.finish()
    rig.close()


@pytest.fixture
def stage(told: Told) -> Iterator[ManualStage]:
    with by_hand(told) as stage:
        stage.home(1000.0)
        told.at_rest()
        yield stage


def followers() -> int:
    return sum(thread.name == "umbra-stage-by-hand" for thread in threading.enumerate())


def test_nobody_pumps_behind_a_homing(stage: ManualStage, told: Told) -> None:
    """A pump that waits for a long homing is late, and what is late is halted: the position was
    lost."""
    stage.circle((200.0, 150.0), 10.0, 100.0, None)
    stage.home(1000.0)
    assert followers() == 1
    told.at_rest()
    assert stage.status().position_mm == (0.0, 0.0)


def test_a_motion_takes_the_place_of_the_one_under_way(stage: ManualStage, told: Told) -> None:
    stage.circle((200.0, 150.0), 10.0, 100.0, None)
    told.states.clear()
    stage.move(10.0, 20.0, 100.0)
    told.at_rest()
    assert stage.status().position_mm == (10.0, 20.0)


def test_what_is_refused_leaves_a_stage_that_stands(stage: ManualStage, told: Told) -> None:
    stage.circle((200.0, 150.0), 10.0, 100.0, None)
    told.states.clear()
    with pytest.raises(DeviceRefused, match="soft limit"):
        stage.move(-1.0, 0.0, 100.0)
    told.at_rest()


def test_homing_is_ended_by_stop_only(told: Told) -> None:
    with by_hand(told, "homing_feed_mm_s = 0.001") as stage:  # 20 minutes
        stage.home(1e6)
        for other in (stage.unlock, lambda: stage.move(1.0, 1.0, 10.0), lambda: stage.home(9.0)):
            with pytest.raises(UmbraError, match="homing: wait for its end, or `umbra stage stop`"):
                other()
        assert stage.stop().state is StageState.UNKNOWN


def test_nothing_moves_that_is_not_homed(told: Told) -> None:
    with by_hand(told) as stage:
        with pytest.raises(UmbraError, match="position is not known; home it") as caught:
            stage.move(10.0, 10.0, 50.0)
        assert caught.value.code is Code.WRONG_STATE
        stage._thread.device.faults.inject("no-switch", act="home")  # type: ignore[attr-defined]
        stage.home(1000.0)
        told.until(lambda: told.states[-1:] == [StageState.ALARM])
        with pytest.raises(UmbraError, match="limit switch X was not found") as caught:
            stage.circle((200.0, 150.0), 10.0, 100.0, None)
        assert caught.value.code is Code.WRONG_STATE


def test_a_stage_that_is_lost_meanwhile_is_known_to_be(stage: ManualStage) -> None:
    """By whichever call notices it; else it was never connected again while a circle went on."""
    thread = stage._thread
    thread.device.faults.inject("vanish", act="stop")  # type: ignore[attr-defined]
    stage.circle((200.0, 150.0), 10.0, 100.0, None)
    with pytest.raises(DeviceLost):
        stage.stop()
    assert stage._rig.devices()[0].health is Health.LOST
    with pytest.raises(DeviceLost):
        thread.call(lambda s: s.connect(), 60.0)
    thread.call(lambda s: s.connect(), 60.0)  # as the rig does now
