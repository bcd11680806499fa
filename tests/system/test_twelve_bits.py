"""Scans on 12 bit Bayer through the vendors' own libraries: a daemon with an emulated camera, that
sees a film of a known scene under the scan's own patterns, in step with the virtual projector."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.patterns import render
from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Expose
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from drivers.registry import UnknownDriver, load
from protocol.scans.projected import Checkerboard
from tests.drivers import aravis_peer, gentl_peer
from tests.system.harness import Daemon

pytestmark = pytest.mark.system

WIDTH, HEIGHT = 128, 96  # of projector and sensor: each pixel of one sees one of the other
BLACK = 100
SCAN = Checkerboard(checker=8, shift=4, shifts=4)
DIRECT = np.array([[[900, 1400, 500]], [[1500, 300, 1100]]], np.float64)  # left, right; RGB counts
GLOBAL = np.array([[[700, 250, 400]], [[200, 800, 300]]], np.float64)

CONFIG = """
[rig]
name = "bench"
data = "{data}"
[network]
command = "ipc://{folder}/c"
events = "ipc://{folder}/e"
[storage]
reserve_mb = 1
[projector]
driver = "virtual"
width = {width}
height = {height}
[camera]
exposure_us = 17000.0
black_level = {black}
{camera}
"""


def halves(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W, 3): a colour on the left, another on the right."""
    return np.concatenate(
        [np.broadcast_to(values[k], (HEIGHT, WIDTH // 2, 3)) for k in (0, 1)], axis=1
    )


def film() -> NDArray[np.uint16]:
    """What an RG mosaic of 12 bit sees under each of the scan's patterns, (N, H, W)."""
    camera = CameraInfo(WIDTH, HEIGHT, PixelFormat.BAYER_RG12)
    method = method_for(SCAN, Bench(camera, ProjectorInfo(WIDTH, HEIGHT, 60.0)))
    frames, index = [], 0
    while (step := method.step(index, {})) is not None:
        assert isinstance(step, Expose)
        assert step.pattern is not None
        light = render(step.pattern, WIDTH, HEIGHT) / 255.0
        scene = halves(DIRECT) * light[:, :, None] + halves(GLOBAL) * light.mean()
        mosaic = scene[:, :, 1].copy()
        mosaic[::2, ::2], mosaic[1::2, 1::2] = scene[::2, ::2, 0], scene[1::2, 1::2, 2]
        frames += [np.round(mosaic + BLACK).astype(np.uint16)] * step.frames
        index += 1
    return np.stack(frames)


def driver_or_skip(name: str) -> None:
    try:
        load("camera", name)
    except UnknownDriver as missing:
        pytest.skip(str(missing))


@pytest.fixture
def pylon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    driver_or_skip("pylon")
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    folder = tmp_path / "film"
    folder.mkdir()
    for k, frame in enumerate(film()):
        assert cv2.imwrite(str(folder / f"{k:03}.tif"), frame << 4)  # the emulation scales 16 to 12
    return f"""
driver = "pylon"
transport = "BaslerCamEmu"
roi = [0, 0, {WIDTH}, {HEIGHT}]
pixel_format = "BayerRG12"
features = {{ TestImageSelector = "Off", ImageFilename = "{folder}", ImageFileMode = "On" }}
"""


@pytest.fixture
def aravis(tmp_path: Path) -> Iterator[str]:
    driver_or_skip("aravis")
    if shutil.which("arv-fake-gv-camera-0.8") is None:
        pytest.skip("no fake camera: apt install aravis-tools")
    np.save(tmp_path / "film.npy", film())
    film_file = str(tmp_path / "film.npy")
    program = [sys.executable, aravis_peer.__file__, "127.0.0.1", "GV12", film_file]
    with (
        aravis_peer.loopback(),
        subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as camera,
    ):
        assert camera.stdout is not None
        assert camera.stdout.readline() == "ready\n"
        yield f"""
driver = "aravis"
address = "127.0.0.1"
roi = [0, 0, {WIDTH}, {HEIGHT}]
pixel_format = "BayerRG12p"
"""
        camera.kill()


@pytest.fixture
def gentl(tmp_path: Path) -> str:
    driver_or_skip("gentl")
    if not gentl_peer.compiler():
        pytest.skip("no C compiler for the producer: apt install gcc")
    return f"""
driver = "gentl"
producer = "{gentl_peer.build(tmp_path, film())}"
roi = [1, 1, {WIDTH - 1}, {HEIGHT - 1}]
pixel_format = "BayerRG12Packed"
"""


@pytest.mark.parametrize("camera", ["pylon", "aravis", "gentl"])
def test_a_scan_gives_the_scenes_direct_and_global_light(
    camera: str, daemon: Daemon, request: pytest.FixtureRequest
) -> None:
    told = request.getfixturevalue(camera)
    daemon.config.write_text(
        CONFIG.format(
            data=daemon.data,
            folder=daemon.folder,
            width=WIDTH,
            height=HEIGHT,
            black=BLACK,
            camera=told,
        )
    )
    corner = 1 if camera == "gentl" else 0  # an odd one: the mosaic begins with another colour
    with daemon.start() as rig:
        run = rig.scan(SCAN)
        run.wait(60)
        result = run.result()
        info = run.refresh()
    assert (info.recorded, info.missing) == (len(film()), 0)
    for got, truth in ((result.direct, halves(DIRECT)), (result.global_, halves(GLOBAL))):
        want = truth[corner:, corner:]
        assert got.shape == want.shape
        for inside in (np.s_[8:-8, 8:48], np.s_[8:-8, 80:-8]):
            error: Any = np.abs(got[inside] - want[inside])
            assert float(error.max()) < 3.0
