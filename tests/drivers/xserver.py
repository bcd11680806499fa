"""An X server without a screen, and what it really shows: pictures of its root window."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray


def screen_tools_missing() -> str:
    """The programs that `xvfb` and `screenshot` need and that are not there; "" if all are."""
    return " and no ".join(tool for tool in ("Xvfb", "xwd") if shutil.which(tool) is None)


@contextmanager
def xvfb(width: int, height: int) -> Iterator[str]:
    """A display of that size; gives its DISPLAY. Skips where there is no Xvfb."""
    if missing := screen_tools_missing():
        pytest.skip(f"no {missing}: apt install xvfb x11-apps")
    told, tell = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(tell), "-screen", "0", f"{width}x{height}x24",
         "-nolisten", "tcp", "-noreset"],
        pass_fds=[tell], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        os.close(tell)
        with os.fdopen(told) as answer:
            number = answer.readline().strip()  # once it listens
            assert number, "Xvfb did not start"
        yield f":{number}"
    finally:
        server.terminate()
        server.wait(60)


def screenshot(display: str) -> NDArray[np.uint8]:
    """What the X server shows, (H, W, 3) RGB, asked over a connection of its own (`xwd`)."""
    command = ["xwd", "-root", "-silent", "-display", display]
    dump = subprocess.run(command, check=True, capture_output=True, timeout=20).stdout
    header = struct.unpack(">25I", dump[:100])
    start = header[0] + 12 * header[19]
    width, height, stride, masks = header[4], header[5], header[12], header[14:17]
    deep = header[11] // 8  # bytes a pixel: 4, or 3 where xwd puts several visuals together
    assert header[7] == 0, "not little-endian"
    rows = np.frombuffer(dump, np.uint8, height * stride, start).reshape(height, stride)
    samples = rows[:, : width * deep].reshape(height, width, deep).astype(np.uint32)
    pixels = sum(samples[..., k] << np.uint32(8 * k) for k in range(deep))
    planes = [(pixels & mask) >> ((mask & -mask).bit_length() - 1) for mask in masks]
    return np.stack(planes, -1).astype(np.uint8)
