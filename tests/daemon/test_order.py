"""The k most extreme samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from daemon.separation.order import Ranked


@given(
    st.integers(1, 5),
    st.booleans(),
    hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.just(2), st.just(3))),
)
def test_ranks_are_those_of_a_sort(k: int, largest: bool, frames: NDArray[np.uint8]) -> None:
    ranked = Ranked(k, largest=largest)
    for frame in frames:
        ranked.add(frame)
    ordered = np.sort(frames, axis=0)
    ordered = ordered[::-1] if largest else ordered
    expected = [ordered[min(rank, len(frames) - 1)] for rank in range(k)]
    np.testing.assert_array_equal(ranked.planes, np.stack(expected))


def test_frames_are_neither_kept_nor_changed() -> None:
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 65536, (6, 4, 5), dtype=np.uint16)
    ranked = Ranked(3, largest=False)
    buffer = np.empty((4, 5), dtype=np.uint16)
    for frame in frames:
        buffer[...] = frame
        ranked.add(buffer)
        np.testing.assert_array_equal(buffer, frame)
        buffer[...] = 0
    np.testing.assert_array_equal(ranked.planes, np.sort(frames, axis=0)[:3])


def test_nothing_yet() -> None:
    with pytest.raises(ValueError, match="no frame"):
        Ranked(2, largest=True).planes  # noqa: B018
