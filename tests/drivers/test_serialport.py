"""Serial ports are found by what is at their end, held exclusively, and lost by name."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial
from serial import rfc2217
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers import serialport
from drivers.base.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.clock import RealClock
from drivers.grbl import GrblStage
from drivers.serialport import LONGEST_LINE, LineReader, SerialPort
from drivers.tmcl import TmclStage


class Pty:
    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave

    def unplug(self) -> None:
        for end in (self._slave, self.master):
            if end >= 0:
                os.close(end)
        self._slave = self.master = -1


@pytest.fixture
def ptys() -> Iterator[list[Pty]]:
    made = [Pty() for _ in range(3)]
    yield made
    for each in made:
        each.unplug()


class Bus:
    """What USB enumeration shows."""

    def __init__(self) -> None:
        self.ports: list[SimpleNamespace] = []

    def attach(self, device: str, serial: str | None, location: str = "1-1") -> None:
        self.ports.append(
            SimpleNamespace(
                device=device, vid=0x2341, pid=0x0043, serial_number=serial, location=location
            )
        )


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    bus = Bus()
    monkeypatch.setattr(list_ports, "comports", lambda: bus.ports)
    return bus


def read_some(port: SerialPort) -> bytes:
    while True:
        if data := port.read():
            return data


def read_exactly(port: SerialPort, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += port.read()
    return data


def test_bytes_go_both_ways_over_a_pty_which_has_no_dtr(ptys: list[Pty]) -> None:
    port = SerialPort("stage", ptys[0].path, 115200)
    port.open()
    port.write(b"$I\n")
    assert os.read(ptys[0].master, 10) == b"$I\n"
    os.write(ptys[0].master, b"ok\r\n")
    assert read_exactly(port, 4) == b"ok\r\n"
    port.close()
    port.close()
    with pytest.raises(DeviceLost, match="closed"):
        port.read()
    with pytest.raises(DeviceLost, match="closed"):
        port.write(b"?")
    assert not port.urge(b"!")


def test_it_is_held_exclusively(ptys: list[Pty]) -> None:
    first, second = (SerialPort("stage", ptys[0].path, 115200) for _ in range(2))
    first.open()
    with pytest.raises(DeviceRefused, match="in use by another program"):
        second.open()
    first.close()
    second.open()
    second.close()


def test_a_hang_up_is_a_loss(ptys: list[Pty]) -> None:
    port = SerialPort("stage", ptys[0].path, 115200)
    port.open()
    ptys[0].unplug()
    with pytest.raises(DeviceLost, match="dead"):
        read_some(port)
    port.close()
    with pytest.raises(DeviceLost, match="check cable and power"):
        port.open()


def test_a_link_is_followed_to_another_name(ptys: list[Pty], tmp_path: Path) -> None:
    link = tmp_path / "usb-Arduino_85430353531351B09121-if00"
    link.symlink_to(ptys[0].path)
    port = SerialPort("stage", str(link), 115200)
    port.open()
    port.close()
    link.unlink()
    with pytest.raises(DeviceLost, match="there is no"):
        port.open()
    link.symlink_to(ptys[1].path)
    port.open()
    port.write(b"?")
    assert os.read(ptys[1].master, 10) == b"?"
    port.close()


@pytest.mark.parametrize("spec", ["usb:A1", "usb:2341:0043:A1"])
def test_found_by_usb_identity(ptys: list[Pty], bus: Bus, spec: str) -> None:
    bus.attach(ptys[1].path, "B2")
    bus.attach(ptys[0].path, "A1")
    port = SerialPort("stage", spec, 115200)
    port.open()
    assert port.path == ptys[0].path
    assert port.identity is not None
    assert port.identity.serial == "A1"
    port.close()


def test_usb_identity_that_is_absent_ambiguous_or_malformed(ptys: list[Pty], bus: Bus) -> None:
    with pytest.raises(DeviceLost, match="no USB serial port"):
        SerialPort("stage", "usb:A1", 115200).open()
    bus.attach(ptys[0].path, None, "1-1")
    bus.attach(ptys[1].path, None, "1-2")
    with pytest.raises(DeviceRefused, match="by-id"):
        SerialPort("stage", "usb:2341:0043", 115200).open()
    with pytest.raises(DeviceLost, match=r"usb:2341:0043"):
        SerialPort("stage", "usb:9999:0043", 115200).open()
    with pytest.raises(DeviceRefused, match="is not usb:SERIAL"):
        SerialPort("stage", "usb:serial:number", 115200).open()


@pytest.mark.parametrize("serial", ["A1", None])
def test_back_under_another_number_it_is_found_again(
    ptys: list[Pty], bus: Bus, serial: str | None
) -> None:
    bus.attach(ptys[0].path, serial, "1-4")
    port = SerialPort("stage", ptys[0].path, 115200)
    port.open()
    port.close()
    bus.ports.clear()
    bus.attach(ptys[0].path, "other" if serial else None, "1-2")  # another has taken its name
    with pytest.raises(DeviceLost, match="there is no"):
        port.open()
    bus.attach(ptys[2].path, serial, "1-4")
    port.open()
    assert port.path == ptys[2].path
    port.close()


def test_a_networked_port() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = SerialPort("stage", f"socket://127.0.0.1:{server.getsockname()[1]}", 115200)
        port.open()
        peer, _ = server.accept()
        with peer:
            port.write(b"?")
            assert peer.recv(10) == b"?"
            peer.sendall(b"<Idle>\n")
            assert read_exactly(port, 7) == b"<Idle>\n"
        with pytest.raises(DeviceLost):
            read_some(port)
        port.close()
    with pytest.raises(DeviceLost, match="cannot be opened"):
        port.open()
    with pytest.raises(DeviceError, match="nonsense"):
        SerialPort("stage", "nonsense://x", 115200).open()


class Rfc2217Server:
    """A serial device server in front of a port whose ends are joined (a pty has no DTR to set)."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self._server.getsockname()[1]}"
        self._device = serial.serial_for_url("loop://", timeout=0.02)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """As PortManager wants its connection to be."""
        self._client.sendall(data)

    def _run(self) -> None:
        self._client, _ = self._server.accept()
        self._client.settimeout(0.02)
        manager = rfc2217.PortManager(self._device, self)
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                self._device.write(b"".join(manager.filter(self._client.recv(1024))))
            self.write(b"".join(manager.escape(self._device.read(64))))
        self._client.close()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._device.close()
        self._server.close()


@pytest.mark.filterwarnings(r"ignore:set(Daemon|Name)\(\) is deprecated")  # pyserial's own
def test_a_networked_port_that_passes_the_baud_rate_on() -> None:
    server = Rfc2217Server()
    port = SerialPort("stage", server.url, 57600)
    port.open()
    assert server._device.baudrate == 57600
    port.write(b"<Idle>\xff\n")
    assert read_exactly(port, 8) == b"<Idle>\xff\n"
    server.close()
    with pytest.raises(DeviceLost):
        while_open(port)
    port.close()


def while_open(port: SerialPort) -> None:
    while True:
        port.read()


class Asked(RealClock):
    """A clock that tells when somebody asked it."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = threading.Event()

    def now_ns(self) -> int:
        now = super().now_ns()
        self.asked.set()
        return now


def test_lines_carry_the_time_of_their_first_byte(ptys: list[Pty]) -> None:
    port, clock, arrived = SerialPort("stage", ptys[0].path, 115200), Asked(), threading.Event()
    port.open()
    reader = LineReader(port, clock, arrived)
    before = clock.now_ns()
    clock.asked.clear()
    os.write(ptys[0].master, b"<Id")
    assert clock.asked.wait(60)  # the reader has it
    between = clock.now_ns()
    os.write(ptys[0].master, b"le>\r\n\xff\xfe\r\nok\n" + b"x" * (LONGEST_LINE + 10))
    lines: list[tuple[int, str]] = []
    while len(lines) < 4:
        arrived.wait(60)
        arrived.clear()
        while (item := reader.take()) is not None:
            lines.append(item)
        if len(lines) == 3:
            os.write(ptys[0].master, b"x")  # still no line end: noise, cut off
    assert [text for _, text in lines[:3]] == ["<Idle>", "��", "ok"]
    assert before < lines[0][0] < between < lines[1][0]
    assert set(lines[3][1]) == {"x"}
    ptys[0].unplug()
    arrived.wait(60)
    while reader.error is None:
        time.sleep(0.01)
    assert isinstance(reader.error, DeviceLost)
    reader.close()
    port.close()


def test_attached_boards_have_names_that_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def port(device: str, vid: int | None, pid: int, number: str | None) -> Any:
        info = ListPortInfo(device)
        info.vid, info.pid, info.serial_number, info.product = vid, pid, number, "a board"
        return info

    nodes = {name: tmp_path / name for name in ("ttyUSB0", "ttyUSB1", "ttyACM0", "ttyS0")}
    for node in nodes.values():
        node.touch()
    by_id, by_socket = tmp_path / "by-id", tmp_path / "umbra"
    for folder in (by_id, by_socket):
        folder.mkdir()
    (by_id / "usb-FTDI_A50285BI").symlink_to(nodes["ttyUSB0"])
    (by_id / "usb-1a86_USB_Serial").symlink_to(nodes["ttyUSB1"])  # shared by all of its kind
    (by_socket / "serial-at-2").symlink_to(nodes["ttyUSB1"])
    monkeypatch.setattr(serialport, "BY_ID", by_id)
    monkeypatch.setattr(serialport, "BY_SOCKET", by_socket)
    monkeypatch.setattr(
        list_ports,
        "comports",
        lambda: [
            port(str(nodes["ttyUSB0"]), 0x0403, 0x6001, "A50285BI"),
            port(str(nodes["ttyUSB1"]), 0x1A86, 0x7523, None),
            port(str(nodes["ttyACM0"]), 0x2A3C, 0x0100, "T1"),
            port(str(nodes["ttyS0"]), None, 0, None),
        ],
    )
    assert [d["options"]["port"] for d in GrblStage.discover()] == [
        str(by_id / "usb-FTDI_A50285BI"),
        str(by_socket / "serial-at-2"),
    ]
    assert [(d["serial"], d["options"]["port"]) for d in TmclStage.discover()] == [
        ("T1", "usb:2a3c:0100:T1")
    ]
