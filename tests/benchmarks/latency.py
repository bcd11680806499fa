"""How long a command takes while a scan runs, against a bare pyzmq echo beside the same scan."""

from __future__ import annotations

import json
import secrets
import subprocess
import sys
import tempfile
import time

import zmq

from protocol.messages.envelopes import PROTOCOL
from tests.benchmarks.bench import daemon
from tests.benchmarks.pace import DEVICES, scan
from tests.benchmarks.ratio import Ratio, percentile

ROUNDS = 1000
PAUSE_S = 0.005  # between two questions: a client that asks all the time is another load
EXPOSURE_S = 12e-3  # one pattern a refresh

ECHO = """
import sys, zmq
socket = zmq.Context().socket(zmq.ROUTER)
socket.bind(sys.argv[1])
while True:
    socket.send_multipart(socket.recv_multipart())
"""


def run() -> list[Ratio]:
    """The 99th percentile of `hello` over that of the echo; the medians for comparison."""
    with tempfile.TemporaryDirectory(prefix="umbra-bench-") as folder, daemon(DEVICES) as rig:
        address = f"ipc://{folder}/echo"
        echo = subprocess.Popen([sys.executable, "-c", ECHO, address])
        context = zmq.Context()
        try:
            running = rig.client.scan(scan(EXPOSURE_S, average=100))
            lines = [_line(context, address), _line(context, rig.endpoint)]
            times: list[list[float]] = [[], []]
            for number in range(ROUNDS + 10):
                for line, taken in zip(lines, times, strict=True):
                    seconds = _ask(line)
                    if number >= 10:
                        taken.append(seconds)
                time.sleep(PAUSE_S)
            progress = rig.client.status().progress
            rig.client.abort(running.id)
        finally:
            context.destroy(linger=0)
            echo.kill()
            echo.wait()
    if progress is None:
        raise RuntimeError("the scan was over before the measurement ended")
    bare, umbra = times
    p99 = [percentile(bare, 0.99), percentile(umbra, 0.99)]
    return [
        Ratio(
            name="command latency during a scan, p99",
            value=p99[1] / p99[0],
            of="`hello` over a bare pyzmq echo",
            at_most=2.0,
            facts={
                "echo_p99_ms": p99[0] * 1e3,
                "umbra_p99_ms": p99[1] * 1e3,
                "echo_median_ms": percentile(bare, 0.5) * 1e3,
                "umbra_median_ms": percentile(umbra, 0.5) * 1e3,
                "frames_meanwhile": float(progress.recorded),
            },
        )
    ]


def _line(context: zmq.Context[zmq.Socket[bytes]], address: str) -> zmq.Socket[bytes]:
    socket = context.socket(zmq.DEALER)
    socket.rcvtimeo = 10_000
    socket.connect(address)
    return socket


def _ask(socket: zmq.Socket[bytes]) -> float:
    question = json.dumps(
        {"id": secrets.token_hex(8), "protocol": PROTOCOL, "command": {"type": "hello"}}
    ).encode()
    began = time.perf_counter()
    socket.send(question)
    socket.recv_multipart()
    return time.perf_counter() - began
