"""Aravis's fake GigE Vision camera with a sensor of our own: packed and plain 12 bit mosaics.

    python aravis_peer.py ADDRESS SERIAL [FILM]

Aravis's own program knows 8 and 16 bit only. This one runs the same camera, protocol and all, gives
it three more pixel formats, and fills its buffers. Its mosaic begins with R and G wherever the
region begins, as the fake's own does: the name of the format says what a frame begins with.
FILM is an .npy of pictures (N, H, W) that it sees instead, one a frame. It says "ready" when it is.
"""

from __future__ import annotations

import ctypes
import fcntl
import itertools
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMATS = {"BayerRG12": 0x01100011, "BayerRG12p": 0x010C0059, "BayerRG12Packed": 0x010C002B}
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x100, 0x104, 0x130, 0x134  # the fake camera's registers


@contextmanager
def loopback() -> Iterator[None]:
    """The one address that a fake camera can have, for one test on this machine at a time."""
    with Path(f"/tmp/umbra-tests-aravis-{os.getuid()}").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def sensor(x: int, y: int, width: int, height: int) -> NDArray[np.uint16]:
    """What the camera's sensor holds there, (H, W) 12 bit."""
    rows, columns = np.mgrid[y : y + height, x : x + width]
    held: NDArray[np.uint16] = ((37 * columns + 101 * rows + 5) % 4096).astype(np.uint16)
    return held


def stored(samples: NDArray[np.uint16], code: int) -> NDArray[np.uint8]:
    """Samples as the format lays them out; an even number of them."""
    if code == FORMATS["BayerRG12"]:
        return samples.astype("<u2").ravel().view(np.uint8)
    first, second = samples.ravel()[::2], samples.ravel()[1::2]
    if code == FORMATS["BayerRG12p"]:
        parts = (first & 255, first >> 8 | (second & 15) << 4, second >> 4)
    else:
        parts = (first >> 4, first & 15 | (second & 15) << 4, second >> 4)
    return np.stack(parts, axis=1).astype(np.uint8).ravel()


def serve(address: str, serial: str, folder: Path, film: str = "") -> None:
    """Be the camera until the process ends."""
    pictures = itertools.cycle(np.load(film)) if film else None
    import gi

    gi.require_version("Aravis", "0.8")
    from gi.repository import Aravis, GLib

    entries = "".join(
        f'<EnumEntry Name="{name}" NameSpace="Standard"><Value>{code}</Value></EnumEntry>'
        for name, code in FORMATS.items()
    )
    before = '<EnumEntry Name="BayerBG8"'
    xml = folder / "camera.xml"
    told = _description(Aravis)
    assert before in told
    xml.write_text(told.replace(before, entries + before, 1))
    camera = Aravis.GvFakeCamera.new_full(address, serial, str(xml))
    fake = camera.get_fake_camera()
    # The callback's buffer has no length yet, so its bytes cannot be had through the bindings.
    library = ctypes.CDLL("libaravis-0.8.so.0")
    data_of = library.arv_buffer_get_data
    data_of.restype, data_of.argtypes = ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_void_p]
    callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, *3 * (ctypes.c_uint32,))

    def fill(buffer: int, _: Any, exposure_us: int, gain: int, code: int) -> None:
        x, y, width, height = (
            fake.read_register(at)[1] for at in (OFFSET_X, OFFSET_Y, WIDTH, HEIGHT)
        )
        if pictures is None:
            samples = sensor(x, y, width, height)
        else:
            samples = next(pictures)[y : y + height, x : x + width]
        data = stored(samples, code)
        ctypes.memmove(data_of(buffer, None), data.ctypes.data, len(data))

    kept = callback(fill)
    library.arv_fake_camera_set_fill_pattern(
        ctypes.c_void_p(hash(fake)), kept, ctypes.c_void_p(None)
    )
    print("ready", flush=True)
    GLib.MainLoop().run()


def _description(aravis: Any) -> str:
    """The fake camera's own GenICam file, from the one within a process."""
    for interface in ("GigEVision", "USB3Vision"):  # nothing is broadcast
        aravis.disable_interface(interface)
    aravis.enable_interface("Fake")
    aravis.update_device_list()
    xml, *_ = aravis.Camera.new("Fake_1").get_device().get_genicam_xml()
    return str(xml)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        serve(sys.argv[1], sys.argv[2], Path(made), "".join(sys.argv[3:4]))
