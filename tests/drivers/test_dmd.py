"""Diamond mirrors and bit planes."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import dmd


@pytest.mark.parametrize("odd_rows_right", [True, False])
def test_each_mirror_takes_the_point_at_its_centre(odd_rows_right: bool) -> None:
    y, x = np.mgrid[: dmd.ROWS, : 2 * dmd.COLUMNS]
    mirrors_x = dmd.to_mirrors(x, odd_rows_right=odd_rows_right)
    mirrors_y = dmd.to_mirrors(y, odd_rows_right=odd_rows_right)
    assert mirrors_x.shape == (dmd.ROWS, dmd.COLUMNS)
    rows, columns = np.mgrid[: dmd.ROWS, : dmd.COLUMNS]
    np.testing.assert_array_equal(mirrors_y, rows)
    shifted = rows % 2 == (1 if odd_rows_right else 0)
    np.testing.assert_array_equal(mirrors_x, 2 * columns + shifted)
    # Neighbours along a mirror's edges are one step away in both directions: the diamond.
    assert set(np.abs(np.diff(mirrors_x.astype(int), axis=0)).ravel()) == {1}


def test_shapes_stay_as_they_were_drawn_and_half_lit_stays_half_lit() -> None:
    y, x = np.mgrid[: dmd.ROWS, : 2 * dmd.COLUMNS]
    disc = ((x - 900) ** 2 + (y - 500) ** 2 < 400**2).astype(np.uint8) * 255
    mirrors = dmd.to_mirrors(disc)
    assert set(np.unique(mirrors)) == {0, 255}
    area = np.count_nonzero(mirrors) * 2  # a mirror stands for two points of the grid
    assert area == pytest.approx(np.pi * 400**2, rel=2e-3)
    for size in (2, 4, 6, 19 * 3):
        checker = (x // size + y // size) % 2
        assert dmd.to_mirrors(checker).mean() == pytest.approx(0.5, abs=0.01)


def test_planes_are_green_red_blue_least_bit_first() -> None:
    rng = np.random.default_rng(1)
    planes = [rng.integers(0, 2, (6, 8), np.uint8) * np.uint8(255) for _ in range(24)]
    frame = dmd.pack(planes)
    for number, image in enumerate(planes):
        np.testing.assert_array_equal(dmd.plane(frame, number), image)
    np.testing.assert_array_equal(frame[..., 1] & 1, planes[0] & 1)
    np.testing.assert_array_equal(frame[..., 0] >> 7, planes[15] & 1)
    np.testing.assert_array_equal(frame[..., 2] & 1, planes[16] & 1)
    np.testing.assert_array_equal(dmd.plane(frame, 1, 8), frame[..., 0])
    for count in (0, 25):
        with pytest.raises(ValueError, match="1 to 24 planes"):
            dmd.pack([planes[0]] * count)
