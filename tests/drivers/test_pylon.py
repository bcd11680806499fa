"""The pylon driver over Basler's own SDK and its camera emulation."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

os.environ["PYLON_CAMEMU"] = "2"  # read when the SDK starts
pytest.importorskip("pypylon", reason="pip install 'umbra-rig[pylon]'")

from drivers.base.camera import Acquisition, CameraSettings, Frame
from drivers.base.device import Context
from drivers.base.errors import DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.pixelformat import PixelFormat
from drivers.pylon import PylonCamera, PylonOptions
from drivers.registry import load

SERIAL = "0815-0000"
MS = 1_000_000


def make(**options: Any) -> PylonCamera:
    options = {"serial": SERIAL, "transport": "BaslerCamEmu", "roi": (0, 0, 64, 48)} | options
    return PylonCamera("cam", msgspec.convert(options, PylonOptions), Context())


@pytest.fixture
def cam() -> Iterator[PylonCamera]:
    made = make(exposure_us=2000.0)
    made.connect()
    yield made
    made.close()


def grab(cam: PylonCamera, timeout_s: float = 2.0) -> Frame:
    info = cam.info()
    return cam.grab(np.empty(info.shape, info.pixel_format.dtype), timeout_s)


def test_it_is_found_and_named() -> None:
    assert load("camera", "pylon") is PylonCamera
    found = PylonCamera.discover(transport="BaslerCamEmu")
    assert [f["serial"] for f in found] == ["0815-0000", "0815-0001"]
    cam = PylonCamera(
        "cam",
        msgspec.convert(
            {k: v for k, v in found[1]["options"].items() if k != "driver"}, PylonOptions
        ),
        Context(),
    )
    identity = cam.connect()
    cam.close()
    assert (identity.model, identity.serial) == ("Emulation", "0815-0001")


def test_which_camera_must_be_clear() -> None:
    with pytest.raises(DeviceRefused, match="several cameras fit: 0815-0000, 0815-0001"):
        make(serial="").connect()
    with pytest.raises(DeviceLost, match=r"no camera 123 \(found: 0815-0000, 0815-0001\)"):
        make(serial="123").connect()


def test_after_close_it_can_be_opened_again(cam: PylonCamera) -> None:
    cam.check()
    cam.close()
    cam.close()
    for call in (cam.check, cam.info, cam.trigger, lambda: cam.start(Acquisition.FREE)):
        with pytest.raises(DeviceRefused, match="not connected"):
            call()
    cam.connect()
    cam.check()


def test_settings_are_what_the_camera_has(cam: PylonCamera) -> None:
    got = cam.configure(
        CameraSettings(
            exposure_us=5000.0,
            gain=2.0,
            pixel_format=PixelFormat.BAYER_RG12,
            frame_rate_hz=40.0,
            roi=(16, 8, 128, 96),
        )
    )
    assert got.exposure_us == pytest.approx(5000)
    assert got.gain == pytest.approx(2, abs=0.05)
    assert got.roi == (16, 8, 128, 96)
    assert cam.settings() == got
    info = cam.info()
    assert info.shape == (96, 128)
    assert info.pixel_format is PixelFormat.BAYER_RG12
    assert info.exposure_range_us[0] < 5000 < info.exposure_range_us[1]
    assert set(info.triggers) == {"software", "hardware", "none"}


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        (CameraSettings(exposure_us=1e9), "ExposureTimeAbs 1e.09 is out of range; choose 100 to"),
        (CameraSettings(gain=-5.0), "Gain -5 is out of range"),
        (CameraSettings(frame_rate_hz=1e7), "AcquisitionFrameRateAbs 1e.07 is out of range"),
        (CameraSettings(roi=(0, 0, 100000, 48)), "Width 100000 is not possible; choose 1 to 4096"),
        (CameraSettings(roi=(4090, 0, 64, 48)), "OffsetX 4090 is not possible with Width 64"),
        (
            CameraSettings(pixel_format=PixelFormat.MONO14),
            "no pixel format Mono14; choose of Bayer",
        ),
    ],
)
def test_what_it_cannot_take_changes_nothing(
    cam: PylonCamera, wanted: CameraSettings, says: str
) -> None:
    before = cam.settings()
    with pytest.raises(DeviceRefused, match=says):
        cam.configure(wanted)
    assert cam.configure(CameraSettings()) == before


def test_options_are_checked_at_connect() -> None:
    for options, says in (
        ({"features": {"Nope": 1}}, "it has no feature Nope"),
        (
            {"features": {"TestImageSelector": "Nope"}},
            "TestImageSelector cannot be Nope; choose of",
        ),
        ({"pixel_format": "Mono7"}, "PixelFormat cannot be Mono7"),
        ({"exposure_us": -1.0}, "ExposureTimeAbs -1 is out of range"),
    ):
        broken = make(**options)
        with pytest.raises(DeviceRefused, match=f"cam: connect: {says}"):
            broken.connect()
    make().connect()  # none of them held the camera


def test_software_triggers_one_frame_each(cam: PylonCamera) -> None:
    cam.start(Acquisition.SOFTWARE)
    for k in range(5):
        start, end = cam.trigger()
        assert end - start >= 2 * MS
        frame = grab(cam)
        assert frame.sequence == k
        assert (frame.start_ns, frame.end_ns) == (start, end)
        assert frame.exposure_us == pytest.approx(2000)
        assert not frame.incomplete
    with pytest.raises(DeviceTimeout, match="trigger again"):
        grab(cam, 0.05)


def test_pipelined_triggers_keep_their_times(cam: PylonCamera) -> None:
    cam.start(Acquisition.SOFTWARE)
    intervals = [cam.trigger() for _ in range(3)]
    frames = [grab(cam) for _ in range(3)]
    assert [(f.start_ns, f.end_ns) for f in frames] == intervals


def test_a_late_frame_is_never_taken_for_the_next(cam: PylonCamera) -> None:
    cam.configure(CameraSettings(exposure_us=200_000.0))
    cam.start(Acquisition.SOFTWARE)
    cam.trigger()
    with pytest.raises(DeviceTimeout):
        grab(cam, 0.02)  # it comes 180 ms later
    start, _ = cam.trigger()
    frame = grab(cam)
    assert frame.start_ns == start
    assert time.monotonic_ns() >= start + 190 * MS  # exposed after this trigger, not the first
    with pytest.raises(DeviceTimeout):
        grab(cam, 0.3)  # and there is one frame only


def test_free_running_frames_are_spaced_by_the_rate(cam: PylonCamera) -> None:
    cam.configure(CameraSettings(frame_rate_hz=50.0))
    cam.start(Acquisition.FREE)
    frames = [grab(cam) for _ in range(10)]
    assert [f.sequence for f in frames] == list(range(10))
    starts = [f.start_ns for f in frames]
    assert starts == sorted(starts)
    assert all(f.end_ns - f.start_ns == 2 * MS for f in frames)
    assert starts[-1] - starts[0] > 9 * 15 * MS
    with pytest.raises(DeviceRefused, match="does not wait for software"):
        cam.trigger()
    with pytest.raises(DeviceRefused, match="it is acquiring"):
        cam.configure(CameraSettings(gain=1.0))


def test_a_hardware_trigger_that_never_comes() -> None:
    cam = make(trigger_line="Line1")
    cam.connect()
    cam.start(Acquisition.HARDWARE)
    with pytest.raises(DeviceTimeout, match="check the trigger's wiring"):
        grab(cam, 0.1)
    cam.close()
    other = make(trigger_line="Line77")
    other.connect()
    with pytest.raises(DeviceRefused, match="no hardware trigger"):
        other.start(Acquisition.HARDWARE)
    other.close()


def test_frames_that_failed_are_incomplete_and_the_next_are_whole(cam: PylonCamera) -> None:
    nodes = cam._nodes("test")
    nodes.set("ForceFailedBufferCount", 3)
    cam.start(Acquisition.FREE)
    nodes.execute("ForceFailedBuffer")
    frames = [grab(cam) for _ in range(8)]
    assert sum(f.incomplete for f in frames) == 3
    assert not frames[-1].incomplete
    assert [f.sequence for f in frames] == list(range(8))
    assert cam.facts()["incomplete"] == 3


def test_halt_ends_a_blocked_grab(cam: PylonCamera) -> None:
    cam.start(Acquisition.SOFTWARE)
    threading.Timer(0.05, cam.halt).start()
    with pytest.raises(DeviceRefused, match="grab: halted"):
        grab(cam, 30.0)
    with pytest.raises(DeviceRefused, match="trigger: halted"):
        cam.trigger()
    cam.start(Acquisition.SOFTWARE)
    cam.trigger()
    grab(cam)


@pytest.mark.parametrize(
    ("native", "pixel_format"),
    [
        ("Mono8", PixelFormat.MONO8),
        ("Mono12", PixelFormat.MONO12),
        ("Mono16", PixelFormat.MONO16),
        ("BayerGB10", PixelFormat.BAYER_GB10),
        ("BayerRG12", PixelFormat.BAYER_RG12),
        ("RGB8Packed", PixelFormat.RGB8),
        ("BGR8Packed", PixelFormat.RGB8),
        ("BGRA8Packed", PixelFormat.RGB8),
    ],
)
def test_pixels_are_the_picture_that_was_before_the_camera(
    tmp_path: Path, native: str, pixel_format: PixelFormat
) -> None:
    shape = (48, 64, 3) if pixel_format.channels == 3 else (48, 64)
    top = 255 if pixel_format.channels == 3 else pixel_format.full_scale
    dtype = np.uint8 if top == 255 else np.uint16
    picture = np.random.default_rng(0).integers(0, top + 1, shape, dtype)
    # The emulation scales 16-bit files down to the sensor's bits.
    scaled = picture << (16 - pixel_format.bits) if dtype is np.uint16 else picture
    path = tmp_path / ("a.tif" if dtype is np.uint16 else "a.png")
    assert cv2.imwrite(str(path), scaled if scaled.ndim == 2 else scaled[:, :, ::-1])
    cam = make(
        pixel_format=native,
        exposure_us=1000.0,
        features={
            "TestImageSelector": "Off",
            "ImageFilename": str(path),
            "ImageFileMode": "On",
        },
    )
    cam.connect()
    try:
        assert cam.info().pixel_format is pixel_format
        cam.start(Acquisition.SOFTWARE)
        cam.trigger()
        np.testing.assert_array_equal(grab(cam).pixels, picture)
    finally:
        cam.close()


@pytest.mark.parametrize("native", ["BayerRG12", "BayerGB12", "BayerBG12"])
def test_a_region_is_cut_from_the_mosaic_where_it_was_asked_for(native: str) -> None:
    """Odd corners too. The emulation's picture has no colours: its name for the mosaic stays."""
    cam = make(
        pixel_format=native,
        exposure_us=1000.0,
        roi=(0, 0, 40, 30),
        features={"TestImageSelector": "Testimage1"},
    )
    cam.connect()
    try:
        pictures = {}
        for roi in ((0, 0, 40, 30), (1, 0, 31, 17), (0, 3, 9, 5), (5, 7, 7, 7)):
            cam.configure(CameraSettings(roi=roi))
            cam.start(Acquisition.SOFTWARE)
            cam.trigger()
            pictures[roi] = grab(cam).pixels
            cam.stop()
            assert cam.facts()["pixel_format"] == native
        whole = pictures.pop((0, 0, 40, 30))
        assert len(np.unique(whole)) > 50
        assert whole.max() > 255
        for (x, y, width, height), picture in pictures.items():
            np.testing.assert_array_equal(picture, whole[y : y + height, x : x + width])
    finally:
        cam.close()


def test_settings_survive_a_reconnection(cam: PylonCamera) -> None:
    wanted = CameraSettings(exposure_us=7000.0, pixel_format=PixelFormat.MONO12)
    before = cam.configure(wanted)
    identity = cam.connect()
    assert identity.serial == SERIAL
    assert cam.settings() == before
    cam.start(Acquisition.SOFTWARE)
    cam.trigger()
    assert grab(cam).pixels.dtype == np.uint16
