"""Each pattern method on one scene: components, leakage, ambient light, correspondence."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.deviation import PLANES, of_noise
from daemon.separation.estimator import Components, Quality
from drivers.base.pixelformat import PixelFormat
from protocol.patterns import Axis
from protocol.scans.anyscan import AnyScan
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
from tests.daemon.scene import FULL, Scene

LEAK = 0.06


def radiometry() -> Radiometry:
    return Radiometry(leakage=LEAK)


SPECS: list[AnyScan] = [
    Checkerboard(radiometry=radiometry(), estimator="maxmin"),
    Checkerboard(radiometry=radiometry(), average=2),
    TwoImage(radiometry=radiometry()),
    Sinusoid(radiometry=radiometry()),
    Sinusoid(radiometry=radiometry(), phases=5, periods=(12.0, 16.0)),
    RandomPhase(radiometry=radiometry(), phases=4),
    GrayCode(radiometry=radiometry()),
    GrayCode(radiometry=radiometry(), axes=(Axis.X, Axis.Y)),
    RandomBinary(radiometry=radiometry(), patterns=24),
]


def errors(found: Components, scene: Scene) -> tuple[float, float]:
    """Root-mean-square errors as fractions of full scale."""

    def rms(plane: NDArray[np.float32], truth: NDArray[np.float64]) -> float:
        return float(np.sqrt(np.nanmean(((plane - truth) / FULL) ** 2)))

    return rms(found.direct, scene.direct), rms(found.global_, scene.indirect)


@pytest.mark.parametrize("spec", SPECS, ids=lambda s: f"{type(s).__name__}-{s.average}")
@pytest.mark.parametrize("ambient", [0.0, 0.05])
def test_components_come_back_under_leakage_and_ambient_light(
    spec: AnyScan, ambient: float
) -> None:
    scene = Scene(leakage=LEAK, ambient=ambient)
    direct, indirect = errors(scene.scan(spec), scene)
    # random patches light a neighbourhood unevenly: their global light is not even either
    limit = 0.02 if isinstance(spec, RandomBinary | RandomPhase) else 0.008
    assert direct < limit
    assert indirect < 1.3 * limit


def test_gray_code_gives_each_pixels_column_and_row() -> None:
    scene = Scene(sigma=0.004, blur=0.7)
    planes = scene.scan(GrayCode(axes=(Axis.X, Axis.Y))).planes
    y, x = np.mgrid[0 : scene.height, 0 : scene.width]
    for name, truth in (("column", x), ("row", y)):
        assert np.isfinite(planes[name]).mean() > 0.99
        assert np.nanmax(np.abs(planes[name] - truth)) <= 1.0


def test_blurred_stripes_are_left_for_the_next_wider_ones() -> None:
    sharp, blurred = Scene(), Scene(blur=1.6)
    for scene, finest in ((sharp, 2), (blurred, 8)):
        found = scene.scan(GrayCode())
        assert int(np.median(found.planes["stripe"])) >= finest
        direct, indirect = errors(found, scene)
        assert direct < 0.03
        assert indirect < 0.03
    assert np.median(sharp.scan(GrayCode()).planes["stripe"]) == 2


@pytest.mark.parametrize("axis", list(Axis))
def test_one_image_separates_at_a_lower_resolution(axis: Axis) -> None:
    scene = Scene(leakage=LEAK)
    found = scene.scan(SingleImage(stripe=2, axis=axis, window=5, radiometry=radiometry()))
    assert found.direct.shape == (24, 32)
    truth = [
        plane.reshape(24, 4, 32, 4).mean(axis=(1, 3)) for plane in (scene.direct, scene.indirect)
    ]
    assert np.abs(found.direct - truth[0]).mean() < 0.01 * FULL
    assert np.abs(found.global_ - truth[1]).mean() < 0.012 * FULL


def test_the_newest_image_of_a_stream_is_the_result() -> None:
    brighter = iter([0.5, 0.7, 0.9])
    scene = Scene(change=lambda light, _: light * next(brighter))
    found = scene.scan(SingleImage(stripe=2, repeat=3, references=()))
    still = Scene(change=lambda light, _: light * 0.9).scan(
        SingleImage(stripe=2, repeat=1, references=())
    )
    np.testing.assert_allclose(found.direct, still.direct, rtol=1e-3)
    assert found.facts["images"] == 3


def test_fitted_deviations_are_those_of_repeated_scans() -> None:
    """What is stated against what ten scans do, for the methods that state it."""
    for spec in (
        Sinusoid(phases=6),
        RandomPhase(phases=5),
        GrayCode(average=2),
    ):
        scene = Scene(sigma=0.01, ambient=0.06)
        runs = [scene.scan(spec, seed=seed) for seed in range(10)]
        for name in ("direct", "global"):
            values = np.stack([r.direct if name == "direct" else r.global_ for r in runs])
            spread = float(np.sqrt(values.var(axis=0, ddof=1).mean()))
            stated = float(np.sqrt((of_noise(runs[0].planes, f"{name}_std") ** 2).mean()))
            assert stated == pytest.approx(spread, rel=0.15), (type(spec).__name__, name)


def test_a_projector_with_a_gamma_is_found_out() -> None:
    found = Scene(gamma=2.2).scan(Sinusoid(phases=5))
    assert any("tone curve" in line for line in found.facts["advice"])


def test_an_exposure_that_saturates_is_flagged() -> None:
    scene = Scene(change=lambda light, _: light * 2.5)
    for spec in (Checkerboard(), Sinusoid(), GrayCode(), RandomBinary()):
        quality = scene.scan(spec).quality
        assert ((quality & np.uint16(Quality.SATURATED)) != 0).mean() > 0.2


@pytest.mark.parametrize("pixel_format", [PixelFormat.BAYER_GB16, PixelFormat.RGB16])
@pytest.mark.parametrize(
    "spec",
    [*SPECS, SingleImage(stripe=2, window=5, radiometry=radiometry())],
    ids=lambda s: f"{type(s).__name__}-{s.average}",
)
def test_colour_cameras_see_a_grey_scene_in_grey(spec: AnyScan, pixel_format: PixelFormat) -> None:
    grey = Scene(leakage=LEAK).scan(spec)
    colour = Scene(leakage=LEAK, pixel_format=pixel_format).scan(spec)
    assert colour.direct.shape == colour.global_.shape == (*grey.direct.shape, 3)
    assert colour.quality.shape == grey.quality.shape
    for name in ("direct", "global_"):
        apart = getattr(colour, name) - getattr(grey, name)[..., None]
        # a mosaic's colours are interpolated, and its stripes are seen at half the resolution
        coarse = isinstance(spec, SingleImage) and pixel_format.bayer
        assert float(np.sqrt(np.mean(apart**2))) < (0.2 if coarse else 0.012) * FULL
    for name, plane in colour.planes.items():
        assert plane.shape[:2] == grey.direct.shape
        assert (plane.ndim == 3) == (name in PLANES)
