"""Bayer mosaics in float32."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.estimator import Observation
from daemon.separation.extremes import Extremes
from daemon.separation.mosaic import Mosaic, colour_masks, demosaic, orders_of
from daemon.separation.radiometry import Response

ORDERS = ["RG", "GR", "GB", "BG"]


def mosaic_of(rgb: NDArray[np.float32], bayer: str) -> NDArray[np.float32]:
    masks = colour_masks((rgb.shape[0], rgb.shape[1]), bayer)
    return np.asarray(sum(rgb[..., c] * masks[c] for c in range(3)), dtype=np.float32)


@pytest.mark.parametrize("bayer", ORDERS)
def test_each_sample_has_one_colour(bayer: str) -> None:
    masks = colour_masks((6, 8), bayer)
    assert (masks.sum(0) == 1).all()
    assert [int(m.sum()) for m in masks] == [12, 24, 12]
    assert ["RGB"[int(np.argmax(masks[:, 0, x]))] for x in range(2)] == list(bayer)


@pytest.mark.parametrize("bayer", ORDERS)
def test_an_even_colour_comes_back_to_the_border(bayer: str) -> None:
    rgb = np.broadcast_to(np.array([0.2, 0.7, 0.4], dtype=np.float32), (7, 9, 3))
    np.testing.assert_allclose(demosaic(mosaic_of(rgb, bayer), bayer), rgb, rtol=1e-5)


@pytest.mark.parametrize("bayer", ORDERS)
def test_a_ramp_comes_back_inside(bayer: str) -> None:
    y, x = np.mgrid[0:12, 0:14].astype(np.float32)
    rgb = np.stack([x + 2 * y, 3 * x - y + 20, 50 - x - y], axis=2)
    found = demosaic(mosaic_of(rgb, bayer), bayer)
    np.testing.assert_allclose(found[2:-2, 2:-2], rgb[2:-2, 2:-2], atol=1e-4)


def test_samples_are_kept_and_negative_light_is_too() -> None:
    rng = np.random.default_rng(1)
    mosaic = rng.normal(0, 5, (8, 8)).astype(np.float32)
    found = demosaic(mosaic, "GB")
    for channel, mask in enumerate(colour_masks((8, 8), "GB")):
        np.testing.assert_array_equal(found[..., channel][mask], mosaic[mask])


def test_a_missing_sample_does_not_spread() -> None:
    mosaic = np.ones((9, 9), dtype=np.float32)
    mosaic[4, 4] = np.nan
    found = demosaic(mosaic, "RG")
    assert np.isnan(found).sum() == 1  # its own colour alone
    assert np.isnan(found[4, 4, 0])


@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("sigma", [0.001, 0.03])
def test_what_fine_texture_puts_a_colour_off_by_is_stated(sigma: float, coloured: bool) -> None:
    rng = np.random.default_rng(2)
    grains = rng.normal(0, 1, (120, 160, 3 if coloured else 1)).astype(np.float32)
    texture = cv2.GaussianBlur(grains, (0, 0), 1.5).reshape(120, 160, -1)
    rgb = np.asarray(1 + 0.1 * texture / texture.std() * np.ones(3), dtype=np.float32)
    plane = mosaic_of(rgb, "GB") + rng.normal(0, sigma, (120, 160)).astype(np.float32)
    noise = np.full(plane.shape, sigma, dtype=np.float32)
    mosaic = Mosaic(np.ones(plane.shape, dtype=np.bool_), "GB")
    found = mosaic.colours(plane)
    stated = np.hypot(mosaic.noise(noise), error := mosaic.error(plane, noise, found))
    own = np.moveaxis(colour_masks((120, 160), "GB"), 0, 2)
    off = np.abs(found - rgb)
    assert not np.any(error[own])
    assert 0.6 < np.median(off[~own] / stated[~own]) / 0.6745 < 1.3
    assert np.mean(off > 5 * stated) < 0.01


def test_noise_is_less_where_a_colour_is_of_several_samples() -> None:
    ones = np.ones((8, 10), dtype=np.float32)
    noise = Mosaic(ones > 0, "RG").noise(ones)[2:-2, 2:-2]
    assert noise[0, 0] == pytest.approx([1, 1 / 2, 1 / 2])  # red
    assert noise[0, 1] == pytest.approx([1 / 2**0.5, 1, 1 / 2**0.5])


def test_an_unknown_order_is_refused() -> None:
    with pytest.raises(ValueError, match="RGGB"):
        demosaic(np.zeros((4, 4), dtype=np.float32), "RGGB")


@pytest.mark.parametrize("bayer", ORDERS)
def test_separating_raw_agrees_with_separating_colours(bayer: str) -> None:
    y, x = np.mgrid[0:48, 0:64].astype(np.float32)
    smooth = np.stack([np.sin(x / 25) + 2, np.cos(y / 20) + 2, np.sin((x + y) / 30) + 2], axis=2)
    direct, indirect = 8000 * smooth, 5000 * smooth[::-1]
    lit = (x // 8 + y // 8) % 2 == 0
    raw = Extremes(Response(full_scale=65535, bayer=bayer), lit_fraction=0.5, leakage=0.0)
    colour = Extremes(Response(full_scale=65535), lit_fraction=0.5, leakage=0.0)
    for index, shade in enumerate((lit, ~lit)):
        light = direct * shade[..., None] + 0.5 * indirect
        colour.update(np.rint(light).astype(np.uint16), Observation(pattern=index))
        raw.update(np.rint(mosaic_of(light, bayer)).astype(np.uint16), Observation(pattern=index))
    one, other = raw.result(), colour.result()
    assert one.direct.shape == other.direct.shape == (48, 64, 3)
    inside = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(one.direct[inside], other.direct[inside], rtol=0.02)
    np.testing.assert_allclose(one.global_[inside], other.global_[inside], rtol=0.02)


def test_opencv_cannot_do_it() -> None:
    """Why this exists: should OpenCV learn float32, its result is to be compared with ours."""
    with pytest.raises(cv2.error):
        cv2.cvtColor(np.ones((8, 8), dtype=np.float32), cv2.COLOR_BayerRG2RGB)


@pytest.mark.parametrize("bayer", ["RG", "GR", "GB", "BG"])
@pytest.mark.parametrize("colours", [(0.8, 1.0, 0.9), (0.7, 1.0, 0.7), (1.0, 0.9, 0.6)])
def test_a_mosaic_is_known_by_its_greens(bayer: str, colours: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    grey = rng.uniform(0.2, 1.0, (24, 32)).repeat(5, axis=0).repeat(5, axis=1)
    grey *= rng.normal(1.0, 0.05, grey.shape)
    masks = colour_masks((120, 160), bayer)
    mosaic = np.einsum("cyx,yx,c->yx", masks, grey, np.asarray(colours))
    found = orders_of(np.rint(4000 * mosaic).astype(np.uint16))
    assert bayer in found
    assert len(found) == 2
    assert not orders_of(np.rint(4000 * grey).astype(np.uint16))


def test_a_fine_grating_is_no_mosaic() -> None:
    grating = np.where(np.arange(96) % 2, 900, 500)[None, :].repeat(64, axis=0)
    assert not orders_of(grating.astype(np.uint16))
