"""Patterns as images."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.patterns import lit_fraction, render
from protocol.patterns import BLACK, WHITE, Axis, Checker, RandomPhase, Sinusoid, Solid

checkers = st.builds(
    Checker,
    size=st.integers(1, 12),
    shift_x=st.integers(-40, 40),
    shift_y=st.integers(-40, 40),
    inverted=st.booleans(),
)


def test_a_checkerboard_begins_with_a_lit_checker() -> None:
    image = render(Checker(size=2), 5, 4)
    assert image.dtype == np.uint8
    expected = [[255, 255, 0, 0, 255]] * 2 + [[0, 0, 255, 255, 0]] * 2
    assert image.tolist() == expected


def test_a_shift_moves_the_pattern_right_and_down() -> None:
    base = render(Checker(size=3), 40, 30)
    moved = render(Checker(size=3, shift_x=2, shift_y=1), 40, 30)
    np.testing.assert_array_equal(moved[1:, 2:], base[:-1, :-2])


@given(checkers)
def test_inverted_is_the_complement(checker: Checker) -> None:
    other = Checker(
        size=checker.size,
        shift_x=checker.shift_x,
        shift_y=checker.shift_y,
        inverted=not checker.inverted,
    )
    total = render(checker, 37, 23).astype(int) + render(other, 37, 23)
    assert (total == 255).all()


@given(checkers, st.integers(1, 50), st.integers(1, 50))
def test_lit_fraction_is_that_of_the_image(checker: Checker, width: int, height: int) -> None:
    image = render(checker, width, height)
    assert lit_fraction(checker, width, height) == pytest.approx(float(image.mean()) / 255)


def test_solid_levels() -> None:
    assert (render(BLACK, 3, 2) == 0).all()
    assert (render(WHITE, 3, 2) == 255).all()
    assert lit_fraction(Solid(level=0.5), 3, 2) == render(Solid(level=0.5), 3, 2)[0, 0] / 255


def test_an_empty_projector_is_refused() -> None:
    with pytest.raises(ValueError, match="0 x 3"):
        render(WHITE, 0, 3)


@pytest.mark.parametrize("axis", list(Axis))
def test_a_sinusoid_is_one_in_time(axis: Axis) -> None:
    shown = [
        render(Sinusoid(period=16, phase=k * np.pi / 2, axis=axis), 48, 40).astype(int)
        for k in range(4)
    ]
    assert np.abs(shown[0] + shown[2] - 255).max() <= 1
    assert np.abs(shown[1] + shown[3] - 255).max() <= 1
    along = shown[0] if axis is Axis.X else shown[0].T
    assert np.abs(along[:, 16:] - along[:, :-16]).max() <= 1
    assert np.abs(along[0] - along[4]).max() > 60  # woven: the other axis varies too


def test_plain_stripes_without_a_weave() -> None:
    image = render(Sinusoid(period=8, weave=0.0), 16, 4)
    assert (image == image[0]).all()
    assert image[0, 0] == 128


def test_random_phases_are_the_same_in_each_image_of_a_seed() -> None:
    base = render(RandomPhase(patch=4), 64, 48)
    assert (base == render(RandomPhase(patch=4), 64, 48)).all()
    assert (base != render(RandomPhase(patch=4, seed=2), 64, 48)).any()
    opposite = render(RandomPhase(patch=4, phase=np.pi), 64, 48)
    assert np.abs(base.astype(int) + opposite - 255).max() <= 1
    patches = base.reshape(12, 4, 16, 4)
    assert (patches == patches[:, :1, :, :1]).all()


def test_the_brightness_of_random_phases_is_uniform() -> None:
    levels = render(RandomPhase(patch=1), 256, 256)
    counts, _ = np.histogram(levels, bins=8, range=(0, 256))
    assert counts.min() > 0.9 * counts.mean()


@pytest.mark.parametrize("pattern", [Sinusoid(), RandomPhase()])
def test_waves_light_half_of_the_source(pattern: Sinusoid | RandomPhase) -> None:
    assert lit_fraction(pattern, 320, 240) == pytest.approx(0.5, abs=0.01)
