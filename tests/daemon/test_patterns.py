"""Patterns as images."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.patterns import lit_fraction, render
from protocol.patterns import (
    BLACK,
    WHITE,
    Axis,
    Checker,
    GrayCode,
    RandomBinary,
    RandomPhase,
    Sinusoid,
    Solid,
    Stripes,
)

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


@pytest.mark.parametrize("phase", [0.0, np.pi / 2, 2 * np.pi / 3])
@pytest.mark.parametrize("kind", [Sinusoid, RandomPhase])
def test_waves_light_half_of_the_source_at_every_phase(
    kind: type[Sinusoid] | type[RandomPhase], phase: float
) -> None:
    assert lit_fraction(kind(phase=phase), 320, 240) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("axis", list(Axis))
def test_gray_code_neighbours_differ_in_one_bit(axis: Axis) -> None:
    shown = [render(GrayCode(bit=bit, axis=axis), 64, 64) > 0 for bit in range(6)]
    lines = np.stack([image[0] if axis is Axis.X else image[:, 0] for image in shown])
    assert ((lines[:, 1:] != lines[:, :-1]).sum(axis=0) == 1).all()
    binary = np.bitwise_xor.accumulate(lines[::-1].astype(int), axis=0)
    np.testing.assert_array_equal(binary.T @ (1 << np.arange(6)[::-1]), np.arange(64))
    assert (shown[2] != (render(GrayCode(bit=2, axis=axis, inverted=True), 64, 64) > 0)).all()


def test_stripes() -> None:
    image = render(Stripes(width=2, axis=Axis.Y, shift=1), 3, 6)
    assert (image[:, 0] > 0).tolist() == [False, True, True, False, False, True]


def test_random_patches_are_lit_equally_often_and_differently() -> None:
    images = np.stack([render(RandomBinary(index=k, count=10), 60, 48) > 0 for k in range(10)])
    assert (images.sum(axis=0) == 5).all()
    assert len({image.tobytes() for image in images}) == 10
    patches = images[0].reshape(8, 6, 10, 6)
    assert (patches == patches[:, :1, :, :1]).all()
    with pytest.raises(ValueError, match="no image 10 of 10"):
        render(RandomBinary(index=10, count=10), 60, 48)
