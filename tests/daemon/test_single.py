"""A single image under stripes: texture that black and white frames take out, stripes too fine."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.envelope import block_mean
from daemon.separation.estimator import Components, Lighting, Observation
from daemon.separation.radiometry import Response
from daemon.separation.single import PeaksAndValleys
from protocol.scans.projected import SingleImage
from tests.daemon.scene import Scene

SHAPE = (96, 160)
LEAK = 0.05


def _texture() -> NDArray[np.float64]:
    """Reflectances of patches of 5 pixels: as coarse as the stripes."""
    rng = np.random.default_rng(2)
    patches = rng.uniform(0.2, 1.0, (SHAPE[0] // 5 + 1, SHAPE[1] // 5 + 1))
    return patches.repeat(5, axis=0).repeat(5, axis=1)[: SHAPE[0], : SHAPE[1]]


def _separated(stripe: int, *, references: bool, dim: float = 1.0) -> tuple[Components, float]:
    """The result, and the error of direct as a part of its mean."""
    texture = 30_000.0 * dim * _texture()
    direct, indirect = 0.7 * texture, 0.5 * texture
    rng = np.random.default_rng(5)
    single = PeaksAndValleys(Response(65535), lit_fraction=0.5, leakage=LEAK, window=4 * stripe + 1)

    def take(level: NDArray[np.float64] | float, lighting: Lighting) -> None:
        shown = LEAK + (1 - LEAK) * np.broadcast_to(level, SHAPE)
        light = 900.0 + direct * shown + indirect * shown.mean()
        frame = np.rint(light + rng.normal(0, 60, SHAPE)).astype(np.uint16)
        single.update(frame, Observation(lighting=lighting, pattern=0, last=True))

    if references:
        take(0.0, Lighting.BLACK)
        take(1.0, Lighting.WHITE)
    take((np.arange(SHAPE[1]) // stripe % 2 == 0).astype(np.float64)[None, :], Lighting.PATTERN)
    found = single.result()
    off = found.direct - block_mean(direct.astype(np.float32), 4)
    return found, float(np.sqrt(np.mean(off**2)) / direct.mean())


def test_black_and_white_frames_take_texture_out() -> None:
    told, error = _separated(4, references=True)
    assert error < 0.04
    assert told.facts["texture_from"] == "black and white frames"
    assert 3.5 < told.facts["stripes_px"] < 4.5
    assert _separated(4, references=False)[1] > 0.2


def test_faint_light_makes_no_peaks_of_noise() -> None:
    """A scene of which white is 17 deviations: noise is a part of direct, no multiple."""
    assert _separated(4, references=True, dim=0.04)[1] < 0.45


def test_stripes_that_the_camera_does_not_resolve_are_told() -> None:
    fine, _ = _separated(1, references=True)
    assert any("camera pixels wide" in line for line in fine.facts["advice"])
    coarse, _ = _separated(3, references=True)
    assert not any("camera pixels wide" in line for line in coarse.facts["advice"])


@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_what_noise_lifts_peaks_by_is_in_the_deviation(sigma: float) -> None:
    """Stripes that blur leaves whole: the rest of the error is noise's."""
    scene = Scene(width=192, height=128, sigma=sigma, blur=0.4, ambient=0.03)
    found = scene.scan(SingleImage(stripe=8, window=17))
    inside = np.s_[3:-3, 3:-3]
    error = (found.direct - block_mean(scene.direct.astype(np.float32), 4))[inside]
    noise, stated = (found.planes[name][inside] for name in ("direct_noise", "direct_std"))
    assert np.mean(error) > 2.0 * np.median(noise)
    assert 0.75 < np.sqrt(np.mean(error**2) / np.mean(stated**2)) < 1.35


def test_blur_that_nothing_tells_is_in_the_deviation_of_fine_stripes() -> None:
    scene = Scene(width=192, height=128, sigma=0.003, blur=0.8)
    for stripe, least, most in ((4, 0.04, 0.06), (8, 0.0, 0.03)):
        found = scene.scan(SingleImage(stripe=stripe, window=17))
        off = found.planes["direct_std"] / found.direct
        assert least < np.median(off) < most
