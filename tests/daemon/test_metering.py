"""Levels of pictures, and the exposure that is chosen by them."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.separation.exposure import TARGET, Limits
from daemon.separation.metering import Level, choose, level_of
from daemon.separation.radiometry import Response

MONO = Response(full_scale=4095, black=64.0)
MOSAIC = Response(full_scale=4095, black=64.0, bayer="RG")


def picture(
    level: float, *, bright: float = 0.5, shape: tuple[int, int] = (120, 160)
) -> np.ndarray:
    """A dark picture of which a share is at a level, of full scale."""
    counts = np.full(shape, 64, np.uint16)
    counts.reshape(-1)[: round(bright * counts.size)] = round(64 + level * (4095 - 64))
    return counts


def test_the_level_is_that_of_the_brightest_thousandth() -> None:
    found = level_of(picture(0.6, bright=0.01), MONO, 5000.0)
    assert found.share == pytest.approx(0.6, abs=1e-3)
    assert (found.saturated, found.clipped) == (0.0, False)
    assert found.light == pytest.approx(0.6 / 5e-3, rel=1e-2)


def test_a_few_hot_pixels_do_not_make_a_level() -> None:
    pixels = picture(0.6)
    pixels[0, :8] = 4095  # 0.04 %
    found = level_of(pixels, MONO, 5000.0)
    assert found.share == pytest.approx(0.6, abs=1e-3)
    assert not found.clipped
    assert found.saturated == pytest.approx(8 / pixels.size)


def test_of_a_mosaic_the_brightest_colour_counts() -> None:
    pixels = picture(0.3, bright=1.0)
    pixels[::2, ::2] = 4095  # red: over the whole mosaic a quarter, of its own all
    assert level_of(pixels, MOSAIC, 5000.0).clipped
    pixels[::2, ::2] = 64
    pixels[0:20:2, 0:20:2] = round(64 + 0.7 * 4031)  # 100 of 4800 red ones
    assert level_of(pixels, MOSAIC, 5000.0).share == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize("tone", ["srgb", "gamma:2.2"])
def test_levels_are_of_linear_light(tone: str) -> None:
    response = Response(full_scale=255, tone=tone)
    counts = float(response.counts(np.array([0.5 * response.linear_full_scale], np.float32))[0])
    pixels = np.full((20, 20), round(counts), np.uint8)
    assert level_of(pixels, response, 1.0).share == pytest.approx(0.5, abs=0.01)


def test_a_saturation_below_full_scale_is_the_top() -> None:
    response = Response(full_scale=4095, saturation=3000.0)
    assert level_of(np.full((8, 8), 3000, np.uint16), response, 1.0).clipped
    assert level_of(np.full((8, 8), 1500, np.uint16), response, 1.0).share == pytest.approx(0.5)


class Scene:
    """A linear camera before a scene that saturates it at `full_us`, with some noise floor."""

    def __init__(self, full_us: float, floor: float = 0.002) -> None:
        self.full_us = full_us
        self.floor = floor
        self.asked: list[float] = []

    def look(self, exposure_us: float) -> Level:
        self.asked.append(exposure_us)
        share = min(1.0, exposure_us / self.full_us + self.floor)
        return Level(share, 0.2 if share >= 1 else 0.0, share >= 1, exposure_us)


WIDE = Limits(10.0, 1e6)


@pytest.mark.parametrize("start_us", [10.0, 1e3, 2e4, 1e6])
@pytest.mark.parametrize("full_us", [50.0, 3e3, 2.5e4, 9e5])
def test_it_converges_from_anywhere(start_us: float, full_us: float) -> None:
    scene = Scene(full_us)
    found = choose(scene.look, start_us, WIDE)
    assert found.level.share == pytest.approx(TARGET, rel=0.05)
    assert not found.problem
    assert found.looks == len(scene.asked) <= 10
    assert found.exposure_us == scene.asked[-1]  # what is kept was looked at


def test_from_near_it_takes_two_looks() -> None:
    assert choose(Scene(2e4).look, 5e3, WIDE).looks == 2


def test_too_dark_at_the_longest_is_said() -> None:
    found = choose(Scene(1e8).look, 100.0, Limits(10.0, 1e5))
    assert found.exposure_us == 1e5
    assert "too dark at the longest exposure that may be chosen (100000 µs)" in found.problem
    assert found.facts()["problem"] == found.problem


def test_no_light_at_all_ends_at_the_longest() -> None:
    found = choose(lambda us: Level(-0.001, 0.0, False, us), 100.0, Limits(10.0, 1e5))
    assert found.exposure_us == 1e5
    assert "too dark" in found.problem


def test_saturated_at_the_shortest_is_said() -> None:
    found = choose(Scene(5.0).look, 1e4, Limits(10.0, 1e5))
    assert found.exposure_us == 10.0
    assert "saturated at the shortest" in found.problem


def test_light_that_does_not_keep_still_is_said() -> None:
    shares = iter([0.2, 0.4] * 5)
    found = choose(lambda us: Level(next(shares), 0.0, False, us), 1e3, Limits(10.0, 1e9))
    assert "does not keep still" in found.problem


def test_under_a_projector_exposures_are_whole_periods() -> None:
    period = 1e6 / 60
    scene = Scene(5.2 * period)
    found = choose(scene.look, 7777.0, Limits(10.0, 1e6, period))
    assert all(us / period == pytest.approx(round(us / period)) for us in scene.asked)
    assert round(found.exposure_us / period) == 4  # .77; five would be .96
    assert not found.problem


def test_one_period_is_the_shortest_and_a_longest_below_it_overrules() -> None:
    period = 1e6 / 60
    assert "saturated" in choose(Scene(1e3).look, 1e5, Limits(10.0, 1e6, period)).problem
    assert Limits(10.0, 5e3, period).allowed(4e3) == 4e3
