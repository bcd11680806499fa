"""The deviation that a scan states against how much the same scan differs when it is repeated."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.separation.deviation import of_noise
from daemon.separation.estimator import Quality
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

LIGHT = Radiometry(leakage=0.02)
SCANS = 6
UNSURE = Quality.SATURATED | Quality.DARK | Quality.LOW_MODULATION | Quality.RESIDUE


def _ratios(scene: Scene | VirtualScene, spec: AnySeparation) -> dict[str, float]:
    """Stated over real deviation of direct and of global by noise, which is what repeated scans
    show: medians over good pixels."""
    scans = [scene.scan(spec, seed=seed) for seed in range(SCANS)]
    good = np.all([(scan.quality & np.uint16(UNSURE)) == 0 for scan in scans], axis=0)
    assert good.mean() > 0.2
    found = {}
    for name, plane in (("direct", "direct_std"), ("global_", "global_std")):
        real = np.stack([getattr(scan, name) for scan in scans]).var(axis=0, ddof=1)[good]
        stated = np.stack([of_noise(scan.planes, plane) for scan in scans]).mean(axis=0)[good]
        mean = np.median(real) / (1 - 2 / (9 * (SCANS - 1))) ** 3  # of a χ², from its median
        found[name] = float(np.median(stated) / np.sqrt(mean))
    return found


@pytest.mark.parametrize("sigma", [0.003, 0.02])
@pytest.mark.parametrize(
    "spec",
    [
        Checkerboard(estimator="maxmin", radiometry=LIGHT),
        Checkerboard(estimator="topk", radiometry=LIGHT),
        RandomBinary(estimator="maxmin", radiometry=LIGHT),
        TwoImage(radiometry=LIGHT),
        GrayCode(radiometry=LIGHT),
        Sinusoid(phases=8, radiometry=LIGHT),
        SingleImage(stripe=2, window=5, radiometry=LIGHT),
    ],
)
def test_the_stated_deviation_is_the_real_one(spec: AnySeparation, sigma: float) -> None:
    for name, ratio in _ratios(Scene(sigma=sigma, leakage=0.02, ambient=0.03), spec).items():
        assert 0.7 < ratio < 1.25, name


@pytest.mark.parametrize("blur", [0.6, 1.2])
@pytest.mark.parametrize("spec", [TwoImage(radiometry=LIGHT), GrayCode(radiometry=LIGHT)])
def test_what_blur_does_is_stated_too(spec: AnySeparation, blur: float) -> None:
    """Against the truth, from which repeated scans of these are all off alike."""
    scene = Scene(sigma=0.003, leakage=0.02, ambient=0.03, blur=blur)
    found = scene.scan(spec)
    off = np.abs(found.direct - scene.direct) / found.planes["direct_std"]
    assert 0.5 < np.median(off) / 0.6745 < 1.8
    assert np.mean(off > 5) < 0.02


@pytest.mark.parametrize("blur", [0.0, 0.6, 1.2])
@pytest.mark.parametrize(
    "spec",
    [
        Checkerboard(estimator="maxmin", radiometry=LIGHT),
        Checkerboard(estimator="topk", radiometry=LIGHT),
        RandomBinary(estimator="maxmin", radiometry=LIGHT),
        RandomBinary(estimator="topk", radiometry=LIGHT),
        TwoImage(radiometry=LIGHT),
        RandomPhase(radiometry=LIGHT),
        GrayCode(radiometry=LIGHT),
        Sinusoid(phases=5, periods=(12, 20), radiometry=LIGHT),
    ],
)
def test_it_is_that_of_the_error(spec: AnySeparation, blur: float) -> None:
    """Against the truth: noise, bias, place in the pattern, edges and blur together."""
    scene = Scene(sigma=0.02, leakage=0.02, ambient=0.03, blur=blur)
    found = scene.scan(spec)
    inside = np.s_[8:-8, 8:-8]
    for plane, truth, name in (
        (found.direct, scene.direct, "direct_std"),
        (found.global_, scene.indirect, "global_std"),
    ):
        error = np.mean(np.square(plane - truth)[inside])
        assert 0.75 < np.sqrt(error / np.mean(np.square(found.planes[name][inside]))) < 1.4, name


@pytest.mark.parametrize("spec", [Sinusoid(phases=8, radiometry=LIGHT), GrayCode(radiometry=LIGHT)])
@pytest.mark.parametrize("level", [0.8, 0.2])
def test_it_is_so_in_a_mosaic_with_shot_noise(spec: AnySeparation, level: float) -> None:
    for name, ratio in _ratios(VirtualScene(level=level), spec).items():
        assert 0.8 < ratio < 1.25, name


def test_maxmin_says_what_its_noise_adds() -> None:
    """Against scans of the same scene without noise."""
    spec = Checkerboard(estimator="maxmin", radiometry=LIGHT)
    clean, noisy = (
        Scene(sigma=sigma, leakage=0.02, ambient=0.03).scan(spec) for sigma in (0.0, 0.01)
    )
    told = noisy.facts["bias_of_noise"]
    assert told["direct"] == pytest.approx(np.mean(noisy.direct - clean.direct), rel=0.15)
    assert told["global"] == pytest.approx(np.mean(noisy.global_ - clean.global_), rel=0.15)
