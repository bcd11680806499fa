"""A stage behind a TCP server, raw or RFC 2217, and a server that vanishes while it moves."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import serial
from serial import rfc2217

from drivers.base.device import Context
from drivers.base.errors import DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.stage import StageState
from drivers.clock import ScaledClock
from drivers.grbl import GrblOptions, GrblStage
from drivers.tmcl import TmclOptions, TmclStage
from tests.drivers.grbl_peer import GrblPeer
from tests.drivers.tmcl_peer import TmclPeer

pytestmark = [
    pytest.mark.timeout(30),
    pytest.mark.filterwarnings(r"ignore:set(Daemon|Name)\(\) is deprecated"),  # pyserial's own
]


class PtyPort(serial.Serial):  # type: ignore[misc]
    """A pty as a device server's serial port: it has none of the modem's lines."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self) -> None: ...

    def _update_rts_state(self) -> None: ...


class Server:
    """One client at a time, between a TCP port and a tty. `rfc2217`: with its negotiation."""

    def __init__(self, tty: Path, *, rfc2217: bool, port: int = 0) -> None:
        self._tty = tty
        self._rfc2217 = rfc2217
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.settimeout(0.05)
        self.port = self._listener.getsockname()[1]
        self.url = f"{'rfc2217' if rfc2217 else 'socket'}://127.0.0.1:{self.port}"
        self.swallows = False  # a cable that was cut somewhere between: no end, and no byte
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Vanish; idempotent."""
        self._stop.set()
        self._thread.join()
        self._listener.close()

    def write(self, data: bytes) -> None:
        """As PortManager wants its connection to be."""
        with contextlib.suppress(OSError):
            self._client.sendall(data)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._client, _ = self._listener.accept()
            except TimeoutError:
                continue
            with self._client, PtyPort(str(self._tty), timeout=0.005) as device:
                self._serve(device)

    def _serve(self, device: Any) -> None:
        self._client.settimeout(0.005)
        manager = rfc2217.PortManager(device, self) if self._rfc2217 else None
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                data = self._client.recv(1024)
                if not data:
                    return
                if not self.swallows:
                    device.write(b"".join(manager.filter(data)) if manager else data)
            said = device.read(256)
            if said and not self.swallows:
                self.write(b"".join(manager.escape(said)) if manager else said)


@pytest.fixture(params=[False, True], ids=["socket", "rfc2217"])
def rfc(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[GrblPeer]:
    with GrblPeer(tmp_path, speed=2.0, resets_on_open=False) as peer:
        yield peer


def make(server: Server) -> GrblStage:
    options = msgspec.convert({"port": server.url, "boot_s": 2.0, "poll_hz": 20.0}, GrblOptions)
    return GrblStage("stage", options, Context(clock=ScaledClock(2.0)))


def pump_for(stage: GrblStage, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        stage.pump()
        time.sleep(0.005)


def test_a_server_that_vanishes_in_motion_is_a_loss_and_nothing_moves_after_it(
    peer: GrblPeer, rfc: bool
) -> None:
    server = Server(peer.link, rfc2217=rfc)
    stage = make(server)
    stage.connect()
    stage.home(10.0)
    stage.circle((-10.0, -10.0), 1.5, 25.0, math.inf)
    pump_for(stage, 0.3)
    assert stage.status().state is StageState.MOVING
    stage.stop()
    assert stage.status().position_mm == pytest.approx((peer.x, peer.y), abs=0.002)
    stage.circle((-10.0, -10.0), 1.5, 25.0, math.inf)
    pump_for(stage, 0.2)
    server.close()
    with pytest.raises(DeviceLost):
        pump_for(stage, 10.0)
    assert stage.position_at(stage.clock.now_ns()) is None
    with pytest.raises(DeviceLost, match="cannot be opened"):
        stage.connect()
    back = Server(peer.link, rfc2217=rfc, port=server.port)
    stage.connect()
    assert stage.status().state is StageState.UNKNOWN
    count = len(peer.lines)
    with pytest.raises(DeviceRefused, match="home"):
        stage.circle((-10.0, -10.0), 1.5, 25.0, 1)
    assert len(peer.lines) == count
    stage.home(10.0)
    stage.close()
    back.close()


def test_a_cable_cut_between_is_silence_with_a_deadline(peer: GrblPeer) -> None:
    server = Server(peer.link, rfc2217=False)
    stage = make(server)
    stage.connect()
    stage.home(10.0)
    stage.circle((-10.0, -10.0), 1.5, 25.0, math.inf)
    pump_for(stage, 0.2)
    server.swallows = True
    with pytest.raises(DeviceTimeout, match=r"no status report within 1\.2 s"):
        pump_for(stage, 10.0)
    stage.close()
    server.close()


def test_an_eccentric_behind_a_server(tmp_path: Path, rfc: bool) -> None:
    with TmclPeer(tmp_path) as peer:
        server = Server(peer.link, rfc2217=rfc)
        options = msgspec.convert({"port": server.url, "radius_mm": 3.0}, TmclOptions)
        stage = TmclStage("stage", options, Context())
        stage.connect()
        stage.home(5.0)
        stage.circle((0.0, 0.0), 3.0, 45.0, math.inf)
        assert stage.pump().state is StageState.MOVING
        server.close()
        with pytest.raises(DeviceLost):
            stage.stop()
        assert stage.position_at(stage.clock.now_ns()) is None
        stage.close()
