"""Patterns as files: those of the scan, in its order, of the projector's size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.drawing import draw
from daemon.scans.method import Unsuitable
from protocol.patterns import Checker, RandomPhase
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import Mesh
from protocol.scans.projected import Checkerboard, GrayCode
from protocol.scans.projected import RandomPhase as RandomPhaseScan

WIDTH, HEIGHT = 40, 24


def _drawn(spec: AnyScan, image: int, gamma: float = 1.0) -> tuple[str, NDArray[np.uint8]]:
    found = draw(spec, image, WIDTH, HEIGHT, gamma)
    levels = cv2.imdecode(found.png, cv2.IMREAD_UNCHANGED)
    assert levels is not None
    return found.lighting.value, np.asarray(levels, dtype=np.uint8)


def test_black_and_white_come_first_then_each_pattern_once() -> None:
    spec = Checkerboard(average=4, bracket=(1.0, 4.0))
    assert draw(spec, 0, WIDTH, HEIGHT).images == 27
    for image, (lighting, level) in enumerate((("black", 0), ("white", 255))):
        found, levels = _drawn(spec, image)
        assert found == lighting
        assert np.all(levels == level)
    found, levels = _drawn(spec, 2 + 5 + 1)
    assert found == "pattern"
    wanted = patterns.render(Checker(size=8, shift_x=3, shift_y=3), WIDTH, HEIGHT)
    np.testing.assert_array_equal(levels, wanted)


def test_a_gamma_is_taken_off() -> None:
    _, levels = _drawn(RandomPhaseScan(), 2, gamma=2.2)
    light = 255 * (levels / 255.0) ** 2.2
    wanted = patterns.render(RandomPhase(), WIDTH, HEIGHT)
    np.testing.assert_allclose(light, wanted, atol=1.2)


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(Unsuitable, match="there are 14 images"):
        draw(GrayCode(), 14, WIDTH, HEIGHT)
    with pytest.raises(Unsuitable, match="mesh shows no set of patterns"):
        draw(Mesh(), 0, WIDTH, HEIGHT)
