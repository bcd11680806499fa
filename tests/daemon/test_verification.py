"""The experiments of §3.5 on a made scene whose mapping, leakage and global light are known."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans import catalog
from daemon.scans.method import Bench, Digest, Expose, Taken, Unsuitable
from daemon.separation.estimator import Measurement
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.patterns import WHITE, Checker, Unlit
from protocol.scans.anyscan import AnyScan
from protocol.scans.verifications import (
    Point,
    VerifyCheckerSize,
    VerifyLitFraction,
    VerifyPatchSize,
    VerifyRandomPatterns,
)

WIDTH, HEIGHT = 96, 72  # camera
PROJECTOR = ProjectorInfo(width=128, height=96, refresh_hz=60)
B, BLUR = 0.05, 0.7
DIRECT, GLOBAL, AMBIENT, BLACK = 900.0, 600.0, 40.0, 64.0
Y, X = np.indices((HEIGHT, WIDTH)).astype(np.float32)
COLUMN, ROW = 1.21 * X + 0.03 * Y + 4.3, 1.17 * Y - 0.02 * X + 6.1
POINTS = (Point(x=20, y=20), Point(name="wall", x=60, y=45))


def bench(pixel_format: PixelFormat = PixelFormat.MONO12) -> Bench:
    return Bench(
        CameraInfo(WIDTH, HEIGHT, pixel_format, black_level=BLACK),
        PROJECTOR,
        calibration={"leakage": B, "blur_px": BLUR},
    )


def run(
    spec: AnyScan, shadow: bool = False, pixel_format: str = "Mono12", texture: float = 0.0
) -> Measurement:
    """All steps of a method on the made scene, as the daemon takes them."""
    rng = np.random.default_rng(3)
    method = catalog.method_for(spec, bench(PixelFormat(pixel_format)))
    estimator = method.estimator()
    index = frames = 0
    while (step := method.step(index, estimator.summary())) is not None:
        if isinstance(step, Expose):
            light = seen(step, shadow, texture)
            for sub in range(step.frames):
                noisy = light + rng.normal(BLACK, 2.0, light.shape)
                pixels = np.asarray(np.rint(noisy), dtype=np.uint16)
                estimator.update(pixels, method.observe(step, Taken(index, sub, incomplete=False)))
                frames += 1
        else:
            assert isinstance(step, Digest)
        index += 1
    assert frames == method.planned()
    result = estimator.result()
    assert isinstance(result, Measurement)
    return result


def seen(step: Expose, shadow: bool, texture: float) -> NDArray[Any]:
    if step.pattern is None:
        return np.full((HEIGHT, WIDTH), AMBIENT)
    image = patterns.render(step.pattern, PROJECTOR.width, PROJECTOR.height) / np.float32(255)
    sent = np.asarray(B + (1 - B) * image, dtype=np.float32)
    blurred = cv2.GaussianBlur(sent, (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE)
    direct = DIRECT * cv2.remap(blurred, COLUMN, ROW, cv2.INTER_LINEAR)
    if shadow:
        direct[:, :40] = 0
    direct *= 1 + texture * np.sin(1.9 * X + 1.3 * Y)
    return np.asarray(direct + GLOBAL * sent.mean() + AMBIENT)


@pytest.mark.parametrize("pixel_format", ["Mono12", "BayerRG12"])
def test_points_are_found_and_global_light_is_what_it_was_made(pixel_format: str) -> None:
    spec = VerifyPatchSize(points=POINTS, sizes=(3, 5, 11), average=8)
    measured = run(spec, pixel_format=pixel_format)
    first, second = measured.facts["points"]
    assert (first["name"], second["name"]) == ("A", "wall")
    assert first["projector"] == pytest.approx([COLUMN[20, 20], ROW[20, 20]], abs=0.3)
    assert second["projector"] == pytest.approx([COLUMN[45, 60], ROW[45, 60]], abs=0.3)
    for point in (first, second):
        assert point["global"] == pytest.approx([GLOBAL] * 3, rel=0.08)
    assert all(c["met"] for c in measured.facts["criteria"])
    plot = measured.plots["patch_size"]
    assert [c.name for c in plot.curves] == ["A", "wall"]
    assert plot.curves[0].y[0] == 1.0


def test_a_surface_full_of_detail_is_not_taken_for_noise() -> None:
    spec = VerifyPatchSize(points=POINTS[1:], sizes=(5, 7, 11), average=8)
    [point] = run(spec, texture=0.6).facts["points"]
    assert point["projector"] == pytest.approx([COLUMN[45, 60], ROW[45, 60]], abs=0.3)
    assert point["global"] == pytest.approx([GLOBAL] * 3, rel=0.08)


@pytest.mark.parametrize(
    ("spec", "name"),
    [
        (VerifyRandomPatterns(points=POINTS, patterns=8, average=4), "random_patterns"),
        (VerifyLitFraction(points=POINTS, fractions=(0.2, 0.5, 0.8), average=4), "lit_fraction"),
        (VerifyCheckerSize(points=POINTS, sizes=(4, 8, 16), average=4), "checker_size"),
    ],
)
def test_the_other_experiments(spec: AnyScan, name: str) -> None:
    measured = run(spec)
    assert all(c["met"] for c in measured.facts["criteria"])
    assert len(measured.plots[name].curves) in {1, 2}
    for point in measured.facts["points"]:
        found = np.atleast_1d(point["global"])
        assert found == pytest.approx(np.full(found.size, GLOBAL), rel=0.05)


def test_a_point_in_shadow_is_refused_with_the_remedy() -> None:
    with pytest.raises(Unsuitable, match=r"A \(20, 20\).*--point"):
        run(VerifyPatchSize(points=POINTS, sizes=(3, 5)), shadow=True)


def test_points_must_be_given_and_within_the_picture() -> None:
    with pytest.raises(Unsuitable, match="--point"):
        catalog.method_for(VerifyCheckerSize(), bench())
    with pytest.raises(Unsuitable, match="within the camera's 96 x 72"):
        catalog.method_for(VerifyCheckerSize(points=(Point(x=3, y=30),)), bench())
    with pytest.raises(Unsuitable, match="name of its own"):
        catalog.method_for(VerifyCheckerSize(points=(POINTS[1], POINTS[1])), bench())


def test_squares_are_kept_unlit_around_points() -> None:
    image = patterns.render(Unlit(base=WHITE, points=((10, 6), (0, 0)), size=3), 20, 12)
    assert np.argwhere(image == 0).tolist() == [[y, x] for y in range(2) for x in range(2)] + [
        [y, x] for y in (5, 6, 7) for x in (9, 10, 11)
    ]
    base = Checker(size=4)
    shown = patterns.render(Unlit(base=base, points=((8, 8),), size=6), 20, 16)
    expected = patterns.render(base, 20, 16)
    expected[5:11, 5:11] = 0
    assert np.array_equal(shown, expected)
