"""A V4L2 device node: its formats, controls and buffers, by the kernel's ioctls and nothing else.

Every method raises OSError as the kernel gave it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
import select
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from linuxpy.video import raw
from numpy.typing import NDArray

CAPTURE = raw.BufType.VIDEO_CAPTURE.value
MMAP = raw.Memory.MMAP.value
NONE = (errno.EINVAL, errno.ENOTTY)  # what a driver says to what it does not have

Rectangle = tuple[int, int, int, int]  # x, y, width, height


class Kernel:
    """The system calls that the driver makes; tests put a camera in their place."""

    def open(self, path: str) -> int:
        """Open a device node."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def ioctl(self, fd: int, request: raw.IOC, argument: Any) -> None:
        """Do one request; `argument` is read and written. Raises OSError."""
        fcntl.ioctl(fd, request.value, argument)

    def map(self, fd: int, length: int, offset: int) -> NDArray[np.uint8]:
        """A buffer of the driver's; unmapped with its last reference."""
        return np.frombuffer(mmap.mmap(fd, length, offset=offset), np.uint8)

    def wait(self, fd: int, timeout_s: float) -> bool:
        """Whether a frame is there."""
        return bool(select.select([fd], [], [], timeout_s)[0])

    def serial(self, path: str) -> str:
        """The USB serial number, "" where there is none."""
        node = Path(path).resolve().name
        with contextlib.suppress(FileNotFoundError):
            device = (Path("/sys/class/video4linux") / node / "device").resolve()
            return (device.parent / "serial").read_text().strip()
        return ""

    def close(self, fd: int) -> None:
        """Close the node."""
        os.close(fd)


class Node:
    """An open device node."""

    def __init__(self, kernel: Kernel, path: str) -> None:
        self._kernel = kernel
        self._fd = kernel.open(path)
        self._maps: list[NDArray[np.uint8]] = []

    def close(self) -> None:
        """Let go of buffers and node."""
        self._maps = []
        self._kernel.close(self._fd)

    def _ioctl(self, request: raw.IOC, argument: Any) -> Any:
        self._kernel.ioctl(self._fd, request, argument)
        return argument

    def capability(self) -> Any:
        """Card, driver and what it can do: a v4l2_capability."""
        return self._ioctl(raw.IOC.QUERYCAP, raw.v4l2_capability())

    # ------------------------------------------------------------ formats

    def codes(self) -> list[str]:
        """The four letters of each format that it has."""
        found: list[str] = []
        while True:
            description = raw.v4l2_fmtdesc(index=len(found), type=CAPTURE)
            try:
                self._ioctl(raw.IOC.ENUM_FMT, description)
            except OSError as error:
                if error.errno not in NONE:
                    raise
                return found
            found.append(text(description.pixelformat))

    def format(self) -> tuple[str, tuple[int, int], int]:
        """Format, size, and the bytes from row to row in force."""
        return _told(self._ioctl(raw.IOC.G_FMT, raw.v4l2_format(type=CAPTURE)))

    def set_format(self, code: str, size: tuple[int, int]) -> tuple[str, tuple[int, int]]:
        """Set a format and size if they are possible; gives those that are the nearest."""
        form = self._ioctl(raw.IOC.G_FMT, raw.v4l2_format(type=CAPTURE))
        pix = form.fmt.pix
        pix.pixelformat, (pix.width, pix.height) = int.from_bytes(code.encode(), "little"), size
        pix.field, pix.bytesperline = raw.Field.NONE.value, 0
        nearest = _told(self._ioctl(raw.IOC.TRY_FMT, form))[:2]
        if nearest == (code, size):
            self._ioctl(raw.IOC.S_FMT, form)
        return nearest

    def crop(self) -> Rectangle | None:
        """The part of the sensor that is read; None if it cannot be chosen."""
        area = raw.v4l2_selection(type=CAPTURE, target=raw.SelectionTarget.CROP.value)
        try:
            self._ioctl(raw.IOC.G_SELECTION, area)
        except OSError as error:
            if error.errno not in NONE:
                raise
            return None
        return int(area.r.left), int(area.r.top), int(area.r.width), int(area.r.height)

    def set_crop(self, wanted: Rectangle) -> Rectangle:
        """Choose the part of the sensor that is read; gives what it really is now."""
        area = raw.v4l2_selection(type=CAPTURE, target=raw.SelectionTarget.CROP.value)
        area.r.left, area.r.top, area.r.width, area.r.height = wanted
        self._ioctl(raw.IOC.S_SELECTION, area)
        return int(area.r.left), int(area.r.top), int(area.r.width), int(area.r.height)

    def rate(self) -> float:
        """Frames a second; 0 if it does not say."""
        parameters = raw.v4l2_streamparm(type=CAPTURE)
        try:
            self._ioctl(raw.IOC.G_PARM, parameters)
        except OSError as error:
            if error.errno not in NONE:
                raise
            return 0.0
        period = parameters.parm.capture.timeperframe
        return period.denominator / period.numerator if period.numerator else 0.0

    def set_rate(self, rate_hz: float) -> float:
        """Set the frame rate; gives the one that it took."""
        parameters = raw.v4l2_streamparm(type=CAPTURE)
        wanted = (1 / Fraction(rate_hz)).limit_denominator(1_000_000)
        period = parameters.parm.capture.timeperframe
        period.numerator, period.denominator = wanted.numerator, wanted.denominator
        self._ioctl(raw.IOC.S_PARM, parameters)
        return self.rate()

    # ------------------------------------------------------------ controls

    def controls(self) -> dict[str, Any]:
        """All controls that can be set, a v4l2_queryctrl by the name that v4l2-ctl prints."""
        found: dict[str, Any] = {}
        unusable = raw.ControlFlag.DISABLED.value | raw.ControlFlag.READ_ONLY.value
        ident = 0
        while True:
            query = raw.v4l2_queryctrl(id=ident | raw.ControlFlag.NEXT_CTRL.value)
            try:
                self._ioctl(raw.IOC.QUERYCTRL, query)
            except OSError as error:
                if error.errno not in NONE:
                    raise
                return found
            ident = query.id
            words = "".join(c if c.isalnum() else " " for c in query.name.decode().lower())
            if not query.flags & unusable:
                found["_".join(words.split())] = query

    def get(self, control: Any) -> int:
        """The value of one of `controls`."""
        return int(self._ioctl(raw.IOC.G_CTRL, raw.v4l2_control(id=control.id)).value)

    def set(self, control: Any, value: int) -> None:
        """Give one of `controls` a value."""
        self._ioctl(raw.IOC.S_CTRL, raw.v4l2_control(id=control.id, value=value))

    # ------------------------------------------------------------ buffers

    def stream(self, buffers: int) -> None:
        """Map buffers, hand them to the driver and start."""
        request = raw.v4l2_requestbuffers(count=buffers, type=CAPTURE, memory=MMAP)
        self._ioctl(raw.IOC.REQBUFS, request)  # it may give more or fewer
        for index in range(request.count):
            buffer = self._ioctl(raw.IOC.QUERYBUF, _buffer(index))
            self._maps.append(self._kernel.map(self._fd, buffer.length, buffer.m.offset))
            self.give_back(index)
        self._ioctl(raw.IOC.STREAMON, ctypes.c_int(CAPTURE))

    def take(self, timeout_s: float) -> tuple[Any, NDArray[np.uint8]] | None:
        """The next filled v4l2_buffer and its bytes, valid until `give_back`; None if none came."""
        if not self._kernel.wait(self._fd, timeout_s):
            return None
        try:
            buffer = self._ioctl(raw.IOC.DQBUF, _buffer(0))
        except BlockingIOError:  # woken for nothing
            return None
        return buffer, self._maps[buffer.index][: buffer.bytesused]

    def give_back(self, index: int) -> None:
        """Let the driver fill a buffer again."""
        self._ioctl(raw.IOC.QBUF, _buffer(index))

    def end(self) -> None:
        """Stop and free the buffers."""
        self._maps = []  # the driver frees no buffer that is mapped
        self._ioctl(raw.IOC.STREAMOFF, ctypes.c_int(CAPTURE))
        self._ioctl(raw.IOC.REQBUFS, raw.v4l2_requestbuffers(count=0, type=CAPTURE, memory=MMAP))


def text(code: int) -> str:
    """A format's four letters."""
    return code.to_bytes(4, "little").decode("latin-1")


def _told(form: Any) -> tuple[str, tuple[int, int], int]:
    pix = form.fmt.pix
    return text(pix.pixelformat), (int(pix.width), int(pix.height)), int(pix.bytesperline)


def _buffer(index: int) -> Any:
    return raw.v4l2_buffer(index=index, type=CAPTURE, memory=MMAP)
