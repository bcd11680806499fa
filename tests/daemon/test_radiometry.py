"""From counts to linear light."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from daemon.separation.radiometry import FrameMean, Response, decode, encode

TONES = ["linear", "srgb", "gamma:2.2", "gamma:1"]


@pytest.mark.parametrize("tone", TONES)
@pytest.mark.parametrize("full_scale", [255, 1023, 4095, 65535])
def test_full_scale_is_kept(tone: str, full_scale: int) -> None:
    dtype = np.uint8 if full_scale == 255 else np.uint16
    ends = Response(full_scale=full_scale, tone=tone).linear(np.array([0, full_scale], dtype=dtype))
    assert ends.dtype == np.float32
    assert ends.tolist() == [0.0, float(full_scale)]


@pytest.mark.parametrize("tone", TONES)
def test_every_count_survives_the_way_there_and_back(tone: str) -> None:
    counts = np.arange(256, dtype=np.uint8)
    light = Response(full_scale=255, tone=tone).linear(counts)
    back = encode(light.astype(np.float64) / 255, tone) * 255
    np.testing.assert_allclose(back, counts, atol=1e-3)
    np.testing.assert_allclose(Response(full_scale=255, tone=tone).counts(light), counts, atol=1e-3)


@given(st.floats(0, 1), st.sampled_from(TONES))
def test_encode_inverts_decode(value: float, tone: str) -> None:
    there = decode(np.asarray(value), tone)
    assert float(encode(there, tone)) == pytest.approx(value, abs=1e-6)


def test_black_is_removed_as_light_and_noise_below_it_stays_negative() -> None:
    linear = Response(full_scale=255, black=16)
    assert linear.linear(np.array([10, 16, 116], dtype=np.uint8)).tolist() == [-6.0, 0.0, 100.0]
    curved = Response(full_scale=255, black=16, tone="srgb")
    found = curved.linear(np.array([10, 16, 116], dtype=np.uint8))
    plain = Response(full_scale=255, tone="srgb").linear(np.array([10, 16, 116], dtype=np.uint8))
    np.testing.assert_allclose(found, plain - plain[1], rtol=1e-6, atol=1e-6)
    assert found[0] < 0


@given(hnp.arrays(np.uint8, (3, 4)))
def test_means_of_counts_agree_with_counts(counts: NDArray[np.uint8]) -> None:
    for tone in TONES:
        response = Response(full_scale=255, black=3, tone=tone)
        between = response.linear_between(counts.astype(np.float32))
        np.testing.assert_allclose(between, response.linear(counts), rtol=1e-5, atol=1e-4)


def test_a_mean_does_not_wrap() -> None:
    for dtype, full in ((np.uint8, 255), (np.uint16, 65535)):
        mean = FrameMean(Response(full_scale=full))
        for _ in range(300):
            mean.add(np.full((2, 2), full, dtype=dtype))
        assert (mean.value() == full).all()


def test_a_mean_needs_frames_and_can_begin_again() -> None:
    mean = FrameMean(Response(full_scale=255))
    with pytest.raises(ValueError, match="no frame"):
        mean.value()
    mean.add(np.full((2, 2), 9, dtype=np.uint8))
    mean.clear()
    mean.add(np.full((2, 2), 4, dtype=np.uint8))
    assert (mean.value() == 4).all()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"full_scale": 0}, "full scale"),
        ({"full_scale": 255, "black": 255.0}, "black level"),
        ({"full_scale": 255, "tone": "rec709"}, "tone curve"),
        ({"full_scale": 255, "tone": "gamma:0"}, "gamma"),
    ],
)
def test_nonsense_is_refused(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Response(**wrong)  # type: ignore[arg-type]
