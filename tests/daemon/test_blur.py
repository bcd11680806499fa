"""What blur leaves of checkers tells the blur; what it leaves of a wave is given back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from daemon import patterns
from daemon.separation import blur
from daemon.separation.estimator import Components
from daemon.separation.weave import Woven
from protocol.patterns import Sinusoid as Wave
from protocol.scans.projected import Sinusoid
from protocol.scans.spec import Radiometry
from tests.daemon.scene import Scene
from tests.daemon.virtual_scene import VirtualScene


def contrast(size: int, sigma: float) -> float:
    """What a Gaussian leaves of a checker's contrast at the median of all places in a pixel, each
    at the shift at which it is greatest; by the Fourier series of a square wave."""
    places = np.linspace(-0.5, 0.5, 41)[:, None, None]
    shifts = np.arange(0, size, max(1, size // 4))[None, :, None]
    k = np.arange(1, 400, 2)  # harmonics; the first edge is half a pixel before the first centre
    phase = np.pi * k * (places + shifts + 0.5) / size
    left = 4 / (np.pi * k) * np.exp(-0.5 * (np.pi * k * sigma / size) ** 2)
    greatest = np.abs(np.sum(left * np.sin(phase), axis=2)).max(axis=1)
    return float(np.median(np.outer(greatest, greatest)))


@pytest.mark.parametrize("sigma", [0.2, 0.4, 0.8, 1.4])
def test_checkers_tell_the_blur(sigma: float) -> None:
    kept = {size: contrast(size, sigma) for size in (2, 3, 4)}
    assert blur.of_optics(kept) == pytest.approx(sigma, abs=0.021)


def test_sharp_and_large_checkers_tell_none() -> None:
    assert blur.of_optics(dict.fromkeys((2, 3, 4), 1.0)) == 0.0
    assert blur.of_optics({8: 0.9}) == 0.0  # too large to tell


@pytest.mark.parametrize("weave", [0.0, 1.0])
def test_a_wave_loses_what_is_said(weave: float) -> None:
    image = patterns.render(Wave(period=12, weave=weave), 480, 480) - np.float64(127.5)
    left = cv2.GaussianBlur(image, (0, 0), 0.9)[60:-60, 60:-60]
    ratio = float(left.std() / image[60:-60, 60:-60].std())
    assert blur.of_wave(0.9, 12, weave) == pytest.approx(ratio, abs=0.01 if weave else 1e-3)


INSIDE = np.s_[8:-8, 8:-8]


def _bias(scene: Scene, found: Components) -> float:
    return float(((found.direct - scene.direct) / scene.direct)[INSIDE].mean())


def test_plain_stripes_of_one_period_leave_blur_to_a_calibration() -> None:
    """And say so; of several periods, what the frames say goes before it."""
    scene = Scene(blur=0.9, sigma=0.002)
    known = Scene(blur=0.9, sigma=0.002, calibration={"optics_blur_px": 0.9})
    spec = Sinusoid(periods=(12,), phases=8, weave=0.0, radiometry=Radiometry(leakage=0.0))
    plain, told = scene.scan(spec), known.scan(spec)
    assert _bias(scene, plain) < -0.05
    assert abs(_bias(scene, told)) < 0.01
    assert (plain.facts["blur_from"], told.facts["blur_from"]) == ("", "calibration")
    assert any("the blur" in line for line in plain.facts["advice"])
    assert not any("the blur" in line for line in told.facts["advice"])
    two = known.scan(Sinusoid(periods=(12, 20), phases=8, radiometry=Radiometry(leakage=0.0)))
    assert two.facts["blur_from"] == "scan"


@pytest.mark.parametrize("blur_px", [0.0, 0.6, 1.2])
def test_a_weave_tells_the_blur(blur_px: float) -> None:
    scene = Scene(blur=blur_px, sigma=0.005)
    found = scene.scan(Sinusoid(radiometry=Radiometry(leakage=0.0)))
    assert found.facts["blur_from"] == "weave"
    assert found.facts["blur_px"] == pytest.approx(blur_px, abs=0.15)
    assert abs(_bias(scene, found)) < 0.01
    assert np.std(((found.direct - scene.direct) / scene.direct)[INSIDE]) < 0.035  # noise: .025


def test_a_mosaic_of_slanted_and_curved_surfaces_tells_it_too() -> None:
    """What the rig adds to its projector's blur is not known, but adds in squares."""
    spec = Sinusoid(radiometry=Radiometry(leakage=0.02))
    own, more = (
        VirtualScene(defocus=defocus).scan(spec).facts["blur_px"] for defocus in (0.0, 1.2)
    )
    assert own < 0.5
    assert np.sqrt(more**2 - own**2) == pytest.approx(1.2, abs=0.15)


def test_a_wave_too_weak_or_too_fine_tells_no_blur() -> None:
    rng = np.random.default_rng(0)
    noise = (rng.standard_normal((96, 128)) + 1j * rng.standard_normal((96, 128))).astype(
        np.complex64
    )
    light = np.ones(noise.shape, np.float32)
    woven = Woven.of(noise, period=16, weave=1.0)
    assert woven is None or woven.blur(light) is None
    assert Woven.of(np.zeros_like(noise), period=16, weave=1.0) is None
