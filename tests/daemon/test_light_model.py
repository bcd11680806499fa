"""The equations, forwards and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from daemon.separation import light_model

DIRECT = np.array([[0.0, 0.1, 0.7], [1.0, 0.3, 0.02]], dtype=np.float32)
GLOBAL = np.array([[0.3, 0.0, 0.1], [0.5, 0.9, 0.4]], dtype=np.float32)

alphas = st.floats(0.1, 0.9)
leaks = st.floats(0.0, 0.3)


def seen(lit: NDArray[np.bool_], alpha: float, leakage: float) -> NDArray[np.float32]:
    """Eq. 8, written out: lit pixels have their direct light, unlit ones b of it."""
    indirect = alpha * GLOBAL + leakage * (1 - alpha) * GLOBAL
    return np.asarray(np.where(lit, DIRECT, leakage * DIRECT) + indirect, dtype=np.float32)


@given(alphas | st.just(1.0), leaks)
def test_extremes(alpha: float, leakage: float) -> None:
    everywhere = np.ones(DIRECT.shape, dtype=np.bool_)
    direct, indirect = light_model.from_extremes(
        seen(everywhere, alpha, leakage), seen(~everywhere, alpha, leakage), alpha, leakage
    )
    np.testing.assert_allclose(direct, DIRECT, atol=1e-5)
    np.testing.assert_allclose(indirect, GLOBAL, atol=2e-5)
    assert direct.dtype == indirect.dtype == np.float32


@given(st.floats(0.2, 0.8), leaks, st.integers(0, 63))
def test_complement_pair(alpha: float, leakage: float, lit_bits: int) -> None:
    lit = np.array([lit_bits >> n & 1 for n in range(6)], dtype=np.bool_).reshape(2, 3)
    direct, indirect = light_model.from_complement_pair(
        seen(lit, alpha, leakage), seen(~lit, 1 - alpha, leakage), alpha, leakage
    )
    np.testing.assert_allclose(direct, DIRECT, atol=5e-5)
    np.testing.assert_allclose(indirect, GLOBAL, atol=5e-5)


def test_the_brighter_image_of_a_pair_need_not_be_the_lit_one() -> None:
    """α = 0.8, L_d small: 0.8 L_g in the unlit image outshines L_d + 0.2 L_g in the lit one."""
    direct, indirect = light_model.from_complement_pair(
        np.array([[0.8]], dtype=np.float32), np.array([[0.3]], dtype=np.float32), 0.8
    )
    np.testing.assert_allclose([direct[0, 0], indirect[0, 0]], [0.1, 1.0], rtol=1e-5)


def test_a_pair_is_singular_at_full_light() -> None:
    image = np.ones((1, 1), dtype=np.float32)
    with pytest.raises(ValueError, match="α = 1"):
        light_model.from_complement_pair(image, image, 1.0)


@given(alphas, leaks)
def test_determinants(alpha: float, leakage: float) -> None:
    first, second = light_model.complement_determinants(alpha, leakage)
    assert first == pytest.approx((1 - alpha) * (1 - leakage**2))
    assert second == pytest.approx(alpha * (1 - leakage**2))


@given(alphas)
def test_a_mesh_with_an_open_frame_gives_ambient_too(beta: float) -> None:
    ambient = np.float32(0.05)
    brightest = (DIRECT + np.float32(beta) * GLOBAL + ambient).astype(np.float32)
    darkest = (np.float32(beta) * GLOBAL + ambient).astype(np.float32)
    found = light_model.from_mesh_and_open(brightest, darkest, DIRECT + GLOBAL + ambient, beta)
    np.testing.assert_allclose(found[0], DIRECT, atol=1e-5)
    np.testing.assert_allclose(found[1], GLOBAL, atol=1e-5)
    np.testing.assert_allclose(found[2], ambient, atol=1e-5)


@pytest.mark.parametrize("beta", [0.0, 1.0])
def test_a_mesh_has_holes_and_threads(beta: float) -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        light_model.from_mesh_and_open(DIRECT, DIRECT, DIRECT, beta)


@given(alphas, leaks)
def test_ambient_from_black_and_white_or_black_alone(alpha: float, leakage: float) -> None:
    ambient = np.full_like(DIRECT, 0.05)
    black = ambient + np.float32(leakage) * (DIRECT + GLOBAL)
    white = ambient + DIRECT + GLOBAL
    everywhere = np.ones(DIRECT.shape, dtype=np.bool_)
    extremes = (
        seen(everywhere, alpha, leakage) + ambient,
        seen(~everywhere, alpha, leakage) + ambient,
    )
    both = light_model.ambient_from_black_and_white(black, white, leakage)
    alone = light_model.ambient_from_black(black, *extremes, alpha, leakage)
    np.testing.assert_allclose(both, ambient, atol=1e-5)
    np.testing.assert_allclose(alone, ambient, atol=1e-5)
