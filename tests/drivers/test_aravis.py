"""The Aravis driver over a real GigE Vision camera: Aravis's fake one, on the loopback network."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from drivers.base.camera import Acquisition, CameraSettings, Frame
from drivers.base.device import Context
from drivers.base.errors import DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.pixelformat import PixelFormat
from drivers.registry import UnknownDriver, load

try:
    load("camera", "aravis")
except UnknownDriver as missing:
    pytest.skip(str(missing), allow_module_level=True)
FAKE = shutil.which("arv-fake-gv-camera-0.8")
if FAKE is None:
    pytest.skip("no arv-fake-gv-camera-0.8: apt install aravis-tools", allow_module_level=True)

from drivers.aravis import AravisCamera, AravisOptions  # noqa: E402
from tests.drivers import aravis_peer  # noqa: E402

MS = 1_000_000
ADDRESS = "127.0.0.1"


def make(**options: Any) -> AravisCamera:
    options = {"address": ADDRESS, "trigger_line": "Line0"} | options
    return AravisCamera("cam", msgspec.convert(options, AravisOptions), Context())


class Bench:
    """One fake camera at a time: there is one loopback address."""

    def __init__(self) -> None:
        self.arguments: tuple[str, ...] = ()
        self._process: subprocess.Popen[bytes] | None = None

    def power(self, *arguments: str) -> None:
        """Replace the camera; returns when the new one answers."""
        assert FAKE is not None
        self.plug([FAKE, "-i", ADDRESS, *arguments], arguments)

    def plug(self, command: list[str], arguments: tuple[str, ...]) -> None:
        """Run a camera's program in place of the one that runs."""
        self.cut()
        process = self._process = subprocess.Popen(command)
        self.arguments = arguments
        for _ in range(20):
            cam = make()
            try:
                cam.connect()
            except DeviceLost:
                assert process.poll() is None
                continue
            cam.close()
            return
        pytest.fail("the fake camera does not answer")

    def cut(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._process, self.arguments = None, ()


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with aravis_peer.loopback():
        made = Bench()
        yield made
        made.cut()


@pytest.fixture
def cam(bench: Bench) -> Iterator[AravisCamera]:
    if bench.arguments != ("-s", "GV01"):
        bench.power("-s", "GV01")
    made = make(pixel_format="Mono8", roi=(0, 0, 128, 96), exposure_us=2000.0, gain=0.0)
    made.connect()
    yield made
    made.close()


def grab(cam: AravisCamera, timeout_s: float = 3.0) -> Frame:
    info = cam.info()
    return cam.grab(np.empty(info.shape, info.pixel_format.dtype), timeout_s)


def test_settings_are_what_the_camera_has(cam: AravisCamera) -> None:
    assert cam.facts()["model"] == "Aravis Fake"
    assert cam.facts()["serial"] == "GV01"
    got = cam.configure(
        CameraSettings(
            exposure_us=3000.0,
            gain=3.0,
            pixel_format=PixelFormat.MONO16,
            frame_rate_hz=50.0,
            roi=(16, 32, 64, 48),
        )
    )
    assert got == CameraSettings(3000.0, 3.0, PixelFormat.MONO16, 50.0, (16, 32, 64, 48))
    info = cam.info()
    assert info.shape == (48, 64)
    assert info.exposure_range_us == (10.0, 1e7)
    assert set(info.triggers) == {"software", "hardware", "none"}
    for wanted, says in (
        (CameraSettings(exposure_us=1.0), "ExposureTimeAbs 1 is out of range; choose 10 to 1e.07"),
        (CameraSettings(gain=99.0), "GainRaw 99 is out of range; choose 0 to 10"),
        (CameraSettings(roi=(0, 0, 4096, 48)), "Width 4096 is not possible"),
        (CameraSettings(pixel_format=PixelFormat.MONO12), "no pixel format Mono12; choose of"),
    ):
        with pytest.raises(DeviceRefused, match=says):
            cam.configure(wanted)
    assert cam.settings() == got


def test_frames_stream_in_order_past_the_wrap_of_their_ids(cam: AravisCamera) -> None:
    cam.configure(CameraSettings(roi=(0, 0, 32, 32), exposure_us=100.0, frame_rate_hz=900.0))
    cam.start(Acquisition.FREE)
    raw: list[int | None] = []
    count = cam._count
    cam._count = lambda block_id: (raw.append(block_id), count(block_id))[1]  # type: ignore[func-returns-value, method-assign]
    frames = [grab(cam) for _ in range(300)]
    assert min(filter(None, raw)) < 1000
    assert max(filter(None, raw)) > 65000  # the fake begins shortly before the wrap
    sequence = [f.sequence for f in frames]  # a busy machine may lose some: they are counted
    for counted, k in zip(sequence, raw, strict=True):
        assert k is None or counted == (k - 65401) % 65535  # None: its first packet was lost
    assert sequence[-1] < 65535
    starts = [f.start_ns for f in frames]
    assert starts == sorted(starts)
    assert abs(frames[-1].end_ns - time.monotonic_ns()) < 2_000 * MS
    assert all(f.end_ns - f.start_ns == 100_000 for f in frames)


def test_exposure_changes_pixels(cam: AravisCamera) -> None:
    means = []
    for exposure in (2000.0, 8000.0):
        cam.configure(CameraSettings(exposure_us=exposure))
        cam.start(Acquisition.SOFTWARE)
        cam.trigger()
        means.append(float(grab(cam).pixels.mean()))
        cam.stop()
    assert means[1] > 1.5 * means[0]


@pytest.mark.parametrize(
    ("pixel_format", "shape", "dtype"),
    [
        (PixelFormat.MONO8, (96, 128), np.uint8),
        (PixelFormat.MONO16, (96, 128), np.uint16),
        (PixelFormat.BAYER_RG8, (96, 128), np.uint8),
        (PixelFormat.BAYER_GB8, (96, 128), np.uint8),
        (PixelFormat.RGB8, (96, 128, 3), np.uint8),
    ],
)
def test_pixel_formats(
    cam: AravisCamera, pixel_format: PixelFormat, shape: tuple[int, ...], dtype: Any
) -> None:
    cam.configure(CameraSettings(pixel_format=pixel_format))
    cam.start(Acquisition.SOFTWARE)
    cam.trigger()
    frame = grab(cam)
    assert (frame.pixels.shape, frame.pixels.dtype) == (shape, dtype)
    assert frame.pixels.max() > 0


@pytest.mark.parametrize("native", aravis_peer.FORMATS)
def test_12_bit_mosaics_are_exact_at_odd_corners_too(bench: Bench, native: str) -> None:
    program = [sys.executable, aravis_peer.__file__, ADDRESS, "GV12"]
    if bench.arguments != ("GV12",):
        bench.plug(program, ("GV12",))
    cam = make(serial="GV12", pixel_format=native, exposure_us=500.0)
    cam.connect()
    try:
        for roi in ((0, 0, 512, 300), (1, 0, 31, 18), (0, 1, 9, 6), (3, 5, 7, 8)):
            cam.configure(CameraSettings(roi=roi))
            cam.start(Acquisition.SOFTWARE)
            cam.trigger()
            np.testing.assert_array_equal(grab(cam).pixels, aravis_peer.sensor(*roi))
            cam.stop()
            assert cam.info().pixel_format is PixelFormat.BAYER_RG12
            assert cam.facts()["pixel_format"] == native
    finally:
        cam.close()


def test_software_triggers_one_frame_each(cam: AravisCamera) -> None:
    cam.start(Acquisition.SOFTWARE)
    for k in range(4):
        start, end = cam.trigger()
        frame = grab(cam)
        assert (frame.sequence, frame.start_ns, frame.end_ns) == (k, start, end)
    with pytest.raises(DeviceTimeout, match="trigger again"):
        grab(cam, 0.1)
    cam.trigger()  # after a restart
    assert grab(cam).sequence == 0


def test_a_hardware_trigger_that_never_comes(cam: AravisCamera) -> None:
    cam.start(Acquisition.HARDWARE)
    with pytest.raises(DeviceTimeout, match="check the trigger's wiring"):
        grab(cam, 0.1)


def test_halt_ends_a_blocked_grab(cam: AravisCamera) -> None:
    cam.start(Acquisition.SOFTWARE)
    threading.Timer(0.05, cam.halt).start()
    with pytest.raises(DeviceRefused, match="grab: halted"):
        grab(cam, 30.0)


def test_a_camera_in_use_is_refused(cam: AravisCamera) -> None:
    second = make()
    with pytest.raises(DeviceRefused, match="another program controls it"):
        second.connect()
    cam.check()  # and is not disturbed


def test_the_wrong_camera(cam: AravisCamera) -> None:
    cam.close()
    with pytest.raises(DeviceRefused, match="it is GV01, not GV77"):
        make(serial="GV77").connect()


def test_lost_packets_are_told(bench: Bench) -> None:
    bench.power("-s", "GV02", "-r", "2")
    cam = make(pixel_format="Mono8", roi=(0, 0, 512, 512), exposure_us=500.0)
    cam.connect()
    cam.configure(CameraSettings(frame_rate_hz=100.0))
    cam.start(Acquisition.FREE)
    frames = [grab(cam) for _ in range(60)]
    cam.close()
    broken = sum(f.incomplete for f in frames)
    assert 0 < broken < 60
    assert cam.facts()["incomplete"] == broken
    sequence = [f.sequence for f in frames]
    assert sequence == sorted(set(sequence))
    steps = [after - before for before, after in pairwise(sequence)]
    assert steps.count(1) > 40  # a busy machine loses many at once, and not one now and then


def test_a_camera_that_dies_is_lost_and_comes_back(bench: Bench) -> None:
    bench.power("-s", "GV03")
    cam = make(pixel_format="Mono8", exposure_us=1500.0)
    identity = cam.connect()
    cam.configure(CameraSettings(gain=2.0, roi=(0, 0, 64, 64)))
    settings = cam.settings()
    cam.start(Acquisition.FREE)
    grab(cam)
    bench.cut()

    def those_on_their_way() -> None:
        for _ in range(500):
            grab(cam, 0.2)

    with pytest.raises(DeviceLost, match="no longer answers"):
        those_on_their_way()
    with pytest.raises(DeviceLost):
        cam.check()
    cam.safe()  # nothing to stop any more
    cam.close()
    # Aravis's own way takes 12 s, and goes on after our close has come back.
    with pytest.raises(DeviceLost, match="still being closed"):
        cam.connect()
    bench.power("-s", "GV03")
    end = time.monotonic() + 120
    while True:
        try:
            assert cam.connect() == identity
            break
        except DeviceLost:
            assert time.monotonic() < end
    assert cam.settings() == settings
    cam.start(Acquisition.FREE)
    assert not grab(cam).incomplete
    cam.close()


@pytest.fixture
def in_process() -> Iterator[None]:
    """Aravis's fake camera within this process, and no other interface: nothing is broadcast."""
    from gi.repository import Aravis

    others = [
        Aravis.get_interface_id(i)
        for i in range(Aravis.get_n_interfaces())
        if Aravis.get_interface_id(i) != "Fake"
    ]
    for interface in others:
        Aravis.disable_interface(interface)
    Aravis.enable_interface("Fake")
    yield
    Aravis.disable_interface("Fake")
    for interface in others:
        Aravis.enable_interface(interface)


@pytest.mark.usefixtures("in_process")
def test_it_is_found_by_serial_number() -> None:
    (found,) = AravisCamera.discover()
    options = dict(found["options"])
    assert options.pop("driver") == "aravis"
    cam = make(address="", **options)
    assert cam.connect().serial == found["serial"]
    cam.start(Acquisition.FREE)
    assert grab(cam).sequence == 0
    cam.check()
    cam.close()
    only = make(address="")
    assert only.connect().serial == found["serial"]
    only.close()
    with pytest.raises(DeviceLost, match=rf"no camera GV77 \(found: {found['serial']}\)"):
        make(address="", serial="GV77").connect()
