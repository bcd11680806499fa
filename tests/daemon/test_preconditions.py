"""What is waited for before a run's first frame, and until when."""

from __future__ import annotations

import threading

import msgspec
import pytest

from daemon.devices.devicethread import Revoked, Session
from daemon.exposing.control import Control
from daemon.runs.preconditions import LightWatch, Precondition, Preconditions
from daemon.separation.metering import Level
from drivers.base.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.clock import NS, Clock
from protocol.errors import Code, UmbraError
from protocol.messages.runs import RunState, Waiting
from protocol.scans.spec import Ready


class JumpingClock(Clock):
    """Waits take no time: it is later at once."""

    def __init__(self) -> None:
        self.now = 0
        self.at: dict[float, threading.Event] = {}  # events that come at a second

    def now_ns(self) -> int:
        return self.now

    def utc_ns(self) -> int:
        return self.now

    def wait_until(self, deadline_ns: int, wake: threading.Event | None = None) -> bool:
        for second in sorted(self.at):
            if second * NS <= deadline_ns:
                self.now = max(self.now, round(second * NS))
                self.at.pop(second).set()
                return True
        self.now = max(self.now, deadline_ns)
        return wake is not None and wake.is_set()

    @property
    def seconds(self) -> float:
        return self.now / NS


class Bench:
    """A run about to begin."""

    def __init__(self, ready: Ready) -> None:
        self.ready = ready
        self.clock = JumpingClock()
        self.control = Control()
        self.session = Session("run x")
        self.told: list[Waiting] = []
        self.failed: list[DeviceError] = []

    def wait(self, *conditions: Precondition) -> float:
        return Preconditions(
            self.ready,
            conditions,
            clock=self.clock,
            control=self.control,
            session=self.session,
            on_wait=self.told.append,
            on_failure=self.failed.append,
        ).wait()

    def until(self, second: float, error: Exception) -> Precondition:
        """Something that is so from a second on."""

        def check() -> None:
            if self.clock.seconds < second:
                raise error

        return Precondition("devices", check)

    def light(self, *shares: float) -> list[Precondition]:
        """A light that is so at each look; the last one stays."""
        left = list(shares)

        def look() -> Level:
            share = left.pop(0) if len(left) > 1 else left[0]
            return Level(share, 0.0, share >= 1.0, 1000.0)

        return LightWatch(self.ready, look, self.clock).conditions()


LOST = DeviceLost("camera", "grab", "it is gone", "plug it in")
PATIENT = Ready(deadline_s=60, look_s=10)


def test_what_is_there_is_not_waited_for() -> None:
    bench = Bench(PATIENT)
    assert bench.wait(bench.until(0, LOST)) == 0
    assert bench.told == []


def test_it_is_waited_for_and_said_since_when_and_until_when() -> None:
    bench = Bench(PATIENT)
    assert bench.wait(bench.until(25, LOST)) == 30
    assert bench.failed == [LOST] * 3
    assert {(w.what, w.since[-14:-6], w.until[-14:-6]) for w in bench.told} == {
        ("devices", "00:00:00", "00:01:00")
    }
    assert "it is gone" in bench.told[0].seen


def test_an_event_ends_the_wait_for_the_next_look() -> None:
    bench = Bench(PATIENT)
    bench.clock.at[13] = bench.control.news
    assert bench.wait(bench.until(12, LOST)) == 13


def test_at_the_deadline_it_is_said_what_never_was_so() -> None:
    bench = Bench(PATIENT)
    with pytest.raises(UmbraError) as caught:
        bench.wait(bench.until(100, LOST))
    assert caught.value.code is Code.NOT_READY
    assert "not ready within 60 s: devices never was so" in caught.value.message
    assert "camera: grab: it is gone" in caught.value.message
    assert bench.clock.seconds == 60


def test_without_a_deadline_nothing_is_waited_for() -> None:
    bench = Bench(Ready())
    with pytest.raises(DeviceLost):
        bench.wait(bench.until(1, LOST))
    assert bench.told == []


def test_what_will_not_mend_itself_ends_at_once() -> None:
    bench = Bench(PATIENT)
    with pytest.raises(DeviceRefused):
        bench.wait(bench.until(1, DeviceRefused("stage", "scan", "it is in alarm")))
    assert bench.clock.seconds == 0


def test_what_somebody_may_mend_is_waited_for() -> None:
    bench = Bench(Ready(deadline_s=100.0, look_s=10.0))

    def alarm() -> None:
        if bench.clock.seconds < 30:
            raise DeviceRefused("stage", "scan", "it is in alarm", "look at it")

    assert bench.wait(Precondition("stage", alarm, mended=True)) == 30.0
    assert "in alarm; look at it" in bench.told[0].seen


def test_an_end_ends_the_wait() -> None:
    bench = Bench(PATIENT)

    def check() -> None:
        bench.control.end(RunState.ABORTED, "aborted")
        raise LOST

    with pytest.raises(Revoked):
        bench.wait(Precondition("devices", check))
    assert bench.failed == []  # a device that was halted did not fail


def test_night_is_waited_out() -> None:
    bench = Bench(Ready(deadline_s=600, light_min=0.2, look_s=10))
    assert bench.wait(*bench.light(0.01, 0.05, 0.19, 0.4)) == 30
    assert "at 1.0% of full scale, and at least 20.0% are wanted" in bench.told[0].seen


def test_too_much_light_is_waited_out_and_named() -> None:
    bench = Bench(Ready(deadline_s=600, light_max=0.9, look_s=10))
    assert bench.wait(*bench.light(1.0, 0.95, 0.8)) == 20
    assert "saturated" in bench.told[0].seen


def test_steady_is_three_looks_that_agree() -> None:
    bench = Bench(Ready(deadline_s=600, light_min=0.2, steady=0.05, look_s=10))
    took = bench.wait(*bench.light(0.1, 0.8, 0.4, 0.8, 0.81, 0.79, 0.8))
    assert took == 50
    assert [w.what for w in bench.told] == ["light"] + ["steadiness"] * 4


def test_a_light_that_came_and_went_is_told_from_one_that_never_came() -> None:
    bench = Bench(Ready(deadline_s=30, light_min=0.2, steady=0.05, look_s=10))
    with pytest.raises(UmbraError, match="light had been so, and was no longer"):
        bench.wait(*bench.light(0.8, 0.1))


def test_saturated_light_is_not_steady() -> None:
    bench = Bench(Ready(deadline_s=60, steady=0.05, look_s=10))
    with pytest.raises(UmbraError, match="saturated: nothing can be said"):
        bench.wait(*bench.light(1.0))


def test_events_do_not_make_looks_come_sooner() -> None:
    bench = Bench(Ready(deadline_s=60, steady=0.05, look_s=10))
    bench.clock.at[1] = bench.control.news
    bench.clock.at[2] = bench.control.news
    assert bench.wait(*bench.light(0.5)) >= 20


@pytest.mark.parametrize(
    "wrong",
    [
        {"light_min": 0.5, "light_max": 0.4},
        {"steady": 0.1},
        {"steady": 0.1, "deadline_s": 15, "look_s": 10},
        {"light_min": 1.0},
        {"look_s": 0.0},
    ],
)
def test_what_can_never_be_so_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, Ready)
