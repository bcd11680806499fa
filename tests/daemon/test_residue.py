"""Each method finds the mirror of the virtual scene in its own frames, and hardly anything else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.estimator import Components, Quality
from daemon.separation.fineness import astray, finer_pattern
from daemon.separation.straddling import as_neighbours
from protocol.patterns import Axis
from protocol.scans.anyscan import AnySeparation
from protocol.scans.projected import (
    Checkerboard,
    GrayCode,
    RandomBinary,
    RandomPhase,
    SingleImage,
    Sinusoid,
    TwoImage,
)
from protocol.scans.spec import Radiometry
from tests.daemon.scene import Scene
from tests.daemon.virtual_scene import VirtualScene

LIGHT = Radiometry(leakage=0.06)
BOTH = (Axis.X, Axis.Y)


@pytest.fixture(scope="module")
def scene() -> VirtualScene:
    """Leakage .06, a projector out of focus, shot and read noise, a Bayer mosaic."""
    return VirtualScene(leakage=0.06)


def _residue(components: Components, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    found = np.asarray((components.quality & np.uint16(Quality.RESIDUE)) != 0)
    k = shape[0] // found.shape[0]
    return np.repeat(np.repeat(found, k, axis=0), k, axis=1)


def _around_ball(scene: VirtualScene, pixels: int) -> NDArray[np.bool_]:
    kernel = np.ones((2 * pixels + 1,) * 2, np.uint8)
    return np.asarray(cv2.dilate((~scene.view.smooth).astype(np.uint8), kernel)) > 0


@pytest.mark.parametrize(
    ("spec", "least", "most"),
    [
        (Checkerboard(radiometry=LIGHT), 0.95, 0.002),
        (Checkerboard(estimator="maxmin", radiometry=LIGHT), 0.95, 0.002),
        (RandomBinary(radiometry=LIGHT), 0.85, 0.02),
        (RandomBinary(estimator="maxmin", radiometry=LIGHT), 0.85, 0.02),
        (RandomPhase(radiometry=LIGHT), 0.85, 0.01),
        (TwoImage(radiometry=LIGHT), 0.75, 0.002),
        (Sinusoid(radiometry=LIGHT), 0.65, 0.005),
        (GrayCode(radiometry=LIGHT), 0.4, 0.02),
        (GrayCode(axes=BOTH, radiometry=LIGHT), 0.9, 0.02),
        (SingleImage(stripe=2, radiometry=LIGHT), 0.5, 0.005),
    ],
)
def test_the_mirror_is_flagged_and_little_else(
    scene: VirtualScene, spec: AnySeparation, least: float, most: float
) -> None:
    components = scene.scan(spec)
    assert components.facts["mirrors_looked_for"]
    mirror = scene.mirrored()
    found = _residue(components, mirror.shape)
    assert found[mirror].mean() > least
    assert found[~_around_ball(scene, 3)].mean() < most
    assert found[~_around_ball(scene, 20)].mean() < 0.01


def test_without_black_and_white_a_single_image_says_that_it_looked_for_none(
    scene: VirtualScene,
) -> None:
    components = scene.scan(SingleImage(stripe=2, references=(), radiometry=LIGHT))
    assert components.facts["mirrors_looked_for"] is False


@pytest.mark.parametrize("blur", [0.0, 0.8, 1.6])
@pytest.mark.parametrize("sigma", [0.002, 0.02])
def test_blur_and_noise_are_no_mirrors(blur: float, sigma: float) -> None:
    scene = Scene(leakage=0.06, blur=blur, sigma=sigma)
    specs: list[AnySeparation] = [
        TwoImage(radiometry=LIGHT),
        RandomPhase(radiometry=LIGHT),
        RandomBinary(radiometry=LIGHT),
        GrayCode(axes=BOTH, radiometry=LIGHT),
        SingleImage(stripe=2, radiometry=LIGHT),
    ]
    for spec in specs:
        found = scene.scan(spec)
        assert not np.any(found.quality & np.uint16(Quality.RESIDUE)), spec


def test_a_pattern_that_the_camera_does_not_resolve_tells_nothing() -> None:
    wave = np.sign(np.random.default_rng(1).standard_normal((96, 128))).astype(np.complex64)
    strength = np.full(wave.shape, 50.0, np.float32)
    assert finer_pattern(wave, strength) is None
    assert astray(wave.real, strength, "x") is None


def test_a_pattern_finer_one_way_only_is_a_slanted_surface() -> None:
    y, x = np.mgrid[:240, :320]
    slanted, small = (slice(40, 110), slice(40, 140)), (slice(130, 200), slice(180, 280))
    column = x.astype(float)
    row = y.astype(float)
    column[slanted] = 3.0 * x[slanted]
    column[small], row[small] = 3.0 * x[small], 3.0 * y[small]
    wave = np.where((column // 8 + row // 8) % 2 == 0, 1, -1).astype(np.complex64)
    found = finer_pattern(wave, np.full(wave.shape, 50.0, np.float32))
    assert found is not None
    assert found[small].mean() > 0.7
    assert not found[slanted].any()


@pytest.mark.parametrize("spec", [TwoImage(radiometry=LIGHT), RandomPhase(radiometry=LIGHT)])
def test_the_edges_of_a_pattern_are_flagged_and_split_as_their_neighbours(
    spec: AnySeparation,
) -> None:
    scene = Scene(sigma=0.004, leakage=0.06, blur=0.6)
    found = scene.scan(spec)
    off = np.abs(found.direct - scene.direct)
    flagged = (found.quality & np.uint16(Quality.EDGE)) != 0
    assert 0.2 < np.mean(flagged) < 0.7
    assert found.facts["edges"] == pytest.approx(float(np.mean(flagged)), abs=0.01)
    assert np.mean(off[flagged] / scene.direct[flagged] < 0.2) > 0.99  # by Eq. 8: one in ten
    assert np.mean(off / scene.direct < 0.2) > 0.97
    stated = found.planes["direct_std"]
    assert 0.5 < np.median((off / stated)[flagged]) / 0.6745 < 1.25


@pytest.mark.parametrize("mosaic", [False, True])
def test_an_edge_has_its_neighbours_part_of_its_own_light(mosaic: bool) -> None:
    rng = np.random.default_rng(3)
    light = rng.uniform(1000, 3000, (32, 48)).astype(np.float32)
    part = np.full(light.shape, 0.7, np.float32)
    if mosaic:
        part[::2, ::2] = 0.4  # of a colour
    edge = np.zeros(light.shape, np.bool_)
    edge[10:13] = True
    less = np.where(edge, part * 0.2, part) * light
    noise = np.full_like(light, 5.0)
    split = as_neighbours(less, light, noise, edge, mosaic=mosaic)
    np.testing.assert_allclose(split.direct, part * light, rtol=1e-4)
    assert np.array_equal(split.known, edge)
    assert not split.deviation[20:].any()
    nowhere = as_neighbours(less, light, noise, np.ones_like(edge), mosaic=mosaic)
    assert not nowhere.known.any()
    np.testing.assert_array_equal(nowhere.direct, less)
