"""Real daemons, on the virtual rig, in folders of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import umbra
from protocol.errors import UmbraError
from protocol.messages.runs import RunState
from tests.system import warm

READY_S = 60.0
ANSWER_S = 30.0
SLOW, FAST = 0.25, 20.0
"""Time scales: for a run that must go on until something happens to it, however late that comes on
a busy machine; and for one whose end is waited for."""

ENDLESS = umbra.Checkerboard(average=500)

FAST_RIG = """
[rig]
name = "bench"
data = "{data}"
time_scale = {scale}
[network]
command = "ipc://{folder}/c"
events = "ipc://{folder}/e"
[storage]
reserve_mb = 1
[projector]
driver = "virtual"
width = 128
height = 96
{projector}
[camera]
driver = "virtual"
width = 160
height = 120
{camera}
{more}
"""


class Daemon:
    """One `umbrad` process after the other, with one configuration and one data folder.

    It starts warm (see tests.system.warm) unless it is `cold`: a new interpreter.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.data = folder / "data"
        self.endpoint = f"ipc://{folder}/c"
        self.config = folder / "rig.toml"
        self.process: subprocess.Popen[bytes] | warm.Process | None = None
        self.cold = False

    def configure(
        self, *, camera: str = "", projector: str = "", more: str = "", scale: float = 4
    ) -> None:
        self.config.write_text(
            FAST_RIG.format(
                data=self.data,
                folder=self.folder,
                camera=camera,
                projector=projector,
                more=more,
                scale=scale,
            )
        )

    def start(self, *options: str) -> umbra.Client:
        """Start it, and come back with a client when it answers."""
        self.launch(*options)
        return self.connect()

    def launch(self, *options: str) -> subprocess.Popen[bytes] | warm.Process:
        if self.cold:
            return self.launch_cold(*options)
        with (self.folder / "log").open("ab") as log:
            self.process = warm.Process(
                ["--config", str(self.config), *options],
                stderr=log.fileno(),
                environment=_environment(),
            )
        return self.process

    def launch_cold(
        self, *options: str, stdin: int = subprocess.DEVNULL
    ) -> subprocess.Popen[bytes]:
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "daemon.app", "--config", str(self.config), *options],
                stdin=stdin,
                stderr=log,
                env=_environment(),
            )
        return self.process

    def connect(self, endpoint: str = "", **options: object) -> umbra.Client:
        deadline = time.monotonic() + READY_S
        while True:
            assert self.process is not None
            assert self.process.poll() is None, self.log()
            try:  # a short patience with a daemon that starts, a long one with a loaded machine
                rig = umbra.connect(endpoint or self.endpoint, timeout_s=1.0, **options)  # type: ignore[arg-type]
            except UmbraError:
                assert time.monotonic() < deadline, self.log()
            else:
                rig.timeout_s = ANSWER_S
                return rig

    def log(self) -> str:
        return (self.folder / "log").read_text()

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait(60)

    def stop(self) -> int:
        assert self.process is not None
        self.process.terminate()
        return self.process.wait(60)

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.kill()


def _environment() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k != "NOTIFY_SOCKET"}


def until(true: Callable[[], bool], seconds: float = 90.0) -> None:
    """Ask again and again until something is true, and leave the daemon time to come to it."""
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, "it did not come true in time"
        time.sleep(0.01)


def recorded(rig: umbra.Client, run: str, frames: int) -> None:
    """Wait until a run has so many frames."""

    def enough() -> bool:
        progress = rig.status().progress
        assert progress is not None or rig.run(run).refresh().state is not RunState.FAILED
        return progress is not None and progress.recorded >= frames

    until(enough)
