"""The service manager's socket, played by the test."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.notify import Notifier


class Manager:
    """The receiving end of NOTIFY_SOCKET."""

    def __init__(self, bound_to: str, name: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(bound_to)
        self.socket.settimeout(5)
        self.environ = {"NOTIFY_SOCKET": name}

    def heard(self) -> str:
        return self.socket.recv(4096).decode()


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    if request.param == "path":
        name = bound_to = str(tmp_path / "notify")
    else:
        name, bound_to = f"@umbra-test-{os.getpid()}", f"\0umbra-test-{os.getpid()}"
    manager = Manager(bound_to, name)
    yield manager
    manager.socket.close()


def test_each_call_is_one_datagram(manager: Manager) -> None:
    notifier = Notifier(manager.environ)
    assert notifier.ready("idle")
    assert manager.heard() == "READY=1\nSTATUS=idle"
    assert notifier.status("scanning\n12 of 25")
    assert manager.heard() == "STATUS=scanning 12 of 25"
    assert notifier.watchdog()
    assert manager.heard() == "WATCHDOG=1"
    assert notifier.stopping()
    assert manager.heard() == "STOPPING=1"


def test_without_a_manager_there_is_nobody_to_tell() -> None:
    notifier = Notifier({"WATCHDOG_USEC": "1000000"})
    assert notifier.ready()
    assert notifier.watchdog()
    assert notifier.watchdog_interval() is None


def test_a_manager_that_is_gone_is_reported_and_harms_nothing(tmp_path: Path) -> None:
    assert not Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}).watchdog()


def test_a_full_queue_does_not_block(manager: Manager) -> None:
    notifier = Notifier(manager.environ)
    taken = [notifier.watchdog() for _ in range(10_000)]
    assert taken[0]
    assert not taken[-1]


@pytest.mark.parametrize(
    ("usec", "pid", "interval"),
    [
        ("30000000", "", 30.0),
        ("30000000", "mine", 30.0),
        ("500000", "mine", 0.5),
        ("30000000", "another", None),  # inherited from somebody else's service
        ("0", "", None),
        ("soon", "", None),
        ("", "", None),
    ],
)
def test_the_watchdog_is_meant_for_this_process(
    usec: str, pid: str, interval: float | None
) -> None:
    of = {"mine": str(os.getpid()), "another": str(os.getpid() + 1)}
    environ = {"NOTIFY_SOCKET": "@nowhere", "WATCHDOG_USEC": usec, "WATCHDOG_PID": of.get(pid, "")}
    assert Notifier(environ).watchdog_interval() == interval
