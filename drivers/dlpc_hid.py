"""The wire of TI's DLPC controllers: messages in 64-byte HID reports, over pyusb.

    byte    0      1          2, 3              4, 5        6 ...
            flags  sequence   length (LE)       command     data
            0x80 read, 0x40 answer wanted; length counts the command and the data

A message longer than a report goes on in the next one, without a header. The answer repeats the
sequence number; it has 0x20 in its flags where the controller refused, and its data begin at
byte 4. The DLPC350 and the DLPC900 speak it alike; what they understand differs.

Retry policy: nothing is sent twice here. After DeviceTimeout the controller may have acted; the
late answer is recognised by its sequence number and dropped. After DeviceLost, `open` again.
"""

from __future__ import annotations

import contextlib
import errno
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import usb.core
import usb.util

from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout

REPORT = 64  # bytes
HEADER = 4
READ, ANSWER, NACK = 0x80, 0x40, 0x20
TIMEOUT_MS = 1000
STALE = 8  # answers to given-up commands that are dropped before the line is called garbled
HID_CLASS = 3


@dataclass(frozen=True, slots=True)
class Product:
    """A controller board as USB knows it."""

    name: str
    vendor: int
    product: int


@dataclass(frozen=True, slots=True)
class Place:
    """Which one it is: boards of one batch may share a serial number, or have none."""

    serial: str
    port: str  # bus and hub ports, as in "1-4.2"


def attached(product: Product, backend: Any = None) -> list[tuple[Any, Place]]:
    """The boards that are there now. Raises usb.core.USBError, usb.core.NoBackendError."""
    found = usb.core.find(
        find_all=True, backend=backend, idVendor=product.vendor, idProduct=product.product
    )
    return [(device, Place(_serial(device), _port(device))) for device in found]


def _serial(device: Any) -> str:
    try:
        return str(device.serial_number or "")
    except (usb.core.USBError, ValueError):  # no permission to ask, or no strings at all
        return ""


def _port(device: Any) -> str:
    ports = ".".join(str(number) for number in device.port_numbers or ())
    return f"{device.bus}-{ports}" if ports else f"{device.bus}"


def message(flags: int, sequence: int, command: int, data: bytes) -> list[bytes]:
    """A command as the reports that carry it, padded with zeros."""
    whole = struct.pack("<BBHH", flags, sequence, 2 + len(data), command) + data
    whole += bytes(-len(whole) % REPORT)
    return [whole[k : k + REPORT] for k in range(0, len(whole), REPORT)]


class DlpcHid:
    """One controller; for one thread."""

    def __init__(self, device: str, product: Product, serial: str, port: str, backend: Any) -> None:
        self.device = device
        self.product = product
        self.place: Place | None = None  # once it was seen: it must be the same one again
        self._serial = serial
        self._port = port
        self._backend = backend
        self._usb: Any = None
        self._in: Any = None
        self._out: Any = None
        self._sequence = 0

    # ------------------------------------------------------------ life

    def open(self) -> Place:
        """Claim the board that was named, or the only one. Raises DeviceLost, DeviceRefused."""
        self.close()
        with self._errors("connect"):
            device, place = self._choose(attached(self.product, self._backend))
            self._claim(device)
        self.place = place
        return place

    def _choose(self, found: list[tuple[Any, Place]]) -> tuple[Any, Place]:
        fitting = [
            (device, place)
            for device, place in found
            if self._serial in {"", place.serial}
            and self._port in {"", place.port}
            and self._is_known(place)
        ]
        if len(fitting) == 1:
            return fitting[0]
        there = ", ".join(f"serial {p.serial or 'none'} at port {p.port}" for _, p in found)
        if not fitting:
            raise DeviceLost(
                self.device,
                "connect",
                f"no {self.product.name}{' like the one before' if self.place else ''}",
                f"there are: {there}" if found else "check its power and its USB cable",
            )
        raise DeviceRefused(
            self.device,
            "connect",
            f"there are {len(fitting)} of them: {there}",
            "name one by serial or port in rig.toml",
        )

    def _is_known(self, place: Place) -> bool:
        if self.place is None:
            return True
        if self.place.serial:
            return place.serial == self.place.serial
        return place.port == self.place.port

    def _claim(self, device: Any) -> None:
        try:
            configuration = device.get_active_configuration()
        except usb.core.USBError:
            device.set_configuration()
            configuration = device.get_active_configuration()
        for interface in configuration:
            ends = {
                direction: usb.util.find_descriptor(
                    interface,
                    custom_match=lambda e, d=direction: (
                        usb.util.endpoint_direction(e.bEndpointAddress) == d
                        and usb.util.endpoint_type(e.bmAttributes) == usb.util.ENDPOINT_TYPE_INTR
                    ),
                )
                for direction in (usb.util.ENDPOINT_IN, usb.util.ENDPOINT_OUT)
            }
            if interface.bInterfaceClass == HID_CLASS and all(ends.values()):
                break
        else:
            raise DeviceGarbled(
                self.device, "connect", "it has no HID endpoints", "is it in its bootloader?"
            )
        number = interface.bInterfaceNumber
        with contextlib.suppress(NotImplementedError):  # not every system has kernel drivers
            if device.is_kernel_driver_active(number):
                device.detach_kernel_driver(number)
        usb.util.claim_interface(device, number)
        self._usb = device
        self._in, self._out = ends[usb.util.ENDPOINT_IN], ends[usb.util.ENDPOINT_OUT]

    def close(self) -> None:
        """Let go of it; idempotent, and silent about one that is gone."""
        device, self._usb = self._usb, None
        if device is not None:
            with contextlib.suppress(usb.core.USBError):
                usb.util.dispose_resources(device)

    # ------------------------------------------------------------ talk

    def read(self, command: int, phase: str, parameters: bytes = b"") -> bytes:
        """What a command answers. Raises DeviceError."""
        return self._exchange(READ | ANSWER, command, parameters, phase)

    def write(self, command: int, phase: str, data: bytes) -> None:
        """Send a command and wait until it is taken. Raises DeviceError."""
        self._exchange(ANSWER, command, data, phase)

    def _exchange(self, flags: int, command: int, data: bytes, phase: str) -> bytes:
        if self._usb is None:
            raise DeviceLost(
                self.device,
                phase,
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        self._sequence = (self._sequence + 1) % 256
        with self._errors(phase):
            for report in message(flags, self._sequence, command, data):
                self._out.write(report, TIMEOUT_MS)
            return self._answer(command, phase)

    def _answer(self, command: int, phase: str) -> bytes:
        for _ in range(STALE + 1):
            report = bytes(self._in.read(REPORT, TIMEOUT_MS))
            if len(report) < HEADER:
                break
            flags, sequence, length = struct.unpack_from("<BBH", report)
            if sequence != self._sequence:
                continue
            if flags & NACK:
                raise DeviceRefused(
                    self.device,
                    phase,
                    f"the controller refused command {command:04X}",
                    "it does not know it, or not in its present mode; check its firmware's version",
                )
            while len(report) < HEADER + length:
                more = bytes(self._in.read(REPORT, TIMEOUT_MS))
                if not more:
                    break
                report += more
            if len(report) < HEADER + length:
                break
            return report[HEADER : HEADER + length]
        raise DeviceGarbled(
            self.device,
            phase,
            f"the answer to command {command:04X} makes no sense",
            "connect again; another program may be talking to it",
        )

    @contextlib.contextmanager
    def _errors(self, phase: str) -> Iterator[None]:
        """pyusb's exceptions as DeviceErrors."""
        name = self.product.name
        try:
            yield
        except usb.core.NoBackendError as error:
            raise DeviceRefused(
                self.device, phase, "libusb is not installed", "apt install libusb-1.0-0"
            ) from error
        except usb.core.USBTimeoutError as error:
            raise DeviceTimeout(
                self.device, phase, f"no answer within {TIMEOUT_MS} ms", f"is the {name} busy?"
            ) from error
        except usb.core.USBError as error:
            if error.errno == errno.EACCES:
                raise DeviceRefused(
                    self.device,
                    phase,
                    f"no permission to use the {name}",
                    "install systemd/udev/71-umbra.rules and plug it in again",
                ) from error
            if error.errno == errno.EBUSY:
                raise DeviceRefused(
                    self.device, phase, f"another program has the {name}", "close TI's GUI"
                ) from error
            self.close()
            raise DeviceLost(
                self.device, phase, f"USB: {error.strerror or error}", "check cable and power"
            ) from error
