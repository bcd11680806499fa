"""A DLPC350 at the end of a USB cable, byte by byte: a pyusb backend with one board behind it.

It checks the framing of every report, keeps registers and tables, refuses what it does not know,
validates times and pattern numbers as the real one says it does, and can be unplugged, plugged in
elsewhere, be slow, stall or answer nonsense. `played` is what its mirrors showed.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import usb.backend
import usb.core
from numpy.typing import NDArray

from drivers import dmd
from drivers.dlpc_hid import ANSWER, NACK, READ, REPORT

REGISTERS = {  # writable, one command word each: bytes of data
    0x0200: 1, 0x1A00: 1, 0x1A07: 1, 0x1A1A: 1, 0x1A1B: 1, 0x1A1D: 3, 0x1A1E: 2, 0x1A22: 1,
    0x1A23: 1, 0x1A24: 1, 0x1A29: 8, 0x1A31: 4, 0x1A32: 1, 0x1A33: 1, 0x1A34: 0,
}  # fmt: skip
READABLE = (set(REGISTERS) - {0x1A34, 0x1A32, 0x1A33}) | {0x0205, 0x1A0A, 0x1A0C}
STOPPED_ONLY = {0x1A1D, 0x1A1E, 0x1A22, 0x1A23, 0x1A29, 0x1A31, 0x1A34}
Image = NDArray[np.uint8]


class Board:
    """The controller: registers, tables, mirrors."""

    def __init__(self, flash: list[Image] | None = None, serial: str = "LCR-1") -> None:
        self.flash = flash or []
        self.video: Callable[[], Image] | None = None  # what comes in by HDMI now
        self.serial = serial
        self.port: tuple[int, ...] = (4, 2)
        self.registers = {command: bytes(size) for command, size in REGISTERS.items()}
        self.registers[0x0200] = b"\x01"  # it wakes up in standby, as firmware may be set
        self.hardware = 0x01
        self.patterns: list[bytes] = []
        self.images: bytes = b""
        self.busy: dict[int, int] = {}  # reads until a register is what it was told to be
        self.played: list[tuple[Image, int]] = []  # mirrors, LEDs
        self.log: list[tuple[str, int, bytes]] = []

    # -------- commands

    def handle(self, flags: int, command: int, data: bytes) -> bytes | None:
        """The answer's data; None: refused."""
        reading = bool(flags & READ)
        self.log.append(("read" if reading else "write", command, data))
        if reading:
            return self.read(command) if command in READABLE and not data else None
        size = REGISTERS.get(command)
        if size is None or (size and len(data) != size):
            return None
        playing = self.registers[0x1A24] == b"\x02"
        standby = self.registers[0x0200] == b"\x01"
        if (playing and command in STOPPED_ONLY) or (standby and command >= 0x1A1A):
            return None
        if command == 0x1A34:
            return self.fill(data)
        self.registers[command] = data
        if command in {0x0200, 0x1A1A, 0x1A1B, 0x1A24}:
            self.busy[command] = 2
        if command == 0x1A24 and data == b"\x02":
            self.play()
        return b""

    def read(self, command: int) -> bytes:
        if command == 0x0205:
            return struct.pack("<HBB", 0, 4, 4) + bytes(12)
        if command == 0x1A0A:
            return bytes((self.hardware,))
        if command == 0x1A0C:
            standby, running = self.registers[0x0200][0], self.registers[0x1A24] == b"\x02"
            return bytes((standby | running << 1,))
        busy = self.busy[command] = max(0, self.busy.get(command, 0) - 1)
        if command == 0x1A1A:
            return bytes((0x80 if busy else self.invalid(),))
        value = self.registers[command]
        return bytes(255 - b for b in value) if busy else value

    def fill(self, data: bytes) -> bytes | None:
        box = self.registers[0x1A33][0]
        if self.registers[0x1A32] != b"\0" or not data:
            return None
        if box == 1:
            # Two entries are taken the other way round.
            self.images = data[::-1] if len(data) == 2 else data
        elif box == 2 and len(data) % 3 == 0 and len(data) <= 3 * 128:
            self.patterns = [data[k : k + 3] for k in range(0, len(data), 3)]
        else:
            return None
        return b""

    # -------- patterns

    def invalid(self) -> int:
        exposure, period = struct.unpack("<II", self.registers[0x1A29])
        status = 0
        for first, second, third in self.patterns:
            number, bits = first >> 2, second & 15
            status |= (exposure < {1: 235, 8: 8333}.get(bits, 8333) or period < exposure) << 0
            status |= (number > 24 // bits - (bits > 1)) << 1
            status |= (bool(third & 2) and exposure == period and len(self.patterns) > 1
                       and (first, second, third) != tuple(self.patterns[-1])) << 2  # fmt: skip
        return int(status | (0 < period - exposure < 230) << 4)

    def play(self) -> None:
        entries, _, _, images = self.registers[0x1A31]
        assert self.registers[0x1A1B] == b"\x01", "played without pattern mode"
        assert len(self.patterns) == entries + 1
        flash = self.registers[0x1A22] == b"\x03"
        assert not flash or len(self.images) == images + 1
        assert (self.registers[0x1A23] == b"\x01") == flash
        taken = iter(self.images)
        frame = None if flash or self.video is None else self.video()
        for k, (first, second, third) in enumerate(self.patterns):
            assert first & 3 == (0 if flash else (1 if k == 0 else 3))
            if flash and third & 4:
                frame = self.flash[next(taken)]
            assert frame is not None, "nothing was loaded before the first pattern"
            number, bits, led = first >> 2, second & 15, second >> 4
            if bits == 1 and number == 24:
                shown = np.full(frame.shape[:2], 255, np.uint8)
            else:
                shown = dmd.plane(frame, number, bits)
            lit = led if self.registers[0x1A07] == b"\x08" else 0
            self.played.append((255 - shown if third & 1 else shown, lit))
        assert not flash or next(taken, None) is None, "an image was not used"

    @property
    def dark(self) -> bool:
        return self.registers[0x1A07] == b"\0" or self.registers[0x0200] == b"\x01"


class Usb(usb.backend.IBackend):  # type: ignore[misc]
    """Boards on a bus. Everything that goes over the wire passes here."""

    def __init__(self, *boards: Board) -> None:
        self.boards = list(boards)
        self.claimed: set[int] = set()
        self.driver = True  # the kernel's HID driver has it at first
        self.unplug_after = -1  # reports that are written before the cable is pulled
        self.taken = False  # by another program
        self.allowed = True
        self.mangle: Callable[[bytes], list[bytes]] = lambda answer: [answer]
        self._command = bytearray()
        self._answers: list[bytes] = []

    # -------- descriptors

    def enumerate_devices(self) -> Any:
        return iter(list(self.boards))

    def get_device_descriptor(self, dev: Board) -> Any:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=64, idVendor=0x0451, idProduct=0x6401, bcdDevice=1,
            iManufacturer=0, iProduct=0, iSerialNumber=3 if dev.serial else 0,
            bNumConfigurations=1, address=7, bus=1, port_number=dev.port[-1],
            port_numbers=dev.port, speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Board, config: int) -> Any:
        if config:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=41, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Board, intf: int, alt: int, config: int) -> Any:
        if intf or alt or config:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0,
            bNumEndpoints=2, bInterfaceClass=3, bInterfaceSubClass=0, bInterfaceProtocol=0,
            iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: Board, ep: int, intf: int, alt: int, config: int) -> Any:
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(0x81, 0x01)[ep], bmAttributes=3,
            wMaxPacketSize=64, bInterval=1, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    # -------- life

    def open_device(self, dev: Board) -> Board:
        if not self.allowed:
            raise usb.core.USBError("Access denied", -3, errno.EACCES)
        self._here(dev)
        return dev

    def close_device(self, dev_handle: Board) -> None:
        self.claimed.discard(id(dev_handle))

    def get_configuration(self, dev_handle: Board) -> int:
        return 1

    def claim_interface(self, dev_handle: Board, intf: int) -> None:
        self._here(dev_handle)
        if self.driver or self.taken:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        self.claimed.add(id(dev_handle))

    def release_interface(self, dev_handle: Board, intf: int) -> None:
        self.claimed.discard(id(dev_handle))

    def is_kernel_driver_active(self, dev_handle: Board, intf: int) -> bool:
        return self.driver

    def detach_kernel_driver(self, dev_handle: Board, intf: int) -> None:
        self.driver = False

    def ctrl_transfer(
        self, dev_handle: Board, bm: int, request: int, value: int, index: int, data: Any, t: int
    ) -> int:
        """GET_DESCRIPTOR of strings."""
        self._here(dev_handle)
        assert (bm, request, value >> 8) == (0x80, 6, 3)
        text = b"\x09\x04" if value & 255 == 0 else dev_handle.serial.encode("utf-16-le")
        answer = bytes((len(text) + 2, 3)) + text
        data[: len(answer)] = type(data)("B", answer)
        return len(answer)

    def _here(self, board: Board) -> None:
        if board not in self.boards:
            raise usb.core.USBError("No such device (it may have been disconnected)", -4,
                                    errno.ENODEV)  # fmt: skip

    # -------- the wire

    def intr_write(self, dev_handle: Board, ep: int, intf: int, data: Any, timeout: int) -> int:
        self._here(dev_handle)
        assert ep == 0x01
        assert id(dev_handle) in self.claimed, "written without a claim"
        report = bytes(data)
        assert len(report) == REPORT, "a report is 64 bytes"
        if self.unplug_after == 0:
            self.boards.remove(dev_handle)
            self._here(dev_handle)
        self.unplug_after -= 1
        self._command += report
        flags, sequence, length, command = struct.unpack_from("<BBHH", self._command)
        assert flags & ~(READ | ANSWER) == 0, "flags"
        assert flags & ANSWER, "every command wants its answer"
        if len(self._command) >= 4 + length:
            whole, self._command = bytes(self._command), bytearray()
            assert length >= 2
            assert not any(whole[4 + length :]), "padding is zeros"
            assert len(whole) - (4 + length) < REPORT, "a report too many"
            answer = dev_handle.handle(flags, command, whole[6 : 4 + length])
            kind = (flags & READ) | (NACK if answer is None else 0)
            body = struct.pack("<BBH", kind, sequence, len(answer or b"")) + (answer or b"")
            self._answers += self.mangle(body + bytes(REPORT - len(body)))
        return len(report)

    def intr_read(self, dev_handle: Board, ep: int, intf: int, buff: Any, timeout: int) -> int:
        self._here(dev_handle)
        assert ep == 0x81
        if not self._answers:
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        answer = self._answers.pop(0)
        buff[: len(answer)] = type(buff)("B", answer)
        return len(answer)
