"""The process of a `display` projector, and what is said to it.

`main` is that process: told one `Call` at a time over a connection, it answers with a `Reply`;
pictures lie in shared memory. It ends when the connection does, and at no signal of a terminal or a
service manager.
"""

from __future__ import annotations

import mmap
import os
import signal
import sys
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from drivers.base.device import Context
from drivers.base.errors import DeviceError
from drivers.displaywindow import DisplayWindow


@dataclass(frozen=True, slots=True)
class Call:
    """What to do: a method of the window; `shape` of the picture in the shared memory."""

    method: str
    shape: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Reply:
    """What came of it: a value, or the kind and the words of a DeviceError."""

    value: Any = None
    error: type[DeviceError] | None = None
    words: tuple[str, ...] = field(default=())


def serve(calls: Connection, memory: int) -> None:
    """Be the window that the first message describes, until the connection ends."""
    name, options = calls.recv()
    window = DisplayWindow(name, options, Context())
    pixels: mmap.mmap | None = None
    while True:
        try:
            call: Call = calls.recv()
        except EOFError:
            break
        try:
            if call.method == "connect":
                value: Any = (window.connect(), window.info(), window.facts())
                width, height = value[1].width, value[1].height
                os.ftruncate(memory, 3 * width * height)
                pixels = mmap.mmap(memory, 3 * width * height)
            elif call.method == "show":
                assert pixels is not None
                value = window.show(np.ndarray(call.shape, np.uint8, pixels))
            else:
                value = getattr(window, call.method)()
            reply = Reply(value)
        except DeviceError as error:
            reply = Reply(None, type(error), (error.phase, error.problem, error.remedy))
        calls.send(reply)
    window.close()


def main() -> None:
    """The process, given the file descriptors of its connection and of the shared memory."""
    for ending in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ending, signal.SIG_IGN)
    serve(Connection(int(sys.argv[1])), int(sys.argv[2]))
