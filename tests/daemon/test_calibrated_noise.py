"""The calibrated noise of the camera: used by every estimator, and checked against the scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from daemon.scans.method import Bench
from daemon.separation.noise import Noise
from protocol.scans.anyscan import AnySeparation
from protocol.scans.projected import (
    Checkerboard,
    GrayCode,
    RandomBinary,
    SingleImage,
    Sinusoid,
    TwoImage,
)
from protocol.scans.spec import Radiometry
from tests.daemon.scene import FULL, Scene

LIGHT = Radiometry(leakage=0.02)
METHODS = [
    Checkerboard(estimator="maxmin", radiometry=LIGHT),
    Checkerboard(estimator="topk", radiometry=LIGHT),
    RandomBinary(radiometry=LIGHT),
    TwoImage(radiometry=LIGHT),
    GrayCode(radiometry=LIGHT),
    Sinusoid(phases=3, radiometry=LIGHT),
    Sinusoid(phases=8, radiometry=LIGHT),
    SingleImage(stripe=2, window=5, radiometry=LIGHT),
]


@dataclass
class Calibrated(Scene):
    """A scene whose camera was calibrated to have `said` times the noise that it has."""

    said: float = 1.0

    def bench(self) -> Bench:
        """See `Scene`."""
        plain = super().bench()
        noise = {"read_counts": self.said * self.sigma * FULL, "counts_per_e": 1e-6}
        return Bench(plain.camera, plain.projector, calibration={"noise": noise})


@pytest.mark.parametrize("spec", METHODS)
def test_calibrated_noise_is_used_where_it_is_right(spec: AnySeparation) -> None:
    facts = Calibrated(sigma=0.01, leakage=0.02, ambient=0.03).scan(spec).facts
    assert facts["noise_from"] == "calibration"
    assert facts["noise_counts"] == pytest.approx(0.01 * FULL, rel=0.02)
    assert 0.8 < facts["noise_of_calibrated"] < 1.25
    assert not any("calibrated noise" in line for line in facts["advice"])


@pytest.mark.parametrize("spec", METHODS)
@pytest.mark.parametrize("said", [0.3, 3.0])
def test_what_the_scan_contradicts_is_not_used(spec: AnySeparation, said: float) -> None:
    scene = Calibrated(sigma=0.01, leakage=0.02, ambient=0.03, said=said)
    facts = scene.scan(spec).facts
    if said < 1.0 and facts["noise_from"] == "calibration":
        # a picture's texture looks like noise: it is no proof of more
        assert isinstance(spec, TwoImage | GrayCode | SingleImage | Sinusoid)
        assert not isinstance(spec, Sinusoid) or spec.phases == 3
        return
    assert facts["noise_from"] != "calibration"
    assert facts["noise_counts"] == pytest.approx(0.01 * FULL, rel=0.25)
    assert facts["noise_of_calibrated"] == pytest.approx(1 / said, rel=0.25)
    assert any("calibrate noise" in line for line in facts["advice"])


@pytest.mark.parametrize("sigma", [0.003, 0.01, 0.02])
@pytest.mark.parametrize("blur", [0.0, 0.8, 1.4])
def test_max_min_less_its_bias(sigma: float, blur: float) -> None:
    """Within 0.3 σ where the paper's max/min is off by more than 2."""
    scene = Calibrated(sigma=sigma, leakage=0.02, ambient=0.03, blur=blur)
    inside = np.s_[8:-8, 8:-8]
    found = scene.scan(Checkerboard(estimator="maxmin-unbiased", radiometry=LIGHT))
    assert found.facts["estimator"] == "maxmin-unbiased"
    bias = float(np.mean((found.direct - scene.direct)[inside])) / FULL
    assert abs(bias) < max(0.3 * sigma, 0.002)


def test_max_min_of_the_paper_is_left_as_it_is() -> None:
    scene = Calibrated(sigma=0.02, ambient=0.0)
    found = scene.scan(Checkerboard(estimator="maxmin", references=()))
    assert np.mean(found.direct - scene.direct) > 2 * 0.02 * FULL
    assert found.facts["bias_of_noise"]["direct"] > 2 * 0.02 * FULL


def test_shot_noise_parts_the_two_ends() -> None:
    """Bright samples have more noise than dark ones, and each end loses the bias of its own."""

    @dataclass
    class Shot(Scene):
        electrons: float = 400.0

        def bench(self) -> Bench:
            plain = super().bench()
            noise = {"read_counts": 0.002 * FULL, "counts_per_e": FULL / self.electrons}
            return Bench(plain.camera, plain.projector, calibration={"noise": noise})

        def __post_init__(self) -> None:
            super().__post_init__()
            rng = np.random.default_rng(3)

            def noisy(light: np.ndarray, _: object) -> np.ndarray:
                shot = np.sqrt((0.002 * FULL) ** 2 + np.maximum(light, 0) * FULL / self.electrons)
                return np.asarray(light + rng.standard_normal(light.shape) * shot)

            self.change = noisy

    scene = Shot()
    inside = np.s_[8:-8, 8:-8]
    for estimator in ("topk", "maxmin-unbiased"):
        found = scene.scan(Checkerboard(estimator=estimator, references=()))
        noise = (0.5 / 400) ** 0.5  # of a lit sample
        assert found.facts["noise_from"] == "calibration"
        assert abs(np.mean((found.direct - scene.direct)[inside])) < 0.2 * noise * FULL
        assert abs(np.mean((found.global_ - scene.indirect)[inside])) < 0.3 * noise * FULL


def test_the_curve_of_a_calibrated_camera() -> None:
    noise = Noise.of_read_and_shot(3.0, 0.5, 64.0, 4095)
    levels = np.array([64.0, 500.0, 2000.0, 4095.0])
    expected = np.sqrt(9 + 0.5 * (levels - 64) + 1 / 12)
    np.testing.assert_allclose(noise.deviation(levels), expected, rtol=2e-3)
    assert noise.over(Noise.of_read_and_shot(1.5, 0.125, 64.0, 4095)) == pytest.approx(2, rel=0.02)
