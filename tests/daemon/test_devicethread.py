"""A thread a device: revoked sessions, calls that hang, errors that travel."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from daemon.devices.devicethread import DeviceThread, Revoked, Session, Stuck
from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceGarbled, DeviceLost
from drivers.base.light import Light


class Lamp(Light):
    """A light whose calls can be made to block until halted."""

    def __init__(self) -> None:
        super().__init__("lamp", Options(), Context())
        self.acts: list[str] = []
        self.entered = threading.Event()
        self.let_go = threading.Event()
        self.deaf = False

    def connect(self) -> Identity:
        return Identity("lamp")

    def check(self) -> None: ...

    def safe(self) -> None:
        self.acts.append("safe")

    def halt(self) -> None:
        self.acts.append("halt")
        if not self.deaf:
            self.let_go.set()

    def close(self) -> None: ...

    def set(self, on: bool) -> None:
        self.acts.append(f"set {on}")

    def is_on(self) -> bool:
        return False

    def block(self) -> None:
        self.entered.set()
        self.let_go.wait()


@pytest.fixture
def lamp() -> Iterator[DeviceThread[Lamp]]:
    thread = DeviceThread(Lamp())
    yield thread
    thread.device.let_go.set()
    assert thread.close(5)


def test_calls_are_made_by_one_thread_in_order(lamp: DeviceThread[Lamp]) -> None:
    ran: list[int] = []
    futures = [lamp.submit(lambda _, n=n: ran.append(n), 1) for n in range(20)]  # type: ignore[misc]
    for future in futures:
        future.result(60)
    assert ran == list(range(20))
    assert lamp.call(lambda _: threading.current_thread().name, 1) == "umbra-lamp"


def test_an_error_travels_to_the_caller(lamp: DeviceThread[Lamp]) -> None:
    def lose(_: Lamp) -> None:
        raise DeviceLost("lamp", "set", "it is gone")

    with pytest.raises(DeviceLost, match="it is gone"):
        lamp.call(lose, 1)
    assert lamp.call(lambda _: 7, 1) == 7


def test_what_a_revoked_session_asked_for_does_not_happen(lamp: DeviceThread[Lamp]) -> None:
    session = Session("run 1")
    blocked = lamp.submit(Lamp.block, 5, session)
    assert lamp.device.entered.wait(60)
    late = lamp.submit(lambda d: d.set(True), 5, session)
    session.revoke()
    safe = lamp.submit(Lamp.safe, 5)
    lamp.device.halt()
    blocked.result(60)
    safe.result(60)
    with pytest.raises(Revoked):
        late.result(60)
    assert lamp.device.acts == ["halt", "safe"]


def test_a_late_call_is_halted_first(lamp: DeviceThread[Lamp]) -> None:
    lamp.call(Lamp.block, 0.05)  # comes back because it was halted
    assert lamp.device.acts == ["halt"]
    assert not lamp.stuck


def test_a_call_that_never_comes_back_is_named(
    lamp: DeviceThread[Lamp], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.devices.devicethread._HALT_GRACE_S", 0.4)
    lamp.device.deaf = True
    assert lamp.call(lambda _: True, 5)  # its thread is up: on a loaded machine that takes time
    with pytest.raises(Stuck, match=r"lamp: call: the driver has not come back in 0.4 s"):
        lamp.call(Lamp.block, 0.4)
    assert lamp.stuck
    assert not lamp.alive
    lamp.device.let_go.set()
    assert lamp.call(lambda _: True, 5)
    assert lamp.alive


def test_what_a_driver_should_not_raise_is_a_device_error(lamp: DeviceThread[Lamp]) -> None:
    def break_down(_: Lamp) -> None:
        raise OSError(5, "Input/output error")

    with pytest.raises(DeviceGarbled, match="lamp: call: the driver broke: OSError") as caught:
        lamp.call(break_down, 1)
    assert isinstance(caught.value.__cause__, OSError)
    assert lamp.call(lambda _: 7, 1) == 7
