"""The GenTL driver over the producer that the genicam package carries: a toy with three cameras."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from drivers.base import (
    Acquisition,
    CameraSettings,
    Context,
    DeviceLost,
    DeviceRefused,
    Frame,
    PixelFormat,
)
from drivers.registry import UnknownDriver, load

try:
    load("camera", "gentl")
except UnknownDriver as missing:
    pytest.skip(str(missing), allow_module_level=True)

from drivers.gentl import GentlCamera, GentlOptions

PACKAGE = importlib.util.find_spec("genicam")
assert PACKAGE is not None
PRODUCER = next(Path((PACKAGE.submodule_search_locations or [""])[0]).rglob("viky.cti"))
MS = 1_000_000


def make(**options: Any) -> GentlCamera:
    options = {"producer": str(PRODUCER), "serial": "0"} | options
    return GentlCamera("cam", msgspec.convert(options, GentlOptions), Context())


@pytest.fixture
def cam() -> Iterator[GentlCamera]:
    made = make()
    made.connect()
    yield made
    made.close()


def grab(cam: GentlCamera, timeout_s: float = 3.0) -> Frame:
    info = cam.info()
    return cam.grab(np.empty(info.shape, info.pixel_format.dtype), timeout_s)


def test_it_is_found_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(PRODUCER.parent))
    found = GentlCamera.discover()
    assert [f["serial"] for f in found] == ["0", "1", "2"]
    options = dict(found[1]["options"])
    assert options.pop("driver") == "gentl"
    cam = make(**options)
    assert cam.connect().serial == "1"
    cam.close()
    with pytest.raises(DeviceRefused, match="several cameras fit: 0, 1, 2"):
        make(producer="", serial="").connect()
    with pytest.raises(DeviceLost, match=r"no camera 77 \(found: 0, 1, 2\)"):
        make(serial="77").connect()


def test_producers_that_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceRefused, match=r"no producer .*nope\.cti"):
        make(producer=str(tmp_path / "nope.cti")).connect()
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    with pytest.raises(DeviceRefused, match="GENICAM_GENTL64_PATH names none"):
        make(producer="").connect()


def test_a_producer_opens_once_a_process(cam: GentlCamera) -> None:
    second = make()
    with pytest.raises(DeviceLost, match="close other programs that use its producer"):
        second.connect()
    cam.check()  # and is not disturbed
    cam.close()
    cam.close()
    second.connect()
    second.close()


def test_settings_are_what_the_camera_has(cam: GentlCamera) -> None:
    got = cam.configure(
        CameraSettings(pixel_format=PixelFormat.MONO8, frame_rate_hz=50.0, roi=(0, 0, 200, 120))
    )
    assert got == CameraSettings(None, None, PixelFormat.MONO8, 50.0, (0, 0, 200, 120))
    assert cam.info().shape == (120, 200)
    assert cam.info().triggers == ("none",)
    for wanted, says in (
        (CameraSettings(exposure_us=1.0), "it has no ExposureTime"),
        (CameraSettings(gain=1.0), "it has no Gain"),
        (CameraSettings(roi=(0, 0, 7, 120)), "Width 7 is not possible; choose 100 to 800"),
        (CameraSettings(roi=(4, 0, 200, 120)), "OffsetX 4 is not possible"),
        (CameraSettings(pixel_format=PixelFormat.MONO16), "choose of Mono8, RGB8"),
    ):
        with pytest.raises(DeviceRefused, match=says):
            cam.configure(wanted)
    assert cam.settings() == got
    with pytest.raises(DeviceRefused, match="it has no software trigger"):
        cam.start(Acquisition.SOFTWARE)


@pytest.mark.parametrize("pixel_format", [PixelFormat.RGB8, PixelFormat.MONO8])
def test_frames_stream_in_order(cam: GentlCamera, pixel_format: PixelFormat) -> None:
    cam.configure(CameraSettings(pixel_format=pixel_format, frame_rate_hz=100.0))
    for _ in range(2):  # and again after a stop
        cam.start(Acquisition.FREE)
        frames = [grab(cam) for _ in range(5)]
        cam.stop()
        assert [f.sequence for f in frames] == sorted({f.sequence for f in frames})
        starts = [f.start_ns for f in frames]
        assert starts == sorted(starts)
        assert starts[-1] - starts[0] > 20 * MS
        assert not any(f.incomplete for f in frames)
        assert frames[0].pixels.max() > 0


def test_colours_come_in_rgb_order() -> None:
    """The three cameras are named by the colour of their balls."""
    planes = []
    for serial in ("0", "2"):  # red, blue
        cam = make(serial=serial)
        cam.connect()
        cam.start(Acquisition.FREE)
        planes.append(grab(cam).pixels.reshape(-1, 3).astype(float).mean(axis=0))
        cam.close()
    red, blue = planes
    assert red[0] - red[2] > blue[0] - blue[2]


def test_a_frame_with_missing_parts_is_told(cam: GentlCamera) -> None:
    cam.start(Acquisition.FREE)
    grab(cam)
    cam._broken.emit(None)  # as harvesters does after it has discarded one
    frame = grab(cam)
    assert frame.incomplete
    assert not grab(cam).incomplete
    assert cam.facts()["incomplete"] == 1


def test_halt_ends_a_blocked_grab(cam: GentlCamera) -> None:
    cam.configure(CameraSettings(frame_rate_hz=1.0))
    cam.start(Acquisition.FREE)
    threading.Timer(0.05, cam.halt).start()
    out = np.empty(cam.info().shape, np.uint8)

    def all_of_them() -> None:
        while True:
            cam.grab(out, 30.0)

    with pytest.raises(DeviceRefused, match="grab: halted"):
        all_of_them()


def test_settings_survive_a_reconnection(cam: GentlCamera) -> None:
    before = cam.configure(CameraSettings(pixel_format=PixelFormat.MONO8, roi=(0, 0, 160, 120)))
    cam.connect()
    assert cam.settings() == before
