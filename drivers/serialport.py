"""A serial line with an identity: opened by what is at its end, not by the order of enumeration.

A port is given as one of

- ``/dev/serial/by-id/usb-...`` (or any other path): followed through its link at each opening;
- ``usb:SERIAL``, ``usb:VID:PID`` or ``usb:VID:PID:SERIAL`` (hexadecimal ids): found by enumeration;
- ``socket://host:port``, ``rfc2217://host:port``: a networked port.

The USB identity found at the first opening is kept: when the device comes back under another
ttyUSBn, the next opening finds it there, and a different device under the old name is refused.
A tty is opened exclusively. Nothing here is sent twice: whoever speaks the protocol knows what may.
"""

from __future__ import annotations

import errno
import os
import threading
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports

from drivers.base.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.clock import Clock

POLL_S = 0.1  # how soon a reader notices that it was closed
WRITE_S = 0.5  # the line takes 5 kB in this time at 115200 baud: longer means that nobody reads
BY_ID = Path("/dev/serial/by-id")
BY_SOCKET = Path("/dev/umbra")  # where systemd/udev/71-umbra.rules puts links
LONGEST_LINE = 1024  # bytes; more without a line end is noise


@dataclass(frozen=True, slots=True)
class UsbIdentity:
    """What USB says of a port. Adapters without a serial number are told apart by their socket."""

    vid: int
    pid: int
    serial: str = ""
    location: str = ""

    def same(self, other: UsbIdentity) -> bool:
        """Whether both are the same adapter."""
        if (self.vid, self.pid) != (other.vid, other.pid):
            return False
        if self.serial or other.serial:
            return self.serial == other.serial
        return self.location == other.location


def usb_ports() -> dict[str, UsbIdentity]:
    """Device path -> identity, of every USB serial port that is attached now."""
    return {
        str(p.device): UsbIdentity(p.vid, p.pid or 0, p.serial_number or "", p.location or "")
        for p in list_ports.comports()
        if p.vid is not None
    }


def attached(chips: Collection[tuple[int, int | None]]) -> list[dict[str, Any]]:
    """The USB serial ports whose (vendor, product) is among `chips` (product None: any), as
    `Device.discover` gives them. Nothing is opened: opening resets many a board."""
    found = []
    for port in sorted(list_ports.comports()):
        if port.vid is None or not {(port.vid, port.pid), (port.vid, None)} & set(chips):
            continue
        serial_number = port.serial_number or ""
        found.append(
            {
                "model": port.product or port.description or f"{port.vid:04x}:{port.pid:04x}",
                "serial": serial_number,
                "options": {"port": _stable_name(str(port.device), port, serial_number)},
            }
        )
    return found


def _stable_name(path: str, port: Any, serial_number: str) -> str:
    """A name that stays: by-id needs a serial number, else two boards of a kind share one."""
    for folder in [BY_ID] if serial_number else [BY_SOCKET]:
        for link in sorted(folder.glob("*")):
            if os.path.realpath(link) == os.path.realpath(path):
                return str(link)
    usb = f"usb:{port.vid:04x}:{port.pid:04x}"
    return f"{usb}:{serial_number}" if serial_number else usb


class SerialPort:
    """One serial line. `read` from one thread, `write` from another, `urge` from any."""

    def __init__(self, device: str, spec: str, baud: int) -> None:
        self.device = device
        self.spec = spec
        self.baud = baud
        self.identity: UsbIdentity | None = None  # of a USB adapter, once it was seen
        self.path = ""  # where it is open now
        self._serial: Any = None

    @property
    def is_open(self) -> bool:
        """Whether it was opened, and not closed since."""
        return self._serial is not None

    def open(self) -> None:
        """Open the port; raises DeviceLost where there is none, DeviceRefused where it is taken.

        Safe to try again, at any pace.
        """
        self.close()
        path = self._find()
        try:
            port = serial.serial_for_url(path, baudrate=self.baud, do_not_open=True)
            port.timeout = POLL_S
            if "://" not in path:
                port.exclusive = True
                port.write_timeout = WRITE_S
            port.open()
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise self._failed_to_open(path, error) from error
        self._serial, self.path = port, path
        if "://" not in path:
            self.identity = usb_ports().get(os.path.realpath(path), self.identity)

    def _find(self) -> str:
        spec = self.spec
        if "://" in spec:
            return spec
        attached = usb_ports()
        if spec.startswith("usb:"):
            return self._match_usb(attached)
        here = attached.get(os.path.realpath(spec))
        known = self.identity
        if Path(spec).exists() and (known is None or here is None or here.same(known)):
            return spec
        if known is not None:
            for path, identity in attached.items():
                if identity.same(known):
                    return path
        raise DeviceLost(self.device, "open", f"there is no {spec}", self._what_is_there(attached))

    def _match_usb(self, attached: dict[str, UsbIdentity]) -> str:
        parts = self.spec.removeprefix("usb:").split(":", 2)
        try:
            vid, pid = (int(parts[0], 16), int(parts[1], 16)) if len(parts) > 1 else (None, None)
        except ValueError:
            raise DeviceRefused(
                self.device, "open", f"{self.spec!r} is not usb:SERIAL, usb:VID:PID[:SERIAL]"
            ) from None
        wanted = parts[-1] if len(parts) != 2 else ""
        found = [
            path
            for path, it in attached.items()
            if (vid is None or (it.vid, it.pid) == (vid, pid))
            and (not wanted or it.serial == wanted)
            and (self.identity is None or it.same(self.identity))
        ]
        if not found:
            raise DeviceLost(
                self.device,
                "open",
                f"no port matches {self.spec}",
                self._what_is_there(attached),
            )
        if len(found) > 1:
            raise DeviceRefused(
                self.device,
                "open",
                f"{self.spec} matches {', '.join(sorted(found))}",
                "name one by its serial number, or by its path in /dev/serial/by-id",
            )
        return found[0]

    @staticmethod
    def _what_is_there(attached: dict[str, UsbIdentity]) -> str:
        seen = ", ".join(
            f"{path} (usb:{it.vid:04x}:{it.pid:04x}{':' + it.serial if it.serial else ''})"
            for path, it in sorted(attached.items())
        )
        return f"check cable and power; attached now: {seen or 'no USB serial port'}"

    def _failed_to_open(self, path: str, error: Exception) -> DeviceError:
        number = getattr(error, "errno", None)
        if number == errno.EACCES:
            return DeviceRefused(
                self.device,
                "open",
                f"no permission for {path}",
                "add the daemon's user to the group that owns it (dialout), or install the udev"
                " rules",
            )
        if number in {errno.EBUSY, errno.EAGAIN} or "exclusively lock" in str(error):
            return DeviceRefused(
                self.device, "open", f"{path} is in use by another program", "close that program"
            )
        return DeviceLost(
            self.device, "open", f"{path} cannot be opened ({error})", "check cable and power"
        )

    def read(self) -> bytes:
        """What has come, waiting at most `POLL_S` for a first byte; b"" if nothing. DeviceLost."""
        port = self._serial
        if port is None:
            raise DeviceLost(self.device, "read", "the port is closed")
        try:
            first = bytes(port.read(1))
            return first + bytes(port.read(port.in_waiting)) if first else b""
        except (OSError, TypeError, ValueError) as error:
            # pyserial shows a port that was closed or pulled under a read as any of these
            why = "it hung up" if "returned no data" in str(error) else error
            raise DeviceLost(
                self.device, "read", f"the line is dead ({why})", "check cable and power"
            ) from error

    def write(self, data: bytes) -> None:
        """Send it all. After DeviceTimeout a part of it may have gone out; DeviceLost."""
        port = self._serial
        if port is None:
            raise DeviceLost(self.device, "write", "the port is closed")
        try:
            port.write(data)
        except serial.SerialTimeoutException as error:
            raise DeviceTimeout(
                self.device, "write", f"the line took no data for {WRITE_S} s", "check the cable"
            ) from error
        except (OSError, TypeError, ValueError) as error:
            raise DeviceLost(
                self.device, "write", f"the line is dead ({error})", "check cable and power"
            ) from error

    def urge(self, data: bytes) -> bool:
        """`write` for whoever cannot wait or fail: False if it did not go out."""
        try:
            self.write(data)
        except DeviceError:
            return False
        return True

    def cancel_read(self) -> None:
        """From any thread: end a `read` under way, where the port can."""
        cancel = getattr(self._serial, "cancel_read", None)
        if cancel is not None:
            cancel()

    def close(self) -> None:
        """Let go of the port; idempotent, does not raise for one that is gone."""
        port, self._serial, self.path = self._serial, None, ""
        if port is None:
            return
        # pyserial leaves the socket of a connection that was reset open: its shutdown fails first
        connection = getattr(port, "_socket", None)
        try:
            port.close()
        except OSError:
            pass  # it is gone: there is nothing left to let go of
        finally:
            if connection is not None:
                connection.close()


class LineReader:
    """A thread that turns what comes into lines with the time of their first byte.

    `arrived` is set at each line and at the end. Bytes that are not ASCII become U+FFFD: noise
    makes strange lines, never an exception. After `error` is set nothing more comes.
    """

    def __init__(self, port: SerialPort, clock: Clock, arrived: threading.Event) -> None:
        self.error: DeviceError | None = None
        self._port = port
        self._clock = clock
        self._arrived = arrived
        self._lines: deque[tuple[int, str]] = deque(maxlen=8192)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{port.device}-rx", daemon=True)
        self._thread.start()

    def take(self) -> tuple[int, str] | None:
        """The oldest line that nobody has taken, and when its first byte came."""
        try:
            return self._lines.popleft()
        except IndexError:
            return None

    def close(self) -> None:
        """End the thread; the port's owner closes the port afterwards."""
        self._closing.set()
        self._port.cancel_read()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=5 * POLL_S)

    def _run(self) -> None:
        rest, began_ns = b"", 0
        while not self._closing.is_set():
            try:
                data = self._port.read()
            except DeviceError as error:
                self.error = error
                break
            if not data:
                continue
            now_ns = self._clock.now_ns()
            if not rest:
                began_ns = now_ns
            *ended, rest = (rest + data).replace(b"\r", b"\n").split(b"\n")
            if len(rest) > LONGEST_LINE:
                ended, rest = [*ended, rest], b""
            for line in ended:
                if line:
                    self._lines.append((began_ns, line.decode("ascii", "replace").strip()))
                began_ns = now_ns
            if ended:
                self._arrived.set()
        self._arrived.set()
