"""Start-up: `umbra status` and `umbrad` until it is ready, against Python with what they need."""

from __future__ import annotations

import statistics
import subprocess
import sys

from tests.benchmarks.bench import daemon
from tests.benchmarks.pace import DEVICES
from tests.benchmarks.ratio import Ratio, in_turn

ROUNDS = 7
DAEMON_ROUNDS = 3
UMBRA = "from protocol.cli import main; main()"  # what the console script runs


def run() -> list[Ratio]:
    """Seconds over those of an interpreter that imports the libraries and does nothing."""
    ready = []
    for _ in range(DAEMON_ROUNDS):
        with daemon(DEVICES) as rig:
            ready.append(rig.ready_s)
            if len(ready) == DAEMON_ROUNDS:
                bare, client, science, status = in_turn(
                    [
                        lambda: _python("pass"),
                        lambda: _python("import zmq, msgspec, typer"),
                        lambda: _python("import zmq.asyncio, msgspec, numpy, cv2, structlog"),
                        lambda: _status(rig.endpoint),
                    ],
                    ROUNDS,
                )
    umbrad = statistics.median(ready)
    facts = {
        "python_ms": bare * 1e3,
        "client_libraries_ms": client * 1e3,
        "daemon_libraries_ms": science * 1e3,
        "umbra_status_ms": status * 1e3,
        "umbrad_ready_ms": umbrad * 1e3,
    }
    return [
        Ratio(
            name="start-up of umbra status",
            value=status / client,
            of="the command over Python importing zmq, msgspec, typer",
            facts=facts,
        ),
        Ratio(
            name="start-up of umbrad",
            value=umbrad / science,
            of="until READY=1, virtual scene built, over Python importing zmq, NumPy, OpenCV",
            facts=facts,
        ),
    ]


def _python(code: str) -> None:
    subprocess.run([sys.executable, "-c", code], check=True, stdin=subprocess.DEVNULL)


def _status(endpoint: str) -> None:
    subprocess.run(
        [sys.executable, "-c", UMBRA, "--rig", endpoint, "status"],
        check=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
