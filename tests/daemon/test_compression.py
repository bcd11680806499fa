"""Frames of JPEG files are known as such; what they differ by beyond a picture's noise is noise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.scans import catalog
from daemon.scans.method import Bench, Expose, Taken
from daemon.separation.compression import COMPRESSED, in_blocks
from daemon.separation.estimator import Components, Quality
from daemon.separation.noise import Noise
from daemon.separation.radiometry import Response
from daemon.separation.scan_noise import PICTURE, RESIDUALS, ScanNoise, Told
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from protocol.scans.projected import Checkerboard
from protocol.scans.spec import Radiometry, Reference
from tests.daemon.scene import Scene


def _picture(colours: int, sigma: float = 1.5) -> NDArray[np.uint8]:
    rng = np.random.default_rng(2)
    texture = cv2.GaussianBlur(rng.standard_normal((200, 240, 3)), (0, 0), 3)[..., :colours]
    counts = 110 + 300 * texture + rng.normal(0, sigma, texture.shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8).squeeze()


def _jpeg(pixels: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    _, file = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(file, cv2.IMREAD_UNCHANGED), dtype=np.uint8)


@pytest.mark.parametrize("quality", [50, 75, 90, 95])
@pytest.mark.parametrize("colours", [1, 3])
def test_a_jpeg_is_known(quality: int, colours: int) -> None:
    assert in_blocks(_jpeg(_picture(colours), quality))


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("sigma", [0.3, 1.0, 4.0])
def test_a_picture_that_was_not_compressed_is_none(colours: int, sigma: float) -> None:
    picture = _picture(colours, sigma)
    assert not in_blocks(picture)


def test_dark_small_and_deep_pictures_are_none() -> None:
    assert not in_blocks(np.zeros((200, 200), np.uint8))
    assert not in_blocks(_jpeg(_picture(1), 75)[:32, :32])
    assert not in_blocks(_jpeg(_picture(1), 75).astype(np.uint16))


def test_noise_above_a_picture_s_is_believed_of_frames_in_order() -> None:
    noise = ScanNoise(Response(255))
    noise.add(np.full((64, 64), 100, np.uint8), 0)
    found = Noise((0.0, 255.0), (5.0, 5.0))
    assert noise.told(found).source == PICTURE
    assert noise.told(found, ordered=True).source == RESIDUALS


@pytest.mark.parametrize("references", [(), (Reference.BLACK, Reference.WHITE)])
def test_a_checkerboard_s_jpegs_are_not_mirrors_and_their_deviation_holds(
    references: tuple[Reference, ...],
) -> None:
    """Their references are smooth, and have none of the error that patterns have."""
    scene = Scene(width=160, height=120, sigma=0.004, leakage=0.02, blur=0.6)
    spec = Checkerboard(references=references, radiometry=Radiometry(leakage=0.02))
    found = _scanned(spec, scene)
    assert COMPRESSED in found.facts["advice"]
    assert found.facts["noise_from"] == RESIDUALS
    wrong = np.uint16(Quality.RESIDUE | Quality.MOVED)
    assert not np.any(found.quality & wrong)
    error = found.direct - scene.direct * (255.0 / 65535.0)
    off = np.abs(error) / found.planes["direct_std"]
    assert float(np.median(off)) / 0.6745 < 2.5
    assert abs(float(np.median(error))) < 1.0


def _scanned(spec: Checkerboard, scene: Scene) -> Components:
    rng = np.random.default_rng(1)
    camera = CameraInfo(scene.width, scene.height, PixelFormat.MONO8, recorded=True)
    method = catalog.method_for(spec, Bench(camera))
    estimator = method.estimator()
    index = 0
    while (step := method.step(index, {})) is not None:
        assert isinstance(step, Expose)
        frame: NDArray[Any] = scene.frame(step, rng)
        pixels = _jpeg(np.rint(frame / 257.0).astype(np.uint8), 90)
        estimator.update(pixels, method.observe(step, Taken(index, 0, incomplete=False)))
        index += 1
    found = estimator.result()
    assert isinstance(found, Components)
    return found


@pytest.mark.parametrize(("sigma", "left"), [(0.0, 1.0), (0.2, 0.21), (1.0, 0.0)])
def test_rounding_that_noise_does_not_dither_stays_in_the_mean(sigma: float, left: float) -> None:
    """Of many samples at levels all between two counts."""
    deviation = float(np.hypot(sigma, 12.0**-0.5))
    told = Told(Response(255), Noise((0.0, 255.0), (deviation, deviation)), 1, RESIDUALS)
    level = np.linspace(10.0, 11.0, 50, endpoint=False)
    noise = np.random.default_rng(1).normal(0, sigma, (4000, 1))
    off = np.rint(level + noise).mean(axis=0) - level
    found = float(told.rounding(np.array([10.0], np.float32))[0])
    assert found * 12.0 == pytest.approx(left, abs=0.01)
    assert found == pytest.approx(float(np.var(off)), abs=0.01)
