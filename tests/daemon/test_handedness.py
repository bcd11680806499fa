"""Mirrors are found by the pattern's running the wrong way, and nothing else is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.estimator import Components, Quality
from daemon.separation.handedness import WaveSums, reversed_pattern, shift_weights
from protocol.scans.projected import Checkerboard, Sinusoid
from protocol.scans.spec import Radiometry
from tests.daemon.scene import Scene
from tests.daemon.virtual_scene import VirtualScene

LIGHT = Radiometry(leakage=0.02)


def _residue(components: Components) -> NDArray[np.bool_]:
    return np.asarray((components.quality & np.uint16(Quality.RESIDUE)) != 0)


@pytest.mark.parametrize(
    ("electrons", "read", "least"), [(10_500.0, 1.2, 0.9), (200.0, 12.0, 0.45)]
)
def test_the_mirror_of_the_virtual_scene_is_flagged_and_little_else(
    electrons: float, read: float, least: float
) -> None:
    scene = VirtualScene(electrons=electrons, read=read)
    found = _residue(scene.scan(Checkerboard(radiometry=LIGHT)))
    ball = cv2.dilate((~scene.view.smooth).astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    assert found[scene.mirrored()].mean() > least
    assert not found[~ball].any(), "texture, marble, wax, blur and shadows are no mirrors"


@pytest.mark.parametrize("weave", [0.0, 1.0])
def test_one_coordinate_finds_the_part_of_a_mirror_that_runs_against_it(weave: float) -> None:
    scene = VirtualScene()
    found = _residue(scene.scan(Sinusoid(phases=8, weave=weave, radiometry=LIGHT)))
    ball = cv2.dilate((~scene.view.smooth).astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    assert found[scene.mirrored()].mean() > 0.1
    assert not found[~ball].any()


@pytest.mark.parametrize("blur", [0.0, 0.8, 2.0])
def test_blur_is_no_mirror(blur: float) -> None:
    scene = Scene(leakage=0.02, blur=blur, sigma=0.02)
    components = scene.scan(Checkerboard(radiometry=LIGHT))
    assert components.facts["mirrors_looked_for"]
    assert not _residue(components).any()


def test_a_camera_that_shows_everything_reversed_sees_no_mirror_but_the_odd_one_out() -> None:
    y, x = np.mgrid[:96, :128].astype(np.float32)
    turn = 2 * np.pi / 16
    column = 127 - x
    column[30:60, 40:80] = x[30:60, 40:80]
    waves = [np.exp(1j * turn * (column + sign * y)).astype(np.complex64) for sign in (1.0, -1.0)]
    found = reversed_pattern(waves, np.full(x.shape, 50.0, np.float32))
    assert found[33:57, 43:77].all()
    assert not found[:25].any()
    assert not found[65:].any()


def test_a_missing_pattern_tells_nothing() -> None:
    shifts = [(3 * n, 3 * m) for m in range(5) for n in range(5)]
    weights = shift_weights(shifts, 16)
    assert weights is not None
    sums = WaveSums(weights)
    for index in range(19):
        sums.add(np.zeros((4, 4), np.uint16), index)
    assert sums.waves() is None
    sums.add(np.zeros((4, 4), np.uint16), 19)
    assert sums.waves() is not None, "the last row of shifts is not needed"
    sums.add(np.zeros((4, 4), np.uint16), 3)
    assert sums.waves() is None, "a pattern that came twice"


def test_shifts_that_cannot_tell_a_phase_have_no_weights() -> None:
    assert shift_weights([(0, 0), (8, 0), (0, 8), (8, 8)], 16) is None
