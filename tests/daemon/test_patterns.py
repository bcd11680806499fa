"""Patterns as images."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.patterns import lit_fraction, render
from protocol.patterns import BLACK, WHITE, Checker, Solid

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
