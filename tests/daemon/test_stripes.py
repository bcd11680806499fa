"""Stripes of several widths: those that are whole are averaged, and what differs is stated."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.stripes import Resolved, resolved

WIDTHS = (2, 4, 8, 16)
CREASE = np.s_[20:44, 30:60]


def _seen(
    sigma: float, kept: tuple[float, ...], creased: float = 0.0, channels: int = 0
) -> tuple[Resolved, NDArray[np.float32]]:
    rng = np.random.default_rng(5)
    shape = (64, 96, channels) if channels else (64, 96)
    truth = rng.uniform(800, 1200, shape).astype(np.float32)
    contrasts = []
    for width, part in zip(WIDTHS, kept, strict=True):
        contrast = truth * np.float32(part)
        if width == 16:
            contrast[CREASE] *= np.float32(1.0 + creased)
        noise = rng.normal(0, sigma * 2**0.5, shape)
        contrasts.append(np.abs(contrast + noise).astype(np.float32))
    deviation = np.full(shape, max(sigma, 0.1), np.float32)
    return resolved(contrasts, WIDTHS, truth * np.float32(2.0), deviation), truth


@pytest.mark.parametrize("channels", [0, 3])
def test_whole_ones_are_averaged(channels: int) -> None:
    found, truth = _seen(10.0, (0.6, 1.0, 1.0, 1.0), channels=channels)
    error = found.contrast - truth
    assert np.median(found.width) == 4
    assert np.std(error) < 0.75 * 10.0 * 2**0.5
    assert abs(np.mean(error)) < 4.0
    assert np.median(found.spread) < 5.0
    assert not found.disagree.any()


def test_what_the_widest_add_in_a_crease_is_stated_and_flagged() -> None:
    found, _ = _seen(4.0, (0.5, 0.9, 0.97, 1.0), creased=0.4)
    inside = found.spread[24:40, 34:56]
    assert np.median(inside) == pytest.approx(400, rel=0.2)
    assert found.disagree[24:40, 34:56].mean() > 0.9
    away = np.ones(found.disagree.shape, np.bool_)
    away[10:54, 20:70] = False
    assert np.median(found.spread[away]) < 40  # blur, the same all over the scene, is not that
    assert not found.disagree[away].any()
