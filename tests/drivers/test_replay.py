from __future__ import annotations

import os
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, CameraSettings, Frame
from drivers.base.device import Context
from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceRefused, EndOfRecording
from drivers.base.pixelformat import PixelFormat
from drivers.recording import natural_key
from drivers.registry import build
from drivers.replay import ReplayCamera, ReplayOptions

FREE = Acquisition.FREE


def camera(path: Path, **options: Any) -> ReplayCamera:
    return ReplayCamera("cam", ReplayOptions(path=str(path), **options), Context())


def connected(path: Path, **options: Any) -> ReplayCamera:
    made = camera(path, **options)
    made.connect()
    return made


def picture(seed: int, size: tuple[int, ...] = (12, 16, 3), dtype: Any = np.uint8) -> NDArray[Any]:
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top, size, dtype, endpoint=True)


def write(path: Path, rgb: NDArray[Any], *flags: int) -> Path:
    stored = rgb if rgb.ndim == 2 else rgb[..., [2, 1, 0, *range(3, rgb.shape[2])]]
    assert cv2.imwrite(str(path), stored, flags)
    return path


def grab(cam: ReplayCamera) -> Frame:
    info = cam.info()
    return cam.grab(np.empty(info.shape, info.pixel_format.dtype), 5.0)


def grab_all(cam: ReplayCamera, at: int = 0) -> list[Frame]:
    cam.start(FREE, at=at)
    frames = []
    while True:
        try:
            frames.append(grab(cam))
        except EndOfRecording:
            return frames


def refusal(path: Path, **options: Any) -> str:
    with pytest.raises(DeviceRefused) as caught:
        connected(path, **options)
    error = caught.value
    assert error.phase == "connect"
    assert error.remedy
    assert "\n" not in str(error)
    return str(error)


# ---------------------------------------------------------------- frames as they were stored


@pytest.mark.parametrize(
    ("extension", "size", "dtype", "pixel_format"),
    [
        ("png", (12, 16, 3), np.uint8, PixelFormat.RGB8),
        ("png", (12, 16, 3), np.uint16, PixelFormat.RGB16),
        ("png", (12, 16), np.uint8, PixelFormat.MONO8),
        ("png", (12, 16), np.uint16, PixelFormat.MONO16),
        ("tiff", (12, 16, 3), np.uint8, PixelFormat.RGB8),
        ("tif", (12, 16, 3), np.uint16, PixelFormat.RGB16),
        ("tiff", (12, 16), np.uint16, PixelFormat.MONO16),
        ("bmp", (12, 15, 3), np.uint8, PixelFormat.RGB8),
        ("bmp", (12, 15), np.uint8, PixelFormat.MONO8),
        ("ppm", (12, 16, 3), np.uint8, PixelFormat.RGB8),
        ("ppm", (12, 16, 3), np.uint16, PixelFormat.RGB16),
        ("pgm", (12, 16), np.uint16, PixelFormat.MONO16),
    ],
)
def test_samples_come_back_as_they_were_stored(
    tmp_path: Path, extension: str, size: tuple[int, ...], dtype: Any, pixel_format: PixelFormat
) -> None:
    stored = [picture(k, size, dtype) for k in range(3)]
    for k, image in enumerate(stored):
        write(tmp_path / f"{k}.{extension}", image)
    cam = connected(tmp_path)
    info = cam.info()
    assert info.pixel_format is pixel_format
    assert info.shape == size
    assert info.recorded
    assert info.frame_count == 3
    frames = grab_all(cam)
    for frame, image in zip(frames, stored, strict=True):
        np.testing.assert_array_equal(frame.pixels, image)
        assert frame.pixels.flags.c_contiguous


def test_jpeg_comes_in_rgb_order_and_unrotated(tmp_path: Path) -> None:
    red = np.zeros((8, 24, 3), np.uint8)
    red[:, :, 0] = 200
    path = write(tmp_path / "red.jpg", red)
    exif = b"Exif\0\0" + b"MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 0x112, 3, 1, 6, 0, 0)
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    rotated = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert rotated is not None
    assert rotated.shape == (24, 8, 3)  # the tag does ask for it
    (frame,) = grab_all(connected(tmp_path))
    assert frame.pixels.shape == (8, 24, 3)
    assert frame.pixels[..., 0].min() > 190
    assert frame.pixels[..., 1:].max() < 10


def test_big_tiff_of_uncompressed_strips_is_read(tmp_path: Path) -> None:
    samples = picture(4, (3, 5), np.uint16)
    entries = [(256, 5), (257, 3), (258, 16), (259, 1), (262, 1), (273, 16), (277, 1), (278, 3)]
    entries.append((279, 30))
    pages = 16 + 30 + 2
    ifd = struct.pack("<Q", len(entries)) + b"".join(
        struct.pack("<HHQQ", tag, 4, 1, value) for tag, value in entries
    )
    head = b"II+\0" + struct.pack("<HHQ", 8, 0, pages)
    path = tmp_path / "big.tif"
    path.write_bytes(head + samples.tobytes() + b"\0\0" + ifd + struct.pack("<Q", 0))
    (frame,) = grab_all(connected(tmp_path))
    np.testing.assert_array_equal(frame.pixels, samples)


def test_opaque_alpha_is_dropped(tmp_path: Path) -> None:
    image = picture(0, (12, 16, 4))
    image[..., 3] = 255
    write(tmp_path / "a.png", image)
    (frame,) = grab_all(connected(tmp_path))
    np.testing.assert_array_equal(frame.pixels, image[..., :3])


@pytest.mark.parametrize(
    ("bits", "bayer", "pixel_format"),
    [
        (12, "RG", PixelFormat.BAYER_RG12),
        (12, "", PixelFormat.MONO12),
        (10, "GB", PixelFormat.BAYER_GB10),
        (14, "", PixelFormat.MONO14),
        (None, "BG", PixelFormat.BAYER_BG16),
    ],
)
def test_significant_bits_and_mosaic_are_told(
    tmp_path: Path, bits: int | None, bayer: str, pixel_format: PixelFormat
) -> None:
    full = (1 << (bits or 16)) - 1
    write(tmp_path / "a.png", np.full((4, 6), full, np.uint16))
    cam = connected(tmp_path, bits=bits, bayer=bayer)
    assert cam.info().pixel_format is pixel_format
    assert cam.info().pixel_format.full_scale == full
    (frame,) = grab_all(cam)
    assert frame.pixels.max() == full


def test_ppm_of_12_bits(tmp_path: Path) -> None:
    samples = picture(0, (4, 6, 3), np.uint16) >> 4
    head = b"P6\n# made by hand\n6 4\n4095\n"
    (tmp_path / "a.ppm").write_bytes(head + samples.astype(">u2").tobytes())
    cam = connected(tmp_path, bits=12)
    assert cam.info().pixel_format is PixelFormat.RGB12
    np.testing.assert_array_equal(grab_all(cam)[0].pixels, samples)


# ---------------------------------------------------------------- which files, in which order


def test_natural_order() -> None:
    names = ["shift_0_10", "shift_0_9", "shift_10_0", "frame10", "Frame2", "frame1", "9", "10", "a"]
    assert sorted(names, key=natural_key) == [
        *("9", "10", "a", "frame1", "Frame2", "frame10", "shift_0_9", "shift_0_10", "shift_10_0")
    ]


def test_files_come_in_natural_order_without_droppings(tmp_path: Path) -> None:
    for name in ("frame10", "frame2", "frame1"):
        write(tmp_path / f"{name}.png", picture(1))
    for dropping in (".DS_Store", "Thumbs.db", "desktop.ini", "._frame1.png"):
        (tmp_path / dropping).write_text("x")
    (tmp_path / "results").mkdir()
    frames = grab_all(connected(tmp_path))
    assert [f.source for f in frames] == ["frame1.png", "frame2.png", "frame10.png"]
    assert [f.sequence for f in frames] == [0, 1, 2]


def test_first_files_are_given_first_and_once(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    folder = tmp_path / "scan"
    folder.mkdir()
    black = write(elsewhere / "black.png", picture(0))
    for name in ("0", "1", "white"):
        write(folder / f"{name}.png", picture(1))
    frames = grab_all(connected(folder, first=(str(black), "white.png")))
    assert [f.source for f in frames] == ["black.png", "white.png", "0.png", "1.png"]


def test_match_chooses(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0))
    write(tmp_path / "b.png", picture(0, (3, 3)))
    (tmp_path / "notes.txt").write_text("f/8")
    assert [f.source for f in grab_all(connected(tmp_path, match="a*"))] == ["a.png"]


def test_an_interrupted_scan_goes_on_where_it_was(tmp_path: Path) -> None:
    for k in range(5):
        write(tmp_path / f"{k}.png", picture(k))
    cam = connected(tmp_path, rate_hz=10.0, exposure_us=2000.0)
    whole = grab_all(cam)
    rest = grab_all(cam, at=3)
    assert [f.source for f in rest] == ["3.png", "4.png"]
    assert [f.sequence for f in rest] == [3, 4]
    for again, before in zip(rest, whole[3:], strict=True):
        np.testing.assert_array_equal(again.pixels, before.pixels)
    assert np.diff([f.start_ns for f in whole]).tolist() == [100_000_000] * 4
    assert np.diff([f.utc_ns for f in whole]).tolist() == [100_000_000] * 4
    assert whole[0].end_ns - whole[0].start_ns == 2_000_000
    assert whole[0].exposure_us == 2000.0
    with pytest.raises(EndOfRecording, match="no frame 5"):
        cam.start(FREE, at=5)


def test_the_end_names_how_many_there_were(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0))
    cam = connected(tmp_path)
    cam.start(Acquisition.SOFTWARE)
    start, end = cam.trigger()
    assert start <= end
    grab(cam)
    for _ in range(2):  # and says so again
        with pytest.raises(EndOfRecording, match="after 1 frames"):
            grab(cam)


def test_halt_from_another_thread_ends_grabbing_until_started(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0))
    cam = connected(tmp_path)
    cam.start(FREE)
    cam.halt()
    with pytest.raises(DeviceRefused, match="halted"):
        grab(cam)
    assert len(grab_all(cam)) == 1
    cam.close()
    cam.close()
    with pytest.raises(DeviceRefused, match="not connected"):
        cam.start(FREE)


def test_settings_are_history(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0))
    cam = connected(tmp_path, exposure_us=5000.0)
    assert cam.configure(CameraSettings(exposure_us=5000.0)).roi == (0, 0, 16, 12)
    assert cam.settings().frame_rate_hz is None
    assert connected(tmp_path, rate_hz=12.0).settings().frame_rate_hz == 12.0
    with pytest.raises(DeviceRefused, match=r"exposure_us is 5000.0 and recorded, not 1.0"):
        cam.configure(CameraSettings(exposure_us=1.0))


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    for k in range(30):
        write(tmp_path / f"{k}.bmp", picture(k, (200, 300, 3)))
    cam = connected(tmp_path)
    out = np.empty(cam.info().shape, np.uint8)
    cam.start(FREE)
    tracemalloc.start()
    for _ in range(30):
        cam.grab(out, 5.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * out.nbytes


def test_the_registry_builds_it_and_refuses_unknown_options(tmp_path: Path) -> None:
    assert isinstance(
        build("camera", "replay", "cam", {"path": str(tmp_path), "first": []}, Context()),
        ReplayCamera,
    )
    with pytest.raises(msgspec.ValidationError, match="bits"):
        build("camera", "replay", "cam", {"path": str(tmp_path), "bits": 11}, Context())


# ---------------------------------------------------------------- bad input


def test_missing_and_empty_folders(tmp_path: Path) -> None:
    assert "nowhere is not there" in refusal(tmp_path / "nowhere")
    assert "has no images" in refusal(tmp_path)
    (tmp_path / "scan1").mkdir()
    assert "give one of its folders (scan1)" in refusal(tmp_path)
    write(tmp_path / "a.png", picture(0))
    assert "match '*.tif'" in refusal(tmp_path, match="*.tif")


@pytest.mark.parametrize(
    ("odd", "says"),
    [
        (picture(0, (9, 16, 3)), "odd.png is 16 x 9 8-bit colour, 0.png is 16 x 12 8-bit colour"),
        (picture(0, (12, 16, 3), np.uint16), "odd.png is 16 x 12 16-bit colour"),
        (picture(0, (12, 16)), "odd.png is 16 x 12 8-bit grey"),
    ],
)
def test_frames_that_are_not_alike(tmp_path: Path, odd: NDArray[Any], says: str) -> None:
    for k in range(3):
        write(tmp_path / f"{k}.png", picture(k))
    write(tmp_path / "odd.png", odd)
    assert says in refusal(tmp_path)


@pytest.mark.parametrize("extension", ["png", "jpg", "tif", "bmp", "ppm"])
@pytest.mark.parametrize("part", [0.02, 0.3, 0.6, 0.999])
def test_truncated_files(tmp_path: Path, extension: str, part: float) -> None:
    for k in range(2):
        write(tmp_path / f"{k}.{extension}", picture(k, (60, 80, 3)))
    broken = write(tmp_path / f"broken.{extension}", picture(9, (60, 80, 3)))
    data = broken.read_bytes()
    broken.write_bytes(data[: int(len(data) * part)])
    says = refusal(tmp_path)
    assert f"broken.{extension} is truncated" in says or part == 0.02
    assert f"broken.{extension}" in says


def test_progressive_jpeg_is_followed_to_its_end(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", picture(0, (64, 64, 3)), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    assert len(grab_all(connected(tmp_path))) == 1
    path.write_bytes(path.read_bytes()[:-2])
    assert "a.jpg is truncated" in refusal(tmp_path)


def test_a_flipped_bit_in_a_png(tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", picture(0, (60, 80, 3)))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert "a.png is corrupt" in refusal(tmp_path)


def test_files_that_are_no_images(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0))
    notes = tmp_path / "notes.txt"
    notes.write_text("exposed at f/8\n")
    says = refusal(tmp_path)
    assert "notes.txt is not an image" in says
    assert "`match`" in says
    notes.write_bytes(b"")
    assert "notes.txt is empty" in refusal(tmp_path)
    notes.unlink()
    notes.symlink_to(tmp_path / "gone")
    assert "notes.txt cannot be read (No such file or directory)" in refusal(tmp_path)
    notes.unlink()
    notes.symlink_to(notes)
    assert "notes.txt cannot be read (Too many levels of symbolic links)" in refusal(tmp_path)
    notes.unlink()
    os.mkfifo(notes)  # nobody ever writes to it
    assert "notes.txt is no file" in refusal(tmp_path)
    assert "notes.txt is no file" in refusal(notes)


def test_a_first_file_that_is_missing(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0))
    assert "black.png cannot be read" in refusal(tmp_path, first=("black.png",))


def test_transparency_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0, (12, 16, 4)))
    assert "a.png is partly transparent" in refusal(tmp_path)


def test_float_tiff_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.tiff", np.ones((4, 4), np.float32))
    assert "a.tiff holds floating-point samples" in refusal(tmp_path)


def test_a_tiff_of_many_pages_is_refused(tmp_path: Path) -> None:
    assert cv2.imwritemulti(str(tmp_path / "a.tiff"), [picture(0), picture(1)])
    assert "a.tiff holds 2 pages" in refusal(tmp_path)


def directory(**tags: int) -> bytes:
    """A TIFF's directory of 32-bit tags, of a 4 x 2 grey picture unless they say otherwise."""
    own = {"t256": 4, "t257": 2, "t258": 8, "t259": 1, "t262": 1, "t273": 16, "t277": 1, "t279": 8}
    entries = sorted((int(name[1:]), value) for name, value in (own | tags).items())
    packed = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    return struct.pack("<H", len(entries)) + packed + struct.pack("<I", 0)


def small_tiff(mark: bytes = bytes(8), below: dict[str, int] | None = None, **tags: int) -> bytes:
    """4 x 2 grey pixels; with further tags, and a page `below` this one."""
    samples = bytes(range(8))
    if below is None:
        return b"II*\0" + struct.pack("<I", 24) + mark + samples + directory(**tags)
    under = directory(**below)
    at = 24 + len(under)
    page = directory(**tags, t330=24)
    return b"II*\0" + struct.pack("<I", at) + mark + samples + under + page


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("DSC_0001.NEF", small_tiff()),  # by its name
        ("a.cr3", b"\0\0\0\x18ftypcrx "),
        ("a.tif", small_tiff(below={"t262": 32803})),  # a picture for viewing over a mosaic
        ("a.tif", small_tiff(t50706=0x0401)),  # DNGVersion
        ("a.tif", small_tiff(t262=34892)),  # linear DNG
        ("a.tif", small_tiff(b"CR\x02\0" + bytes(4))),  # CR2
    ],
)
def test_a_cameras_raw_file_is_refused_and_how_to_convert_it_said(
    tmp_path: Path, name: str, data: bytes
) -> None:
    (tmp_path / name).write_bytes(data)
    said = refusal(tmp_path)
    assert f"{name} is a camera's raw file" in said
    assert "dcraw -D -4 -T -t 0" in said
    assert "`bayer`" in said


def test_a_tiff_with_a_smaller_picture_below_is_no_raw_file(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(small_tiff(below={"t254": 1}))
    (frame,) = grab_all(connected(tmp_path))
    np.testing.assert_array_equal(frame.pixels, np.arange(8, dtype=np.uint8).reshape(2, 4))


def test_options_that_contradict_the_files(tmp_path: Path) -> None:
    write(tmp_path / "a.png", picture(0))
    assert "`bits` says 12" in refusal(tmp_path, bits=12)
    assert "`bayer` says" in refusal(tmp_path, bayer="RG")
    folder = tmp_path / "shifted"
    folder.mkdir()
    write(folder / "a.png", np.full((4, 4), 0xFFF0, np.uint16))
    assert "a.png has counts up to 65520, but 12 bits end at 4095" in refusal(folder, bits=12)


def test_a_file_that_changes_during_the_scan(tmp_path: Path) -> None:
    for k in range(3):
        write(tmp_path / f"{k}.png", picture(k))
    cam = connected(tmp_path)
    write(tmp_path / "2.png", picture(0, (5, 5)))
    cam.start(FREE)
    grab(cam)
    grab(cam)
    with pytest.raises(DeviceGarbled, match=r"2\.png changed"):
        grab(cam)


def test_a_folder_that_goes_away(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    folder.mkdir()
    path = write(folder / "a.png", picture(0))
    cam = connected(folder)
    cam.check()
    path.unlink()
    folder.rmdir()
    with pytest.raises(DeviceLost, match="has gone"):
        cam.check()


# ---------------------------------------------------------------- video


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """20 frames of MJPEG, frame k of red 10 k and blue 200."""
    path = tmp_path / "sweep.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for k in range(20):
        frame = np.zeros((48, 64, 3), np.uint8)
        frame[..., 0] = 200
        frame[..., 2] = 10 * k
        writer.write(frame)
    writer.release()
    return path


def test_video_frames_in_order_and_rgb(video: Path) -> None:
    cam = connected(video)
    info = cam.info()
    assert info.shape == (48, 64, 3)
    assert info.pixel_format is PixelFormat.RGB8
    assert info.frame_count == 20
    assert info.max_rate_hz == 25.0
    frames = grab_all(cam)
    assert len(frames) == 20
    for k, frame in enumerate(frames):
        assert abs(float(frame.pixels[..., 0].mean()) - 10 * k) < 4
        assert abs(float(frame.pixels[..., 2].mean()) - 200) < 4
    assert frames[7].source == "sweep.avi#7"
    assert frames[1].start_ns - frames[0].start_ns == 40_000_000


def test_video_seeks_exactly_and_after_first_files(video: Path, tmp_path: Path) -> None:
    write(tmp_path / "black.png", np.zeros((48, 64, 3), np.uint8))
    cam = connected(video, first=("black.png",))
    assert cam.info().frame_count == 21
    whole = grab_all(cam)
    assert [f.source for f in whole[:3]] == ["black.png", "sweep.avi#0", "sweep.avi#1"]
    rest = grab_all(cam, at=14)
    assert rest[0].source == "sweep.avi#13"
    np.testing.assert_array_equal(rest[0].pixels, whole[14].pixels)
    assert len(rest) == 7


def test_a_video_shorter_than_its_header_says(video: Path) -> None:
    data = video.read_bytes()
    video.write_bytes(data[: len(data) * 8 // 10])
    cam = connected(video)
    count = cam.info().frame_count
    assert count is not None
    assert 5 < count < 20
    assert len(grab_all(cam)) == count


def test_paths_that_are_no_video(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("not a video\n" * 500)
    assert "notes.txt is neither a folder nor a video" in refusal(text)
    assert "is one image" in refusal(write(tmp_path / "a.png", picture(0)))
    noise = tmp_path / "noise.avi"
    noise.write_bytes(bytes(5000))
    assert "noise.avi is not a video that can be read" in refusal(noise)


def test_a_mosaic_in_a_grey_video(tmp_path: Path, video: Path) -> None:
    path = tmp_path / "raw.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (16, 12), False)
    mosaic = picture(0, (12, 16))
    writer.write(mosaic)
    writer.release()
    cam = connected(path, bayer="GR")
    assert cam.info().pixel_format is PixelFormat.BAYER_GR8
    np.testing.assert_array_equal(grab_all(cam)[0].pixels, mosaic)
    wrong = connected(video, bayer="GR")
    wrong.start(FREE)
    with pytest.raises(DeviceRefused, match="in colour, not a mosaic"):
        grab(wrong)
