"""Light that is not the same under patterns of one lit fraction."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.method import Expose
from daemon.separation.estimator import Lighting, Quality
from daemon.separation.uneven import unevenness
from protocol.scans.anyscan import AnySeparation
from protocol.scans.projected import Checkerboard, RandomBinary
from tests.daemon.scene import FULL, Scene

CLOUDY = np.s_[16:-16, 80:-8]
CLEAR = np.s_[16:-16, 8:48]


class Milk(Scene):
    """A scene whose right half scatters half of what would be direct over a few pixels."""

    def frame(self, step: Expose, rng: np.random.Generator) -> NDArray[np.uint16]:
        self.change = self._scattered if step.lighting is Lighting.PATTERN else _same
        return super().frame(step, rng)

    def _scattered(self, light: NDArray[Any], step: Expose) -> NDArray[Any]:
        assert step.pattern is not None
        shown = patterns.render(step.pattern, self.width, self.height) / 255.0
        near = cv2.GaussianBlur(shown, (0, 0), 2.0, borderType=cv2.BORDER_REFLECT) - shown
        near[:, :64] = 0.0
        return np.asarray(light + 0.5 * self.direct * near)


def _same(light: NDArray[Any], _: Expose) -> NDArray[Any]:
    return light


@pytest.mark.parametrize("spec", [Checkerboard(), RandomBinary()])
def test_what_scatters_over_less_than_a_patch_is_stated_and_told(spec: AnySeparation) -> None:
    scene = Milk(sigma=0.003)
    found = scene.scan(spec)
    true = scene.direct.copy()
    true[:, 64:] *= 0.5
    off = np.abs(found.direct - true)
    stated = found.planes["direct_std"]
    flagged = found.quality & np.uint16(Quality.DISAGREE) != 0
    assert np.median(off[CLOUDY]) > 0.05 * FULL
    assert np.mean(off[CLOUDY] > 5 * stated[CLOUDY]) < 0.05
    assert np.mean(flagged[CLOUDY]) > 0.8
    assert np.mean(flagged[CLEAR]) < 0.01
    assert any("scattered or reflected over less" in line for line in found.facts["advice"])


@pytest.mark.parametrize(("share", "flagged"), [(0.1, False), (0.5, True)])
def test_a_faint_colour_has_no_say(share: float, flagged: bool) -> None:
    """As of a camera whose correction of colours leaves mostly noise of a dim one."""
    uneven = np.array([share, *2 * [(1 - share) / 2]], dtype=np.float32) * np.float32(1000)
    high = np.broadcast_to(uneven, (3, 40, 60, 3)).copy()
    low = high * np.float32(0.2)
    high[1:, :, 30:, 0] *= np.float32(0.6)
    known = np.full(high[0].shape, 0.5, dtype=np.float32)
    found = unevenness(low, high, known, known, 25, shifted=True)
    assert np.all((found.flags[:, 36:] != 0) == flagged)
    assert not np.any(found.flags[:, :24])
    assert np.all(found.off[:, 36:, 0] > 0.1 * uneven[0])
    assert bool(found.advice) == flagged


@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_noise_and_blur_are_not_taken_for_it(sigma: float) -> None:
    found = Scene(sigma=sigma, blur=0.8, leakage=0.02, ambient=0.02).scan(Checkerboard())
    assert not np.any(found.quality & np.uint16(Quality.DISAGREE))
    assert not any("scattered" in line for line in found.facts["advice"])


def test_blurred_edges_of_random_patches_are_not_taken_for_it() -> None:
    """Of patches that are large in the picture, so that most pixels see no edge."""
    found = Scene(sigma=0.003, blur=1.6).scan(RandomBinary(patch=12))
    assert np.mean(found.quality & np.uint16(Quality.DISAGREE) != 0) < 0.01
    assert not any("scattered" in line for line in found.facts["advice"])
