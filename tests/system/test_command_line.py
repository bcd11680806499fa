"""`umbra demo` and `umbra separate` as their users run them: real processes, real files."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.system.harness import until

pytestmark = pytest.mark.system

PRODUCTS = ["direct.tiff", "global.tiff", "preview.png", "quality.json", "quality.png",
            "report.html"]  # fmt: skip
SIZE = (48, 64)
UMBRA = [sys.executable, "-m", "protocol.cli"]


@pytest.fixture(autouse=True)
def _own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Where temporary files go: a short path, for a private daemon's sockets are in there."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))  # of a daemon with no data folder
    monkeypatch.delenv("UMBRA_RIG", raising=False)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        yield


def umbra(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*UMBRA, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=100,
        check=False,
    )


def scene() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Direct with texture, global without: 8-bit counts of a made-up scene, RGB."""
    rng = np.random.default_rng(7)
    direct = rng.uniform(30, 120, (*SIZE, 3))
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    smooth = 40 + 30 * np.sin(x / 20) * np.cos(y / 15)
    return direct, smooth[..., None] * np.array([1.0, 0.8, 0.5])


def checker(shift_y: int, shift_x: int) -> NDArray[np.bool_]:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    lit: NDArray[np.bool_] = (((y + shift_y) // 8) + ((x + shift_x) // 8)) % 2 == 0
    return lit[..., None]


def write(path: Path, image: NDArray[np.float64]) -> None:
    assert cv2.imwrite(str(path), np.round(image).astype(np.uint8)[..., ::-1])


def write_shifts(folder: Path, ambient: float = 0.0) -> Path:
    """The 25 photographs of the scene under checkerboards; projector pixels are image pixels."""
    folder.mkdir(parents=True)
    direct, global_ = scene()
    for n in range(25):
        lit = checker(3 * (n // 5), 3 * (n % 5))
        write(folder / f"shot{n}.png", lit * direct + global_ / 2 + ambient)
    return folder


def read(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image[..., ::-1]


def daemons() -> list[str]:
    """The command lines of private daemons that work in this test's temporary folder."""
    mark = os.environ["TMPDIR"].encode()
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = entry.read_bytes()
        except OSError:
            continue  # it has ended meanwhile
        if mark in line and b"daemon.app" in line:
            found.append(line.decode())
    return found


def assert_no_orphan(tmp_path: Path) -> None:
    """Neither a process nor a file of a private daemon is left, here or in the user's state."""
    assert not (tmp_path / "state").exists()
    assert not daemons()
    assert not list(Path(os.environ["TMPDIR"]).glob("umbra-*"))


def test_demo(tmp_path: Path) -> None:
    done = umbra("demo", "--speed", "4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "umbra-demo"
    assert set(PRODUCTS) <= {p.name for p in out.iterdir()}
    assert "direct  RMSE 0.0" in done.stdout
    assert "global  RMSE 0.0" in done.stdout
    assert "carry no flag; the RMSE is over these" in done.stdout
    assert "25/27" in done.stderr or "27/27" in done.stderr
    direct, truth = read(out / "direct.tiff"), read(out / "truth_direct.tiff")
    assert direct.dtype == np.float32
    good = np.isfinite(direct)
    assert np.sqrt(np.mean((direct - truth)[good] ** 2)) < 0.06 * 4095
    assert_no_orphan(tmp_path)


def test_demo_of_a_mesh_has_a_lamp_and_a_stage(tmp_path: Path) -> None:
    done = umbra("demo", "-m", "mesh", "--speed", "4", "--coverage", "0.5", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "scan    mesh" in done.stdout
    assert "direct  RMSE 0.0" in done.stdout
    assert (tmp_path / "umbra-demo" / "report.html").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_demo_cut_short_leaves_no_daemon(number: signal.Signals, tmp_path: Path) -> None:
    with subprocess.Popen(
        [*UMBRA, "demo", "-o", "out", "--speed", "0.2", "--average", "20"],  # a minute and more
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stderr is not None
            for line in process.stderr:
                if line.startswith("running"):
                    break
            else:
                pytest.fail("the demo ended before it ran")
            assert daemons()
            process.send_signal(number)
            said = process.stderr.read()
            code = process.wait(60)
        finally:
            process.kill()
    if number is signal.SIGINT:
        assert code == 130
        assert "nothing was written" in said
        assert "Traceback" not in said
        assert_no_orphan(tmp_path)
    elif number is signal.SIGTERM:
        assert code == 128 + signal.SIGTERM
        assert_no_orphan(tmp_path)
    else:  # its folder cannot be cleared away by the dead; the daemon goes all the same
        assert code == -signal.SIGKILL
        (folder,) = Path(os.environ["TMPDIR"]).glob("umbra-*")
        until(lambda: not _listens(folder / "command"))
        until(lambda: not daemons())
        shutil.rmtree(folder)
    assert not (tmp_path / "out").exists()


def _listens(path: Path) -> bool:
    import socket

    with socket.socket(socket.AF_UNIX) as peer:
        return peer.connect_ex(str(path)) == 0


def test_separate_finds_the_components(tmp_path: Path) -> None:
    shots = write_shifts(tmp_path / "shots")
    done = umbra(
        "separate", shots, "--method", "checkerboard", "--estimator", "maxmin", "-o", "out",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    out = tmp_path / "out"
    assert set(PRODUCTS) <= {p.name for p in out.iterdir()}
    assert [Path(line).name for line in done.stdout.splitlines()][:2] == PRODUCTS[:2]
    direct, global_ = scene()
    assert np.abs(read(out / "direct.tiff") - direct).max() <= 1.01  # two roundings to 8 bit
    assert np.abs(read(out / "global.tiff") - global_).max() <= 1.01
    assert_no_orphan(tmp_path)


def test_separate_with_reference_frames(tmp_path: Path) -> None:
    shots = write_shifts(tmp_path / "shots", ambient=20)
    direct, global_ = scene()
    write(tmp_path / "dark.png", np.full((*SIZE, 3), 20.0))
    write(tmp_path / "white.png", direct + global_ + 20)
    done = umbra(
        "separate", shots, "-m", "checkerboard", "--black-frame", "dark.png",
        "--white-frame", "white.png", "-o", "out", "--json", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["run"]["spec"]["references"] == ["black", "white"]
    assert told["run"]["recorded"] == 27
    assert np.abs(read(tmp_path / "out" / "global.tiff") - global_).max() <= 2.01


def test_separate_two_images(tmp_path: Path) -> None:
    direct, global_ = scene()
    pair = tmp_path / "pair"
    pair.mkdir()
    for n, lit in enumerate([checker(0, 0), ~checker(0, 0)]):
        write(pair / f"{n}.png", lit * direct + global_ / 2)
    done = umbra("separate", pair, "-m", "two-image", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert np.abs(read(tmp_path / "out" / "direct.tiff") - direct).max() <= 1.01


def _empty(shots: Path) -> None:
    for file in shots.iterdir():
        file.unlink()


def _mixed(shots: Path) -> None:
    assert cv2.imwrite(str(shots / "shot7.png"), np.zeros((20, 20, 3), np.uint8))


def _truncated(shots: Path) -> None:
    file = shots / "shot7.png"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _one_only(shots: Path) -> None:
    for file in shots.iterdir():
        if file.name != "shot0.png":
            file.unlink()


def _text_among(shots: Path) -> None:
    (shots / "notes.txt").write_text("exposure 1/30 s\n")


def _one_missing(shots: Path) -> None:
    (shots / "shot24.png").unlink()


def _gone(shots: Path) -> None:
    shutil.rmtree(shots)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_empty, "shots"),
        (_mixed, "shot7.png"),
        (_truncated, "shot7.png"),
        (_one_only, "25"),
        (_text_among, "notes.txt"),
        (_one_missing, "24"),
        (_gone, "does not exist"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    spoil: Callable[[Path], None], said: str, tmp_path: Path
) -> None:
    shots = write_shifts(tmp_path / "shots")
    spoil(shots)
    out = tmp_path / "out"
    out.mkdir()
    done = umbra("separate", shots, "-m", "checkerboard", "-o", out, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("umbra: ")]
    assert len(errors) == 1, done.stderr
    assert said in errors[0]
    assert "Traceback" not in done.stderr
    assert not list(out.iterdir())
    assert_no_orphan(tmp_path)


def test_a_read_only_folder_is_refused_before_the_work(tmp_path: Path) -> None:
    shots = write_shifts(tmp_path / "shots")
    out = tmp_path / "out"
    out.mkdir(mode=0o555)
    try:
        done = umbra("separate", shots, "-m", "checkerboard", "-o", out, cwd=tmp_path)
    finally:
        out.chmod(0o755)
    assert done.returncode == 2
    assert done.stderr == f"umbra: {out} is read-only; choose another folder with -o\n"
    assert not list(out.iterdir())


def test_a_stray_module_in_the_users_folder_does_no_harm(tmp_path: Path) -> None:
    shots = write_shifts(tmp_path / "shots")
    (tmp_path / "daemon.py").write_text("raise SystemExit('not this one')\n")
    script = Path(sys.executable).with_name("umbra")
    done = subprocess.run(
        [script, "separate", shots, "-m", "checkerboard", "-o", "out"],
        cwd=tmp_path,
        env={**os.environ, "UMBRA_KEYS": str(tmp_path / "no-keys-here")},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_photographs_of_exported_patterns_are_separated_by_the_command_that_is_told(
    tmp_path: Path,
) -> None:
    size = f"{SIZE[1]}x{SIZE[0]}"
    options = ("-m", "sinusoid", "--phases", "4", "--periods", "8", "--size", size)
    done = umbra("patterns", *options, "--json", "-o", "patterns", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    direct, smooth = scene()
    (tmp_path / "photos").mkdir()
    taken = {"black.png": tmp_path / "black.png", "white.png": tmp_path / "white.png"}
    for file in map(Path, told["files"]):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert image is not None
        levels = image[..., None] / 255.0
        seen = direct * levels + smooth * levels.mean()
        photograph = taken.get(file.name, tmp_path / "photos" / file.name)
        cv2.imwrite(str(photograph), np.rint(16 * seen[..., ::-1]).astype(np.uint16))
    named = {"PHOTOS": "photos", "BLACK": "black.png", "WHITE": "white.png", "OUT": "out"}
    words = [named.get(word, word) for word in told["command"].split()]
    done = umbra(*words[1:], "--depth", "12", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = read(tmp_path / "out" / "direct.tiff")
    np.testing.assert_allclose(found, 16 * direct, atol=20)
    assert json.loads((tmp_path / "out" / "quality.json").read_text())["full_scale"] == 4095
    assert_no_orphan(tmp_path)
