"""Separation from a pattern and its complement."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.separation.estimator import Lighting, NotYet, Observation
from daemon.separation.pair import ComplementPair
from daemon.separation.radiometry import Response

DEEP = Response(full_scale=65535)


@pytest.mark.parametrize("alpha", [0.3, 0.5, 0.75])
@pytest.mark.parametrize("ambient_from", ["", "ambient", "black"])
def test_components_come_back(alpha: float, ambient_from: str) -> None:
    rng = np.random.default_rng(4)
    direct, indirect = rng.uniform(3000, 15000, (2, 10, 12))
    b, ambient = 0.06, 2500.0 if ambient_from else 0.0
    g, h = alpha + b * (1 - alpha), 1 - alpha + b * alpha
    lit = np.arange(12) < 6  # the pixels about its edge are split as their neighbours are
    away = np.s_[:, [0, 1, 2, 9, 10, 11]]
    pair = ComplementPair(DEEP, lit_fraction=alpha, leakage=b)
    shown = {"ambient": ambient + 0 * direct, "black": ambient + b * (direct + indirect)}
    if ambient_from:
        reference = np.rint(shown[ambient_from]).astype(np.uint16)
        pair.update(reference, Observation(lighting=Lighting(ambient_from)))
    first = np.where(lit, direct, b * direct) + g * indirect + ambient
    second = np.where(lit, b * direct, direct) + h * indirect + ambient
    for index, light in enumerate((first, second)):
        pair.update(np.rint(light).astype(np.uint16), Observation(pattern=index))
    found = pair.result()
    np.testing.assert_allclose(found.direct[away], direct[away], atol=12)
    np.testing.assert_allclose(found.global_[away], indirect[away], atol=12)
    np.testing.assert_allclose(found.direct + found.global_, direct + indirect, atol=24)


def test_both_images_are_needed() -> None:
    pair = ComplementPair(DEEP, lit_fraction=0.5, leakage=0.0)
    frame = np.zeros((4, 4), dtype=np.uint16)
    pair.update(frame, Observation(pattern=0))
    pair.update(frame, Observation(pattern=1, used=False, reason="incomplete"))
    with pytest.raises(NotYet, match="complement is missing"):
        pair.result()


def test_a_wrong_tone_curve_shows_in_the_residual() -> None:
    rng = np.random.default_rng(5)
    total = rng.uniform(0.2, 0.8, (32, 32))
    lit = rng.random((32, 32)) < 0.5
    shown = (
        (Observation(lighting=Lighting.BLACK), 0.02 * total),
        (Observation(lighting=Lighting.WHITE), total),
        (Observation(pattern=0), np.where(lit, 0.8, 0.22) * total),
        (Observation(pattern=1), np.where(lit, 0.22, 0.8) * total),
    )
    found = {}
    for tone in ("linear", "gamma:2.2"):
        pair = ComplementPair(Response(full_scale=65535, tone=tone), lit_fraction=0.5, leakage=0.02)
        for observation, light in shown:
            pair.update(np.rint(light ** (1 / 2.2) * 65535).astype(np.uint16), observation)
        found[tone] = pair.result().facts
    assert abs(found["gamma:2.2"]["complement_residual"]) < 0.001
    # a picture whose pixels are all different may be noise for all that one picture tells
    assert not [line for line in found["gamma:2.2"]["advice"] if "show no pattern" not in line]
    assert abs(found["linear"]["complement_residual"]) > 0.05
    assert "tone" in found["linear"]["advice"][0]
