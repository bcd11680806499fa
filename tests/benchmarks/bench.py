"""A daemon of a benchmark's own: virtual devices, private sockets, ended with the benchmark."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from protocol.client import Client

START_S = 60.0


@dataclass(frozen=True)
class Running:
    """A daemon that is ready."""

    client: Client
    process: subprocess.Popen[bytes]
    endpoint: str
    data: Path
    ready_s: float  # from its start to READY=1

    def peak_bytes(self) -> int:
        """Its greatest resident memory so far."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024


@contextlib.contextmanager
def daemon(devices: str, *, time_scale: float = 1.0) -> Iterator[Running]:
    """Start umbrad with these device tables (TOML), wait for READY=1, stop it in the end."""
    with tempfile.TemporaryDirectory(prefix="umbra-bench-") as name:
        folder = Path(name)
        endpoint = f"ipc://{folder}/command"
        (folder / "rig.toml").write_text(
            f'[rig]\nname = "bench"\ndata = "{folder}/data"\ntime_scale = {time_scale}\n'
            f'[network]\ncommand = "{endpoint}"\nevents = "ipc://{folder}/events"\n{devices}'
        )
        began = time.perf_counter()
        with (
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager,
            (folder / "log").open("wb") as log,
        ):
            manager.bind(f"{folder}/notify")
            manager.settimeout(START_S)
            process = subprocess.Popen(
                [sys.executable, "-m", "daemon.app", "--config", f"{folder}/rig.toml"],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                env={**os.environ, "NOTIFY_SOCKET": f"{folder}/notify"},
            )  # fmt: skip
            try:
                while not manager.recv(4096).startswith(b"READY=1"):
                    pass
                ready_s = time.perf_counter() - began
                with Client(endpoint) as client:
                    yield Running(client, process, endpoint, folder / "data", ready_s)
            except TimeoutError:
                raise RuntimeError((folder / "log").read_text()) from None
            finally:
                process.terminate()
                process.wait(30)
