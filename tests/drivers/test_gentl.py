"""The GenTL driver over two producers: the one that the genicam package carries (three cameras,
free-running), and one of ours with triggers, a clock, packed 12 bit mosaics and faults."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from drivers.base.camera import Acquisition, CameraSettings, Frame
from drivers.base.device import Context
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.pixelformat import PixelFormat
from drivers.registry import UnknownDriver, load

try:
    load("camera", "gentl")
except UnknownDriver as missing:
    pytest.skip(str(missing), allow_module_level=True)

from drivers.gentl import GentlCamera, GentlOptions
from tests.drivers import gentl_peer

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


# ---------------------------------------------------------------- our own producer


@pytest.fixture(scope="module")
def producer(tmp_path_factory: pytest.TempPathFactory) -> str:
    if not gentl_peer.compiler():
        pytest.skip("no C compiler for the producer: apt install gcc")
    return str(gentl_peer.build(tmp_path_factory.mktemp("producer")))


@pytest.fixture
def toy(producer: str) -> Iterator[GentlCamera]:
    made = make(producer=producer, serial="T12", exposure_us=1000.0)
    made.connect()
    yield made
    made.close()


def several(cam: GentlCamera) -> list[Frame]:
    return [grab(cam) for _ in range(20)]


REGIONS = [(0, 0, 64, 48), (1, 0, 31, 17), (0, 1, 9, 5), (3, 5, 7, 7)]


@pytest.mark.parametrize("native", ["BayerRG12", "BayerRG12p", "BayerRG12Packed"])
@pytest.mark.parametrize("padding", [0, 3])
def test_12_bit_mosaics_are_exact_and_keep_their_order_at_odd_corners(
    producer: str, native: str, padding: int
) -> None:
    cam = make(producer=producer, serial="", pixel_format=native, features={"PaddingX": padding})
    cam.connect()
    try:
        for roi, order in zip(REGIONS, ("RG", "GR", "GB", "BG"), strict=True):
            cam.configure(CameraSettings(roi=roi))
            cam.start(Acquisition.SOFTWARE)
            cam.trigger()
            frame = grab(cam)
            cam.stop()
            assert cam.info().pixel_format.value == f"Bayer{order}12"
            assert cam.facts()["pixel_format"] == native.replace("RG", order)
            np.testing.assert_array_equal(frame.pixels, gentl_peer.sensor(*roi))
        cam.connect()  # settings come back, the order with them
        assert cam.settings().roi == REGIONS[-1]
        assert cam.info().pixel_format is PixelFormat.BAYER_BG12
        cam.configure(CameraSettings(roi=REGIONS[0], pixel_format=PixelFormat.BAYER_RG12))
        assert cam.facts()["pixel_format"] == native
    finally:
        cam.close()


def test_its_clock_says_when_a_triggered_frame_was_exposed(toy: GentlCamera) -> None:
    assert toy.info().triggers == ("software", "none")
    toy.start(Acquisition.SOFTWARE)
    for k in range(3):
        start, end = toy.trigger()
        frame = grab(toy)
        assert frame.sequence == k
        assert start - MS < frame.start_ns < end + 20 * MS
        assert frame.end_ns - frame.start_ns == 1 * MS
    with pytest.raises(DeviceTimeout, match="trigger again"):
        grab(toy, 0.05)


def test_frames_that_were_lost_or_broken_are_counted(toy: GentlCamera) -> None:
    toy.configure(CameraSettings(frame_rate_hz=200.0))
    toy.start(Acquisition.FREE)
    assert grab(toy).sequence == 0
    nodes = toy._nodes("test")
    nodes.set("Skip", 4)
    numbers = [grab(toy).sequence for _ in range(10)]
    assert numbers[-1] == 10 + 4
    nodes.set("Break", 2)
    frames = [grab(toy) for _ in range(10)]
    assert sum(f.incomplete for f in frames) == 2
    assert toy.facts()["incomplete"] == 2
    whole = [f.sequence for f in frames if not f.incomplete]
    assert whole == sorted(set(whole))
    assert whole[-1] == 14 + 10


def test_a_camera_that_is_unplugged_is_lost_and_comes_back(toy: GentlCamera) -> None:
    before = toy.configure(CameraSettings(roi=(3, 5, 7, 7), exposure_us=2000.0))
    toy.start(Acquisition.FREE)
    grab(toy)
    toy._nodes("test").set("Vanish", 1)
    with pytest.raises(DeviceLost):
        several(toy)
    with pytest.raises(DeviceError):
        toy.check()
    with pytest.raises(DeviceLost):
        toy.safe()
    toy.connect()  # the library is opened anew: it is plugged in again
    assert toy.settings() == before
    toy.start(Acquisition.FREE)
    np.testing.assert_array_equal(grab(toy).pixels, gentl_peer.sensor(3, 5, 7, 7))
    assert before.pixel_format is PixelFormat.BAYER_BG12


def test_a_frame_in_another_format_than_was_set_is_garbled(toy: GentlCamera) -> None:
    toy.start(Acquisition.FREE)
    grab(toy)
    toy._nodes("test").set("PixelFormat", "BayerGB12")  # as another program would
    toy._nodes("test").set("OffsetY", 1)
    with pytest.raises(DeviceGarbled, match="format 0x01100012 came; it was set to BayerRG12"):
        several(toy)
