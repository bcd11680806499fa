"""Where products go, pictures, the private daemon's configuration, and how fast it starts."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from protocol.cli.delivery import Delivery, make_folder
from protocol.cli.picture import in_terminal, png
from protocol.cli.private import configured, toml
from protocol.cli.separate import as_typed, curved
from protocol.errors import UmbraError


def deliver(folder: Path, *, force: bool = False, fail: bool = False) -> None:
    delivery = Delivery(folder, force=force)
    with delivery.receive() as filling:
        (filling / "direct.tiff").write_bytes(b"new")
        if fail:
            raise UmbraError("internal", "half-way")  # type: ignore[arg-type]
        (filling / "global.tiff").write_bytes(b"new")


def test_a_new_folder_appears_whole(tmp_path: Path) -> None:
    deliver(tmp_path / "a")
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["direct.tiff", "global.tiff"]
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_a_folders_parents_are_not_made(tmp_path: Path) -> None:
    """A mistyped path must not become a tree of folders."""
    with pytest.raises(UmbraError, match=r"there is no folder .*/reslts to make today in"):
        Delivery(tmp_path / "reslts" / "today").check()
    with pytest.raises(UmbraError, match=r"cannot make .*today: No such file"):
        make_folder(tmp_path / "reslts" / "today")
    assert not [*tmp_path.iterdir()]


def test_an_existing_folder_keeps_its_other_files(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    deliver(tmp_path)
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["direct.tiff", "global.tiff", "notes.txt"]


@pytest.mark.parametrize("new", [True, False])
def test_an_error_leaves_nothing(new: bool, tmp_path: Path) -> None:
    folder = tmp_path / "out" if new else tmp_path
    with pytest.raises(UmbraError, match="half-way"):
        deliver(folder, fail=True)
    assert not list(tmp_path.iterdir())


def test_products_are_not_overwritten_without_force(tmp_path: Path) -> None:
    (tmp_path / "global.tiff").write_bytes(b"old")
    with pytest.raises(UmbraError, match=r"already has global\.tiff"):
        Delivery(tmp_path).check()
    with pytest.raises(UmbraError, match=r"already has global\.tiff"):
        deliver(tmp_path)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
    deliver(tmp_path, force=True)
    assert (tmp_path / "global.tiff").read_bytes() == b"new"


@pytest.mark.parametrize("below", [".", "new"])
def test_a_read_only_folder_is_refused_whoever_asks(below: str, tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(UmbraError, match="read-only"):
            Delivery(tmp_path / below).check()
    finally:
        tmp_path.chmod(0o755)


def test_a_file_is_not_a_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    for path in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(UmbraError, match="is not a folder"):
            Delivery(path).check()


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
def test_png_is_what_opencv_reads(shape: tuple[int, ...]) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    read = cv2.imdecode(np.frombuffer(png(pixels), np.uint8), cv2.IMREAD_UNCHANGED)
    assert read is not None
    expected = pixels if len(shape) == 2 else pixels[..., ::-1]
    assert np.array_equal(read, expected)


def test_png_of_something_else_is_refused() -> None:
    with pytest.raises(ValueError, match="not a picture"):
        png(np.zeros((2, 2, 4), np.uint8))


def test_a_picture_in_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLORTERM", "truecolor")
    monkeypatch.delenv("NO_COLOR", raising=False)
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:20, :, 0] = 255  # red above, black below
    lines = in_terminal(pixels, columns=30, lines=40).split("\n")
    assert len(lines) == 10
    assert all(line.count("▀") == 30 for line in lines)
    assert lines[0].startswith("\x1b[38;2;255;0;0m\x1b[48;2;255;0;0m▀▀")
    assert lines[-1].startswith("\x1b[38;2;0;0;0m")
    assert in_terminal(pixels, columns=200, lines=5).count("\n") == 4


def test_a_picture_without_24_bit_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLORTERM", raising=False)
    monkeypatch.delenv("NO_COLOR", raising=False)
    pixels = np.full((2, 2, 3), (255, 0, 0), np.uint8)
    assert "\x1b[38;5;196m" in in_terminal(pixels, 2, 1)
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b[38;5;239m" in in_terminal(pixels, 2, 1)


def test_tables_of_one_name_are_read_back() -> None:
    lights = [{"name": "lamp", "driver": "virtual"}, {"name": "sun", "driver": "virtual"}]
    assert tomllib.loads(toml({"light": lights, "rig": {"name": "x"}}))["light"] == lights


def test_toml_is_read_back() -> None:
    tables = {
        "camera": {"path": 'a "b"\\c\n\x7f é 📷', "first": ["x", "y"], "n": 3, "on": True},
        "rig": {"time_scale": 2.5},
    }
    assert tomllib.loads(toml(tables)) == tables
    assert tomllib.loads(toml({"camera": {"bayer": None}})) == {"camera": {}}


def test_a_private_daemon_keeps_to_its_folder() -> None:
    tables = configured({"rig": {"time_scale": 4.0}, "camera": {"driver": "x"}}, Path("/tmp/u"))
    assert tables["rig"] == {"time_scale": 4.0, "name": "private", "data": "/tmp/u/data"}
    assert tables["network"] == {"command": "ipc:///tmp/u/command", "events": "ipc:///tmp/u/events"}
    assert tables["camera"] == {"driver": "x"}


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        (["--help"], ["zmq", "numpy", "rich", "cv2", "zarr", "pydantic"]),
        (["status", "--rig", "nonsense"], ["rich", "cv2", "zarr", "pydantic"]),
    ],
)
def test_what_a_quick_command_does_not_import(arguments: list[str], absent: list[str]) -> None:
    code = (
        "import sys; from protocol.cli.app import run; "
        f"run({arguments!r}); print(*[m for m in {absent!r} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=30
    )
    assert done.stderr.splitlines()[-1].strip() == ""


def test_a_recordings_keys_are_named_as_they_were_typed() -> None:
    said = as_typed("no images that match 'x*'; check `path` and `match`, leave `loop` out")
    assert said == "no images that match 'x*'; check DIR and --match, leave `loop` out"


def test_jpeg_and_video_are_seldom_linear(tmp_path: Path) -> None:
    for name in ("a.png", "b.JPG", "stick.avi"):
        (tmp_path / name).touch()
    assert curved(tmp_path)
    assert curved(tmp_path / "stick.avi")
    assert not curved(tmp_path, "*.png")
