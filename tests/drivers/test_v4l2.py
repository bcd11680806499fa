"""The V4L2 driver over a camera that answers its system calls: no such device can be had in CI."""

from __future__ import annotations

import ctypes
import errno
import os
import threading
import time
from collections import deque
from typing import Any, ClassVar

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, CameraSettings, Frame
from drivers.base.device import Context
from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.pixelformat import PixelFormat
from drivers.registry import UnknownDriver, load

try:
    load("camera", "v4l2")
except UnknownDriver as missing:
    pytest.skip(str(missing), allow_module_level=True)

from linuxpy.video import raw

from drivers.v4l2 import V4l2Camera, V4l2Options
from drivers.v4l2node import Kernel

PATH = "/dev/v4l/by-id/usb-Toy_Camera_42-video-index0"
WIDTH, HEIGHT = 64, 48
IOC, FLAG = raw.IOC, raw.BufferFlag


def failing(code: int) -> OSError:
    return OSError(code, os.strerror(code))


MOSAICS = {  # names of RG mosaics, cut at (even, even), (odd, even), (even, odd), (odd, odd)
    "RG12": ("RG12", "BA12", "GB12", "BG12"),
    "pRCC": ("pRCC", "pgCC", "pGCC", "pBCC"),
}


class ToyCamera(Kernel):
    """A kernel with one camera: strict about the order of calls, as the real one is."""

    CONTROLS: ClassVar[
        dict[int, tuple[str, int, int, int]]
    ] = {  # id: name, minimum, maximum, value
        0x009A0901: ("Auto Exposure", 0, 3, 3),
        0x009A0902: ("Exposure Time, Absolute", 1, 5000, 157),
        0x00980913: ("Gain", 0, 100, 7),
        0x0098090C: ("White Balance, Automatic", 0, 1, 1),
        0x00981900: ("Trigger Mode", 0, 1, 0),
        0x00981901: ("Software Trigger", 0, 1, 0),
    }

    def __init__(
        self, *codes: str, crops: bool = True, padding: int = 0, moves: bool = False
    ) -> None:
        self._codes = list(codes) or ["GREY"]
        self.moves = moves  # crops at any corner, and names the mosaic by its first pixel there
        self.crop = [0, 0, WIDTH, HEIGHT]
        self.code = self.codes[0]
        self.crops, self.padding = crops, padding
        self.values = {k: v[3] for k, v in self.CONTROLS.items()}
        self.size = (WIDTH, HEIGHT)
        self.interval = (1, 30)
        self.fault = 0  # errno of every call from now on
        self.broken_frames = 0
        self.lost_frames = 0
        self.stamps = FLAG.TIMESTAMP_MONOTONIC.value | FLAG.TSTAMP_SRC_SOE.value
        self.opened = 0
        self.streaming = False
        self.payload: bytes | None = None  # of every frame, as stored
        self.buffers: list[NDArray[np.uint8]] = []
        self.queued: deque[int] = deque()
        self.pending = 0  # software triggers not yet exposed
        self.sequence = 0
        self.stamp_ns: list[int] = []

    # ---- system calls

    def open(self, path: str) -> int:
        if path != PATH:
            raise failing(errno.ENOENT)
        if self.fault:
            raise failing(self.fault)
        if self.opened:
            raise failing(errno.EBUSY)
        self.opened += 1
        return 99

    def close(self, fd: int) -> None:
        assert fd == 99
        self.opened -= 1
        self.streaming, self.buffers = False, []

    def serial(self, path: str) -> str:
        return "42"

    def map(self, fd: int, length: int, offset: int) -> NDArray[np.uint8]:
        assert length == len(self.buffers[offset // 4096])
        return self.buffers[offset // 4096]

    def wait(self, fd: int, timeout_s: float) -> bool:
        if self.fault:
            return True  # as poll does: an error is an event
        ready = self.streaming and bool(self.queued) and (not self._waits() or self.pending > 0)
        if not ready:
            time.sleep(timeout_s)
        return ready

    def ioctl(self, fd: int, request: Any, argument: Any) -> None:
        assert fd == 99
        if self.fault:
            raise failing(self.fault)
        assert ctypes.sizeof(argument) == request.value >> 16 & 0x3FFF  # what the kernel copies
        getattr(self, f"_{request.name.lower()}")(argument)

    # ---- what the camera does

    @property
    def codes(self) -> list[str]:
        """Its formats, as it names them now."""
        if not self.moves:
            return self._codes
        k = self.crop[0] % 2 + self.crop[1] % 2 * 2
        return [MOSAICS[code][k] if code in MOSAICS else code for code in self._codes]

    def _waits(self) -> bool:
        return bool(self.values[0x00981900])

    def _stride(self) -> int:
        bits = {"Y12P": 12, "Y10P": 10, "RGB3": 24, "YUYV": 16, "MJPG": 0}
        bits |= dict.fromkeys(MOSAICS["pRCC"], 12)
        plain = 8 if self.code in {"GREY", "RGGB"} else 16
        return self.size[0] * bits.get(self.code, plain) // 8 + self.padding

    def _querycap(self, a: Any) -> None:
        a.card, a.driver = b"Toy Camera", b"toy"
        a.device_caps = raw.Capability.VIDEO_CAPTURE.value | raw.Capability.STREAMING.value

    def _enum_fmt(self, a: Any) -> None:
        if a.index >= len(self.codes):
            raise failing(errno.EINVAL)
        a.pixelformat = int.from_bytes(self.codes[a.index].encode(), "little")

    def _g_fmt(self, a: Any) -> None:
        pix = a.fmt.pix
        pix.width, pix.height = self.size
        pix.pixelformat = int.from_bytes(self.code.encode(), "little")
        pix.bytesperline = self._stride()

    def _s_fmt(self, a: Any) -> None:
        if self.buffers:
            raise failing(errno.EBUSY)
        pix = a.fmt.pix
        code = pix.pixelformat.to_bytes(4, "little").decode()
        self.code = code if code in self.codes else self.codes[0]
        sizes = [(WIDTH, HEIGHT), (32, 24), (self.crop[2], self.crop[3])]
        self.size = min(sizes, key=lambda s: abs(s[0] - pix.width) + abs(s[1] - pix.height))
        self._g_fmt(a)

    def _try_fmt(self, a: Any) -> None:
        before = self.code, self.size
        self._s_fmt(a)
        self.code, self.size = before

    def _g_selection(self, a: Any) -> None:
        if not self.crops:
            raise failing(errno.ENOTTY)
        a.r.left, a.r.top, a.r.width, a.r.height = self.crop

    def _s_selection(self, a: Any) -> None:
        a.r.width, a.r.height = min(a.r.width, WIDTH), min(a.r.height, HEIGHT)
        a.r.left = min(a.r.left, WIDTH - a.r.width)
        before = self.codes
        if not self.moves:
            a.r.left = a.r.left // 2 * 2
        self.crop = [a.r.left, a.r.top, a.r.width, a.r.height]
        self.code = self.codes[before.index(self.code)]

    def _g_parm(self, a: Any) -> None:
        period = a.parm.capture.timeperframe
        period.numerator, period.denominator = self.interval

    def _s_parm(self, a: Any) -> None:
        period = a.parm.capture.timeperframe
        rate = period.denominator / period.numerator
        self.interval = (1, min((15, 30, 60), key=lambda r: abs(r - rate)))
        self._g_parm(a)

    def _queryctrl(self, a: Any) -> None:
        assert a.id & raw.ControlFlag.NEXT_CTRL.value
        after = a.id & 0x0FFFFFFF
        later = sorted(k for k in self.CONTROLS if k > after)
        if not later:
            raise failing(errno.EINVAL)
        a.id = later[0]
        name, a.minimum, a.maximum, _ = self.CONTROLS[a.id]
        a.name, a.flags = name.encode(), 0

    def _g_ctrl(self, a: Any) -> None:
        a.value = self.values[a.id]

    def _s_ctrl(self, a: Any) -> None:
        _, low, high, _ = self.CONTROLS[a.id]
        if not low <= a.value <= high:
            raise failing(errno.ERANGE)
        if a.id == 0x00981901:
            self.pending += 1
        else:
            self.values[a.id] = a.value

    def _reqbufs(self, a: Any) -> None:
        assert not self.streaming
        size = max(self._stride() * self.size[1], 100_000 if self.code == "MJPG" else 0)
        self.buffers = [np.zeros(size, np.uint8) for _ in range(a.count)]
        self.queued.clear()

    def _querybuf(self, a: Any) -> None:
        a.length, a.m.offset = len(self.buffers[a.index]), 4096 * a.index

    def _qbuf(self, a: Any) -> None:
        assert a.index not in self.queued
        self.queued.append(a.index)

    def _streamon(self, a: Any) -> None:
        assert self.queued
        self.streaming, self.sequence, self.pending = True, 0, 0

    def _streamoff(self, a: Any) -> None:
        self.streaming = False
        self.queued.clear()

    def _dqbuf(self, a: Any) -> None:
        if not self.queued:
            raise failing(errno.EAGAIN)
        a.index = self.queued.popleft()
        self.pending = max(0, self.pending - 1)
        payload = self.payload or bytes(
            (np.arange(len(self.buffers[a.index])) + self.sequence).astype(np.uint8)
        )
        self.buffers[a.index][: len(payload)] = np.frombuffer(payload, np.uint8)
        a.bytesused, a.flags = len(payload), self.stamps
        if self.broken_frames:
            self.broken_frames -= 1
            a.bytesused //= 2
            a.flags |= FLAG.ERROR.value
        self.sequence += self.lost_frames
        self.lost_frames = 0
        a.sequence = self.sequence
        self.sequence += 1
        now = time.monotonic_ns() // 1000 * 1000
        self.stamp_ns.append(now)
        a.timestamp.secs, a.timestamp.usecs = now // 10**9, now % 10**9 // 1000


def make(toy: ToyCamera, **options: Any) -> V4l2Camera:
    options = {"path": PATH} | options
    return V4l2Camera("cam", msgspec.convert(options, V4l2Options), Context(), toy)


def connected(toy: ToyCamera, **options: Any) -> V4l2Camera:
    cam = make(toy, **options)
    cam.connect()
    return cam


def grab(cam: V4l2Camera, timeout_s: float = 1.0) -> Frame:
    info = cam.info()
    return cam.grab(np.empty(info.shape, info.pixel_format.dtype), timeout_s)


TRIGGERS = {"trigger_control": "trigger_mode", "software_trigger": "software_trigger"}


# ---------------------------------------------------------------- settings


def test_automatic_corrections_are_switched_off_and_settings_told() -> None:
    toy = ToyCamera("GREY", "Y16 ")
    cam = connected(toy)
    assert toy.values[0x009A0901] == raw.ExposureAutoType.MANUAL.value
    assert toy.values[0x0098090C] == 0
    identity = cam.connect()
    assert (identity.model, identity.serial) == ("Toy Camera", "42")
    got = cam.configure(
        CameraSettings(20_000.0, 12.0, PixelFormat.MONO16, 60.0, roi=(10, 4, 40, 30))
    )
    assert got == CameraSettings(20_000.0, 12.0, PixelFormat.MONO16, 60.0, (10, 4, 40, 30))
    assert cam.info().exposure_range_us == (100.0, 500_000.0)
    assert cam.info().shape == (30, 40)
    assert cam.info().triggers == ("none",)
    cam.connect()  # as after a loss
    assert cam.settings() == got


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        (CameraSettings(exposure_us=1e6), "exposure_time_absolute 10000 is out of range; choose 1"),
        (CameraSettings(gain=101.0), "gain 101 is out of range; choose 0 to 100"),
        (CameraSettings(frame_rate_hz=45.0), "frame rate 45 Hz is not possible"),
        (CameraSettings(pixel_format=PixelFormat.MONO12), "no pixel format Mono12; choose of"),
        (CameraSettings(roi=(3, 0, 32, 24)), r"the nearest is \[2, 0, 32, 24\]"),
    ],
)
def test_what_it_cannot_take_is_refused(wanted: CameraSettings, says: str) -> None:
    cam = connected(ToyCamera())
    before = cam.settings()
    with pytest.raises(DeviceRefused, match=says):
        cam.configure(wanted)
    assert cam.configure(CameraSettings()) == before


def test_options_are_checked_at_connect() -> None:
    for options, says in (
        (
            {"pixel_format": "H264"},
            "pixel format H264 is unknown; set `pixel_format` to one of GREY",
        ),
        ({"pixel_format": "Y12P"}, "64 x 48 Y12P is not possible, it would be 64 x 48 GREY"),
        ({"size": (640, 480)}, "640 x 480 GREY is not possible, it would be 64 x 48 GREY"),
        ({"controls": {"nope": 1}}, "it has no control nope; it has: auto_exposure"),
        ({"controls": {"gain": 1000}}, "gain 1000 is out of range"),
        ({"trigger_control": "nope"}, "it has no control nope"),
    ):
        toy = ToyCamera()
        with pytest.raises(DeviceRefused, match=f"cam: connect: {says}"):
            make(toy, **options).connect()
        assert toy.opened == 0  # nothing is held
    cam = connected(ToyCamera(crops=False), size=(32, 24), controls={"gain": 50})
    assert cam.info().shape == (24, 32)
    assert cam.settings().gain == 50
    with pytest.raises(DeviceRefused, match="no region of interest; choose a `size`"):
        cam.configure(CameraSettings(roi=(0, 0, 8, 8)))


@pytest.mark.parametrize(
    ("code", "kind", "says"),
    [
        (errno.ENOENT, DeviceLost, "plug it in"),
        (errno.EACCES, DeviceRefused, "join the group `video`"),
        (errno.EBUSY, DeviceRefused, "close the other program"),
    ],
)
def test_nodes_that_cannot_be_opened(code: int, kind: type[Exception], says: str) -> None:
    toy = ToyCamera()
    toy.fault = code
    with pytest.raises(kind, match=f"cam: connect: {PATH}: .*{says}"):
        make(toy).connect()


# ---------------------------------------------------------------- frames


def csi2_12(rows: NDArray[Any]) -> bytes:
    first, second = rows[:, 0::2], rows[:, 1::2]
    low = (first & 15) | (second & 15) << 4
    return np.stack([first >> 4, second >> 4, low], axis=-1).astype(np.uint8).tobytes()


@pytest.mark.parametrize("padding", [0, 8])
@pytest.mark.parametrize(
    ("code", "pixel_format"),
    [
        ("GREY", PixelFormat.MONO8),
        ("RGGB", PixelFormat.BAYER_RG8),
        ("Y12 ", PixelFormat.MONO12),
        ("RG12", PixelFormat.BAYER_RG12),
        ("Y12P", PixelFormat.MONO12),
        ("pRCC", PixelFormat.BAYER_RG12),
        ("RGB3", PixelFormat.RGB8),
    ],
)
def test_pixels_are_unpacked(code: str, pixel_format: PixelFormat, padding: int) -> None:
    shape = (HEIGHT, WIDTH, 3) if code == "RGB3" else (HEIGHT, WIDTH)
    picture = np.random.default_rng(0).integers(0, pixel_format.full_scale + 1, shape)
    rows = []
    for row in picture:
        if code in {"Y12P", "pRCC"}:
            line = csi2_12(row[None])
        else:
            line = row.astype(pixel_format.dtype).tobytes()
        rows.append(line + bytes(padding))
    toy = ToyCamera(code, padding=padding)
    toy.payload = b"".join(rows)
    cam = connected(toy)
    assert cam.info().pixel_format is pixel_format
    cam.start(Acquisition.FREE)
    np.testing.assert_array_equal(grab(cam).pixels, picture)


@pytest.mark.parametrize("code", ["RG12", "pRCC"])
@pytest.mark.parametrize("padding", [0, 5])
def test_a_mosaic_cut_at_an_odd_corner_is_named_anew(code: str, padding: int) -> None:
    sensor = np.random.default_rng(0).integers(0, 4096, (HEIGHT, WIDTH), np.uint16)
    toy = ToyCamera("GREY", code, padding=padding, moves=True)
    cam = connected(toy, pixel_format=code)
    regions = [(0, 0, 32, 24), (1, 0, 32, 24), (0, 3, 20, 12), (5, 7, 10, 8)]
    for k, roi in enumerate(regions):
        cam.configure(CameraSettings(roi=roi))
        order = ("RG", "GR", "GB", "BG")[k]
        assert cam.info().pixel_format is PixelFormat(f"Bayer{order}12")
        assert cam.facts()["pixel_format"] == MOSAICS[code][k]
        x, y, width, height = roi
        picture = sensor[y : y + height, x : x + width]
        rows = [csi2_12(r[None]) if code == "pRCC" else r.tobytes() for r in picture]
        toy.payload = b"".join(row + bytes(padding) for row in rows)
        cam.start(Acquisition.FREE)
        np.testing.assert_array_equal(grab(cam).pixels, picture)
        cam.stop()
    before = cam.settings()
    cam.connect()  # the camera kept its corner, the option names the format of another
    assert cam.settings() == before
    cam.configure(CameraSettings(roi=regions[0], pixel_format=PixelFormat.BAYER_BG12))
    assert cam.info().pixel_format is PixelFormat.BAYER_RG12


def test_what_webcams_have_is_decoded_to_rgb() -> None:
    colour = (200, 60, 30)
    ok, jpeg = cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), colour[::-1], np.uint8))
    assert ok
    y, u, v = 0.299 * 200 + 0.587 * 60 + 0.114 * 30, 0.0, 0.0
    u, v = 128 + 0.564 * (30 - y), 128 + 0.713 * (200 - y)
    studio = 16 + y * 219 / 255
    u, v = 128 + (u - 128) * 224 / 255, 128 + (v - 128) * 224 / 255
    pair = np.array([studio, u, studio, v]).round().astype(np.uint8)
    for code, payload in (
        ("MJPG", jpeg.tobytes()),
        ("YUYV", np.tile(pair, WIDTH * HEIGHT // 2).tobytes()),
    ):
        toy = ToyCamera(code)
        toy.payload = payload
        cam = connected(toy)
        cam.start(Acquisition.FREE)
        frame = grab(cam)
        assert np.abs(frame.pixels.reshape(-1, 3).mean(axis=0) - colour).max() < 5
        toy.payload = payload[: len(payload) // 2]
        with pytest.raises(DeviceGarbled, match=f"a {code} frame is broken"):
            grab(cam)


def test_times_are_the_kernels() -> None:
    toy = ToyCamera()
    cam = connected(toy, exposure_us=2000.0)
    cam.start(Acquisition.FREE)
    frame = grab(cam)
    # Both clocks are read one after the other, so they agree within that.
    assert abs(frame.start_ns - toy.stamp_ns[0]) < 5_000_000
    assert frame.end_ns - frame.start_ns == 2_000_000
    toy.stamps = FLAG.TIMESTAMP_MONOTONIC.value  # of the frame's end
    frame = grab(cam)
    assert abs(frame.end_ns - toy.stamp_ns[1]) < 5_000_000
    toy.stamps = 0
    before = time.monotonic_ns()
    frame = grab(cam)  # an unknown clock: timed by arrival
    assert abs(frame.end_ns - before) < 5_000_000_000
    assert frame.end_ns >= before


def test_lost_and_broken_frames_are_told() -> None:
    toy = ToyCamera()
    cam = connected(toy)
    cam.start(Acquisition.FREE)
    first = grab(cam)
    toy.lost_frames = 3
    second = grab(cam)
    toy.broken_frames = 1
    third, fourth = grab(cam), grab(cam)
    assert [f.sequence for f in (first, second, third, fourth)] == [0, 4, 5, 6]
    assert [f.incomplete for f in (first, second, third, fourth)] == [False, False, True, False]
    for _ in range(50):  # every buffer goes back
        grab(cam)


def test_triggers_by_the_controls_that_a_driver_has() -> None:
    toy = ToyCamera()
    cam = connected(toy, exposure_us=1000.0, **TRIGGERS)
    assert set(cam.info().triggers) == {"software", "hardware", "none"}
    cam.start(Acquisition.SOFTWARE)
    assert toy.values[0x00981900] == 1
    with pytest.raises(DeviceTimeout, match="trigger again"):
        grab(cam, 0.03)
    for _ in range(3):
        start, end = cam.trigger()
        assert end - start >= 1_000_000
        grab(cam)
    cam.start(Acquisition.HARDWARE)
    with pytest.raises(DeviceTimeout, match="check the trigger's wiring"):
        grab(cam, 0.03)
    cam.start(Acquisition.FREE)
    assert not toy.values[0x00981900]
    grab(cam)
    plain = connected(ToyCamera())
    with pytest.raises(DeviceRefused, match="it has no software trigger; it can only run free"):
        plain.start(Acquisition.SOFTWARE)


def test_unplugged_while_it_streams_and_back() -> None:
    toy = ToyCamera()
    cam = connected(toy, exposure_us=3000.0)
    settings = cam.configure(CameraSettings(gain=9.0))
    cam.start(Acquisition.FREE)
    grab(cam)
    toy.fault = errno.ENODEV
    with pytest.raises(DeviceLost, match="it was unplugged"):
        grab(cam)
    with pytest.raises(DeviceLost):
        cam.check()
    with pytest.raises(DeviceLost):
        cam.connect()
    cam.close()
    assert toy.opened == 0
    toy.fault = 0
    cam.connect()
    assert cam.settings() == settings
    cam.start(Acquisition.FREE)
    grab(cam)


def test_halt_ends_a_blocked_grab() -> None:
    cam = connected(ToyCamera(), **TRIGGERS)
    cam.start(Acquisition.HARDWARE)
    threading.Timer(0.05, cam.halt).start()
    with pytest.raises(DeviceRefused, match="grab: halted"):
        grab(cam, 30.0)


def test_scanning_needs_no_camera() -> None:
    assert isinstance(V4l2Camera.discover(), list)
