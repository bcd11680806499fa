"""Pictures that no scan is for, black, of one level, of few pixels: an answer all the same."""

from __future__ import annotations

import json

import numpy as np
import pytest

from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Digest, Expose, Taken
from daemon.separation.estimator import Components, Quality
from daemon.separation.finish import Judgement, finish
from daemon.separation.radiometry import Response
from daemon.separation.registration import REFERENCE, Registration
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import Mesh
from protocol.scans.projected import GrayCode, RandomBinary, RandomPhase, Sinusoid, TwoImage
from protocol.scans.spec import Reference

BLACK_AND_WHITE = (Reference.BLACK, Reference.WHITE)


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize(
    ("spec", "shape", "pixel_format"),
    [
        (GrayCode(bits=3, references=()), (8, 8), PixelFormat.MONO8),
        (Mesh(hole_fraction=0.3, frames=3), (7, 1), PixelFormat.BAYER_RG8),
        (RandomBinary(patterns=2, references=()), (8, 8), PixelFormat.MONO8),
        (RandomBinary(patterns=3, references=()), (8, 8), PixelFormat.MONO8),
        (RandomPhase(average=2, references=()), (3, 3), PixelFormat.RGB8),
        (Sinusoid(average=2, references=()), (1, 1), PixelFormat.MONO8),
        (Sinusoid(periods=(8.0, 16.0), references=()), (8, 8), PixelFormat.MONO8),
        (TwoImage(references=BLACK_AND_WHITE), (8, 8), PixelFormat.MONO8),
    ],
)
def test_pictures_without_any_pattern_are_answered(
    spec: AnyScan, shape: tuple[int, int], pixel_format: PixelFormat, level: int
) -> None:
    camera = CameraInfo(shape[1], shape[0], pixel_format, recorded=True)
    method = method_for(spec, Bench(camera))
    estimator = method.estimator()
    pixels = np.full(camera.shape, level, pixel_format.dtype)
    index = 0
    while (step := method.step(index, {})) is not None:
        assert not isinstance(step, Digest)
        for sub in range(step.frames or 0):
            taken = Taken(index, sub, incomplete=False, pixels=pixels)
            estimator.update(pixels, method.observe(step, taken))
        index += 1
        assert isinstance(step, Expose) or index <= 1
    found = estimator.result()
    assert isinstance(found, Components)
    json.dumps(found.facts, allow_nan=False)
    expected = Quality.DARK if level == 0 else Quality.SATURATED
    assert (found.quality & np.uint16(expected | Quality.NEVER_LIT)).all()


def test_a_colour_that_no_neighbour_has_is_flagged_as_they_are() -> None:
    light = np.full((8, 8), 100.0, np.float32)
    flags = np.full((8, 8), Quality.NEVER_LIT, np.uint16)
    flags[4, 4] = 0
    flags[:, :2] = 0
    found = finish(
        light.copy(),
        light.copy(),
        response=Response(full_scale=255, bayer="RG"),
        brightest=light,
        saturated=np.zeros((8, 8), np.bool_),
        judgement=Judgement(*(np.ones((8, 8), np.float32),) * 3),
        facts={},
        flags=flags,
    )
    assert found.quality[4, 4] == Quality.NEVER_LIT
    assert np.isnan(found.direct[4, 4]).all()
    good = found.quality == 0
    assert good[:, 0].all()
    assert np.isfinite(found.direct[good]).all()
    assert np.isfinite(found.global_[good]).all()


@pytest.mark.parametrize("level", [0, 90])
def test_first_frames_that_are_all_the_same_lie_in_one_place(level: int) -> None:
    camera = Registration(Response(full_scale=255))
    pixels = np.full((20, 220), level, np.uint8)
    for _ in range(REFERENCE):
        camera.learn(pixels)
    assert camera.learned
    assert not camera.tells
    assert camera.wandered == 0.0
