"""What three phases tell of themselves: a bent tone curve, wrong phases, and creases, which are
neither."""

from __future__ import annotations

from math import tau

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.ripple import Ripple, ripple

THIRDS = (0.0, tau / 3, 2 * tau / 3)


def _rippled(
    gamma: float = 1.0,
    phases: tuple[float, ...] = THIRDS,
    exposures: tuple[float, ...] = (1.0, 1.0, 1.0),
    creases: float = 0.0,
) -> Ripple:
    """Of a wall under a wave, whose global light is half as much again; in some columns (a fifth)
    it goes with the wave."""
    y, x = np.mgrid[:96, :128]
    phi = tau * (x + 0.3 * y) / 11.0
    crease = creases * (x % 40 < 8)
    frames = []
    for phase, exposure in zip(phases, exposures, strict=True):
        wave = (0.5 + 0.5 * np.sin(phi + phase)) ** gamma
        local = 0.25 + crease * np.sin(phi + phase) ** 2 + crease * np.sin(phi + phase + 1.0)
        frames.append(exposure * (wave + local))
    stack: NDArray[np.float64] = np.stack(frames)
    wave = np.tensordot(np.exp(1j * np.asarray(THIRDS)), stack, 1) * (2 / 3)
    found = ripple(
        stack.mean(axis=0).astype(np.float32),
        wave.astype(np.complex64),
        np.ones(phi.shape, dtype=np.bool_),
    )
    assert found is not None
    return found


def test_a_right_wave_has_no_ripple() -> None:
    assert max(_rippled().tone, _rippled().frames) < 0.005


@pytest.mark.parametrize("gamma", [0.8, 1.3, 2.2])
def test_a_bent_tone_curve_is_told_by_the_third_harmonic(gamma: float) -> None:
    assert _rippled(gamma=gamma).tone > 0.03


@pytest.mark.parametrize("phases", [(0.0, tau / 4, tau / 2), (0.0, 0.0, tau / 3), (0.0, 2.0, 4.0)])
def test_phases_that_are_not_thirds_are_told(phases: tuple[float, ...]) -> None:
    assert _rippled(phases=phases).frames > 0.05


def test_a_frame_of_another_exposure_is_told() -> None:
    assert _rippled(exposures=(1.0, 1.1, 1.0)).frames > 0.05


def test_creases_are_neither() -> None:
    found = _rippled(creases=0.3)
    assert found.tone < 0.03
    assert found.frames < 0.05
