"""What blur leaves of checkers tells the blur; what it leaves of a wave is given back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from daemon import patterns
from daemon.separation import blur
from protocol.patterns import Sinusoid as Wave
from protocol.scans.projected import Sinusoid
from protocol.scans.spec import Radiometry
from tests.daemon.scene import Scene


@pytest.mark.parametrize("sigma", [0.0, 0.4, 0.8, 1.4])
def test_checkers_tell_the_blur(sigma: float) -> None:
    kept = {
        size: blur._contrast_left(size, sigma, blur._FINE)  # what the optics leave of them
        for size in (2, 3, 4)
    }
    assert blur.of_optics(kept) == pytest.approx(sigma, abs=0.021)
    assert blur.of_optics({8: 0.9}) == 0.0  # too large to tell


@pytest.mark.parametrize("weave", [0.0, 1.0])
def test_a_wave_loses_what_is_said(weave: float) -> None:
    image = patterns.render(Wave(period=12, weave=weave), 480, 480) - np.float64(127.5)
    left = cv2.GaussianBlur(image, (0, 0), 0.9)[60:-60, 60:-60]
    ratio = float(left.std() / image[60:-60, 60:-60].std())
    assert blur.of_wave(0.9, 12, weave) == pytest.approx(ratio, abs=0.01 if weave else 1e-3)


def test_a_calibrated_blur_unbiases_a_single_period() -> None:
    scene = Scene(blur=0.9, sigma=0.002)
    known = Scene(blur=0.9, sigma=0.002, calibration={"optics_blur_px": 0.9})
    spec = Sinusoid(periods=(12,), phases=8, radiometry=Radiometry(leakage=0.0))
    plain, told = scene.scan(spec), known.scan(spec)
    inside = np.s_[8:-8, 8:-8]
    bias = [float(((c.direct - scene.direct) / scene.direct)[inside].mean()) for c in (plain, told)]
    assert bias[0] < -0.05
    assert abs(bias[1]) < 0.01
    assert (plain.facts["blur_from"], told.facts["blur_from"]) == ("", "calibration")
    two = known.scan(Sinusoid(periods=(12, 20), phases=8, radiometry=Radiometry(leakage=0.0)))
    assert two.facts["blur_from"] == "scan"  # what the frames say goes before
