"""Processes that start warm: forks of one that has imported umbrad, built the virtual scene and
simulated the ranks of the paper's patterns.

A fresh interpreter needs a second of computing before umbrad's first line, a fork needs none; from
there on it is a process like any other: its signals, sockets, files and end are its own. What a
start from nothing is, tests of the command line, of `umbra demo` and of systemd see.

    tests --(request, files)--> nursery --fork--> nurse --fork--> umbrad
      ^------------------------ pid, exit code ----'

The nursery has one thread, so that a fork takes no lock along that nobody would give back. A nurse
waits for its one child, for tests are not its parent.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path

_ROOM = 1 << 20  # bytes of a request: arguments and environment


class Process:
    """A warm umbrad; has what the tests use of subprocess.Popen."""

    def __init__(
        self, arguments: list[str], *, stderr: int, environment: Mapping[str, str]
    ) -> None:
        reading, writing = os.pipe()
        self._news = os.fdopen(reading, "rb", buffering=0)
        request = json.dumps([arguments, str(Path.cwd()), dict(environment)]).encode()
        try:
            socket.send_fds(_nursery(), [request], [stderr, writing])
        finally:
            os.close(writing)
        born = self._news.readline()
        assert born, "the nursery has ended: its error output says why"
        self.pid = int(born)
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """The exit code, minus the number of a signal that ended it; None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        if self.returncode is None:
            if not select.select([self._news], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("umbrad", timeout)
            self.returncode = int(self._news.readline())
            self._news.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        """As Popen's."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)


@cache
def _nursery() -> socket.socket:
    """The way to this process's nursery, which is started now and ends with it."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    nursery = subprocess.Popen(
        [sys.executable, "-m", "tests.system.warm"], stdin=its.fileno(), stdout=subprocess.DEVNULL
    )
    its.close()

    def end() -> None:
        ours.close()
        nursery.wait(60)

    atexit.register(end)
    return ours


# ---------------------------------------------------------------- in the nursery


def main() -> int:
    """Fork for each request until the tests have ended; a child comes back from here."""
    _prepare()
    door = socket.socket(fileno=os.dup(0))
    while True:
        request, files, _, _ = socket.recv_fds(door, _ROOM, 2)
        if not request:
            return 0
        if os.fork() == 0:
            door.close()
            return _nurse(request, *files)
        for file in files:
            os.close(file)


def _prepare() -> None:
    import cv2

    import daemon.app  # noqa: F401
    from daemon.scans.catalog import method_for
    from daemon.scans.method import Bench
    from drivers.base.camera import CameraInfo
    from drivers.base.pixelformat import PixelFormat
    from drivers.base.projector import ProjectorInfo
    from drivers.virtual import camera, light, projector, stage  # noqa: F401
    from drivers.virtual.scene import patches
    from protocol.scans.projected import Checkerboard

    cv2.setNumThreads(0)  # a pool of threads would not live through a fork
    patches()
    bench = Bench(CameraInfo(64, 48, PixelFormat.MONO12), ProjectorInfo(64, 48, 60.0))
    method_for(Checkerboard(), bench).estimator()
    cv2.setNumThreads(-1)
    assert len(list(Path("/proc/self/task").iterdir())) == 1
    signal.signal(signal.SIGCHLD, _reap)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the tests: they shut the door


def _reap(*_: object) -> None:
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def _nurse(request: bytes, stderr: int, news: int) -> int:
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    child = os.fork()
    if child == 0:
        os.close(news)
        return _umbrad(request, stderr)
    os.write(news, b"%d\n" % child)
    _, status = os.waitpid(child, 0)
    with contextlib.suppress(BrokenPipeError):  # nobody asks any more
        os.write(news, b"%d\n" % os.waitstatus_to_exitcode(status))
    os._exit(0)


def _umbrad(request: bytes, stderr: int) -> int:
    import daemon.app

    arguments, folder, environment = json.loads(request)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    with Path(os.devnull).open("rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(stderr, 2)
    os.close(stderr)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):  # under nohup the tests ignore SIGHUP
        signal.signal(number, signal.SIG_DFL)
    sys.argv = ["umbrad", *arguments]
    return daemon.app.main()


if __name__ == "__main__":
    sys.exit(main())
