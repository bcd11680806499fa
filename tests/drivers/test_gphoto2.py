"""The gphoto2 driver over libgphoto2's virtual camera, that takes pictures of a folder's files."""

from __future__ import annotations

import atexit
import os
import shutil
import struct
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

FOLDER = Path(tempfile.mkdtemp())
atexit.register(shutil.rmtree, FOLDER, ignore_errors=True)
os.environ["VCAMERADIR"] = str(FOLDER)  # read when the library is loaded

from drivers.base.camera import Acquisition, CameraSettings, Frame  # noqa: E402
from drivers.base.device import Context  # noqa: E402
from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout  # noqa: E402
from drivers.base.pixelformat import PixelFormat  # noqa: E402
from drivers.imagefile import BadImage  # noqa: E402
from drivers.registry import UnknownDriver, load  # noqa: E402

try:
    load("camera", "gphoto2")
except UnknownDriver as missing:
    pytest.skip(str(missing), allow_module_level=True)

import gphoto2 as gp  # noqa: E402

from drivers.gphoto2 import GphotoCamera, GphotoOptions  # noqa: E402
from drivers.gphoto2config import number  # noqa: E402
from drivers.rawfile import develop  # noqa: E402


def dng(
    mosaic: np.ndarray[Any, Any],
    *,
    white: int = 16383,
    black: int = 512,
    order: str = "RG",
    margins: tuple[int, int] = (0, 0),
) -> bytes:
    """A mosaic as an uncompressed RAW file; `margins` are rows and columns before the picture."""
    top, left = margins
    cells = {"RG": (0, 1, 1, 2), "GR": (1, 0, 2, 1), "GB": (1, 2, 0, 1), "BG": (2, 1, 1, 0)}[order]
    height, width = mosaic.shape
    data = mosaic.astype("<u2").tobytes()
    matrix = struct.pack("<18i", *(v for k in range(9) for v in (int(k % 4 == 0), 1)))
    area = struct.pack("<4I", top, left, height, width)
    entries = [
        (254, 4, 1, 0),
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, 16),
        (259, 3, 1, 1),
        (262, 3, 1, 32803),
        (271, 2, 4, b"Toy\0"),
        (272, 2, 4, b"Raw\0"),
        (273, 4, 1, 0),
        (277, 3, 1, 1),
        (278, 4, 1, height),
        (279, 4, 1, len(data)),
        (33421, 3, 2, struct.pack("<HH", 2, 2)),
        (33422, 1, 4, bytes(cells)),
        (50706, 1, 4, bytes([1, 4, 0, 0])),
        (50708, 2, 4, b"Toy\0"),
        (50714, 4, 1, black),
        (50717, 4, 1, white),
        (50721, 10, 9, matrix),
        (50829, 4, 4, area),
    ]
    after = 8 + 2 + 12 * len(entries) + 4
    strip = after + len(matrix) + len(area)
    ifd = b""
    for tag, kind, count, stated in entries:
        value = {273: strip, 50721: after, 50829: after + len(matrix)}.get(tag, stated)
        packed = value if isinstance(value, bytes) else struct.pack("<I", value)
        ifd += struct.pack("<HHI", tag, kind, count) + packed
    head = b"II*\0" + struct.pack("<IH", 8, len(entries))
    return head + ifd + struct.pack("<I", 0) + matrix + area + data


def before_the_lens(data: bytes) -> None:
    (FOLDER / "a.jpg").write_bytes(data)


def jpeg(colour: tuple[int, int, int] = (200, 40, 90), size: tuple[int, int] = (48, 64)) -> bytes:
    ok, data = cv2.imencode(".jpg", np.full((*size, 3), colour[::-1], np.uint8))
    assert ok
    return data.tobytes()


def make(**options: Any) -> GphotoCamera:
    return GphotoCamera("cam", msgspec.convert(options, GphotoOptions), Context())


@pytest.fixture
def cam() -> Iterator[GphotoCamera]:
    before_the_lens(jpeg())
    made = make(exposure_us=10_000.0)
    made.connect()
    yield made
    made.close()


def grab(cam: GphotoCamera, timeout_s: float = 3.0) -> Frame:
    info = cam.info()
    return cam.grab(np.empty(info.shape, info.pixel_format.dtype), timeout_s)


def test_it_is_found_and_named() -> None:
    before_the_lens(jpeg())
    (found,) = GphotoCamera.discover()
    assert found["serial"] == "0.1"
    options = dict(found["options"])
    assert options.pop("driver") == "gphoto2"
    cam = make(**options)
    assert cam.connect().serial == "0.1"
    cam.check()
    cam.close()
    cam.close()
    with pytest.raises(DeviceRefused, match="not connected"):
        cam.check()
    with pytest.raises(DeviceLost, match=r"no camera 77 \(found: .* 0\.1\)"):
        make(serial="77").connect()


def test_a_jpeg_per_trigger_in_rgb_order(cam: GphotoCamera) -> None:
    assert cam.info().shape == (48, 64, 3)
    assert cam.info().pixel_format is PixelFormat.RGB8
    cam.start(Acquisition.SOFTWARE)
    for k in range(3):
        start, end = cam.trigger()
        frame = grab(cam)
        assert (frame.sequence, frame.start_ns, frame.end_ns) == (k, start, end)
        assert end - start >= 10_000_000
        assert abs(frame.pixels.reshape(-1, 3).mean(axis=0) - (200, 40, 90)).max() < 4
    with pytest.raises(DeviceTimeout, match="then trigger again"):
        grab(cam, 0.1)


def test_a_late_picture_is_never_taken_for_the_next(cam: GphotoCamera) -> None:
    cam.start(Acquisition.SOFTWARE)
    cam.trigger()
    with pytest.raises(DeviceTimeout):
        grab(cam, 0.0)
    start, _ = cam.trigger()
    assert grab(cam).start_ns == start
    with pytest.raises(DeviceTimeout):
        grab(cam, 0.2)


def test_raw_gives_the_sensors_own_counts() -> None:
    mosaic = np.random.default_rng(0).integers(500, 16383, (64, 96), np.uint16)
    before_the_lens(dng(mosaic))
    cam = make()
    cam.connect()
    info = cam.info()
    assert info.pixel_format is PixelFormat.BAYER_RG14
    assert info.black_level == 512
    cam.start(Acquisition.SOFTWARE)
    cam.trigger()
    np.testing.assert_array_equal(grab(cam).pixels, mosaic)
    cam.close()


@pytest.mark.parametrize(
    ("order", "margins"), [("RG", (0, 0)), ("GR", (1, 3)), ("GB", (2, 1)), ("BG", (1, 2))]
)
def test_raw_of_12_bits_keeps_its_order_whatever_lies_before_the_picture(
    order: str, margins: tuple[int, int]
) -> None:
    """LibRaw cuts at even rows and columns: what comes begins with another colour then."""
    mosaic = np.random.default_rng(0).integers(0, 4096, (64, 96), np.uint16)
    before_the_lens(dng(mosaic, white=4095, black=256, order=order, margins=margins))
    cam = make()
    cam.connect()
    try:
        top, left = (margin + margin % 2 for margin in margins)
        height, width = (64 - top) // 2 * 2, (96 - left) // 2 * 2
        cells = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}[order]
        rows = [(top - margins[0]) % 2 * 2 + (left + k - margins[1]) % 2 for k in (0, 1)]
        first = "".join(cells[k] for k in rows)
        assert cam.info().pixel_format is PixelFormat(f"Bayer{first}12")
        assert cam.info().black_level == 256
        cam.start(Acquisition.SOFTWARE)
        cam.trigger()
        np.testing.assert_array_equal(
            grab(cam).pixels, mosaic[top : top + height, left : left + width]
        )
    finally:
        cam.close()


def test_the_nearest_step_of_exposure_is_set_and_told(cam: GphotoCamera) -> None:
    assert np.allclose(cam.info().exposure_range_us, (100, 1e6))
    assert cam.configure(CameraSettings(exposure_us=52_000.0)).exposure_us == pytest.approx(50_000)
    for wanted, says in (
        (CameraSettings(exposure_us=33_000.0), r"the nearest is 0.0500s; it has 0.0001 to 1"),
        (CameraSettings(exposure_us=9e6), "the nearest is 1.0000s"),
        (CameraSettings(gain=100.0), "it has no iso to set"),
        (CameraSettings(frame_rate_hz=5.0), "it has no frame rate"),
        (CameraSettings(roi=(0, 0, 8, 8)), "it has no region of interest"),
        (CameraSettings(pixel_format=PixelFormat.BAYER_RG14), "it delivers RGB8, not BayerRG14"),
    ):
        with pytest.raises(DeviceRefused, match=says):
            cam.configure(wanted)
    cam.connect()
    assert cam.settings().exposure_us == pytest.approx(50_000)


def test_its_own_settings_are_checked() -> None:
    before_the_lens(jpeg())
    cam = make(config={"f-number": "f/8"})
    cam.connect()
    cam.close()
    with pytest.raises(DeviceRefused, match=r"f-number cannot be f/99; choose of f/2\.8"):
        make(config={"f-number": "f/99"}).connect()
    with pytest.raises(DeviceRefused, match="it has no setting nope"):
        make(config={"nope": "1"}).connect()


def test_pictures_that_change_or_break(cam: GphotoCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    cam.start(Acquisition.SOFTWARE)
    monkeypatch.setattr(cam, "_fetch", lambda where: jpeg(size=(24, 32)))
    cam.trigger()
    with pytest.raises(DeviceGarbled, match="a 32 x 24 RGB8 picture came, not 64 x 48"):
        grab(cam)
    monkeypatch.setattr(cam, "_fetch", lambda where: jpeg()[:-2])
    cam.trigger()
    with pytest.raises(DeviceGarbled, match="its picture is truncated"):
        grab(cam)
    with pytest.raises(BadImage, match="neither JPEG nor RAW"):
        develop(b"text" * 100)


@pytest.mark.parametrize(
    ("code", "kind", "says"),
    [
        (gp.GP_ERROR_IO, DeviceLost, "connect again"),
        (gp.GP_ERROR_IO_READ, DeviceLost, "connect again"),
        (gp.GP_ERROR_IO_USB_FIND, DeviceLost, "connect again"),
        (gp.GP_ERROR_IO_USB_CLAIM, DeviceRefused, "another program holds it"),
        (gp.GP_ERROR_CAMERA_BUSY, DeviceTimeout, "wait until its card is written"),
        (gp.GP_ERROR_TIMEOUT, DeviceTimeout, "connect again"),
        (gp.GP_ERROR_NO_SPACE, DeviceRefused, "empty its card"),
    ],
)
def test_what_the_library_says_has_a_name_and_a_remedy(
    cam: GphotoCamera, code: int, kind: type[Exception], says: str
) -> None:
    """Unplugged, held by a desktop, busy, full: at each call that talks to the camera."""
    error: BaseException = gp.GPhoto2Error(code)

    class Failing:
        def __getattr__(self, name: str) -> Any:
            def call(*arguments: Any) -> Any:
                raise error

            return call

    cam.start(Acquisition.SOFTWARE)
    whole, cam._camera = cam._camera, Failing()
    calls: dict[str, Callable[[], object]] = {
        "check": cam.check,
        "trigger": cam.trigger,
        "grab": lambda: grab(cam),
        "start": lambda: cam.start(Acquisition.SOFTWARE),
    }
    for phase, call in calls.items():
        with pytest.raises(kind, match=f"cam: {phase}: .*{says}"):
            call()
        cam._acquisition = Acquisition.SOFTWARE
    cam.safe()
    cam.close()  # one that is gone is let go of all the same
    whole.exit()
    cam.connect()
    cam.start(Acquisition.SOFTWARE)
    cam.trigger()
    assert not grab(cam).incomplete


def test_halt_ends_a_blocked_grab(cam: GphotoCamera) -> None:
    cam.start(Acquisition.HARDWARE)
    threading.Timer(0.05, cam.halt).start()
    with pytest.raises(DeviceRefused, match="grab: halted"):
        grab(cam, 30.0)
    with pytest.raises(DeviceRefused, match="cannot run free"):
        cam.start(Acquisition.FREE)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1/125", 1 / 125),
        ("0.0100s", 0.01),
        ('2"', 2.0),
        ("30", 30.0),
        ("0.3", 0.3),
        ("10/13 sec", 10 / 13),
        ("Bulb", None),
        ("Auto", None),
        ("1/0", None),
        ("0", None),
        ("", None),
    ],
)
def test_how_cameras_write_numbers(text: str, value: float | None) -> None:
    assert number(text) == (None if value is None else pytest.approx(value))
