"""Separation by the brightest and darkest samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from daemon.separation.estimator import Lighting, NotYet, Observation, Quality
from daemon.separation.extremes import Extremes
from daemon.separation.radiometry import Response

BYTE = Response(full_scale=255)


def counts(light: NDArray[Any], black: float) -> NDArray[np.uint16]:
    return np.asarray(np.rint(light + black), dtype=np.uint16)


def feed(estimator: Extremes, frames: NDArray[Any]) -> Extremes:
    for index, frame in enumerate(frames):
        estimator.update(frame, Observation(pattern=index))
    return estimator


@given(
    hnp.arrays(np.uint8, (4, 3, 5), elements=st.sampled_from([0, 1, 127, 128, 254, 255])),
    st.sampled_from([0.25, 0.5, 1.0]),
    st.sampled_from([0.0, 0.06]),
)
def test_nothing_wraps_and_float64_agrees(
    frames: NDArray[np.uint8], alpha: float, leakage: float
) -> None:
    found = feed(Extremes(BYTE, lit_fraction=alpha, leakage=leakage), frames).result()
    high, low = frames.astype(np.float64).max(0), frames.astype(np.float64).min(0)
    g = alpha + leakage * (1 - alpha)
    np.testing.assert_allclose(found.direct, (high - low) / (1 - leakage), rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(
        found.global_, (low - leakage * high) / ((1 - leakage) * g), rtol=1e-5, atol=1e-3
    )
    assert found.direct.dtype == np.float32


def test_uint16_extremes_at_both_ends() -> None:
    frames = np.array([[[0, 65535]], [[65535, 65535]]], dtype=np.uint16)
    found = feed(
        Extremes(Response(full_scale=65535), lit_fraction=0.5, leakage=0.0), frames
    ).result()
    assert found.direct.tolist() == [[65535.0, 0.0]]
    assert found.global_.tolist() == [[0.0, 131070.0]]
    assert (found.quality & Quality.SATURATED).all()


@given(hnp.arrays(np.uint8, (6, 4, 4)), st.permutations(range(6)))
def test_order_does_not_matter(frames: NDArray[np.uint8], order: list[int]) -> None:
    one = feed(Extremes(BYTE, lit_fraction=0.5, leakage=0.0), frames).result()
    other = feed(Extremes(BYTE, lit_fraction=0.5, leakage=0.0), frames[order]).result()
    assert one.direct.tobytes() == other.direct.tobytes()
    assert one.quality.tobytes() == other.quality.tobytes()


def test_average_is_taken_before_the_comparison() -> None:
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 256, (3, 4, 5, 6), dtype=np.uint8)  # 3 patterns of 4 frames
    estimator = Extremes(BYTE, lit_fraction=0.5, leakage=0.0, average=4)
    for pattern, of_pattern in enumerate(frames):
        for sub, frame in enumerate(of_pattern):
            estimator.update(frame, Observation(pattern=pattern, last=sub == 3))
    means = frames.astype(np.float64).mean(1)
    found = estimator.result()
    np.testing.assert_allclose(found.direct, means.max(0) - means.min(0), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(found.global_, 2 * means.min(0), rtol=1e-6)


def test_an_average_is_over_light_not_over_encoded_counts() -> None:
    response = Response(full_scale=255, tone="gamma:2")
    estimator = Extremes(response, lit_fraction=1.0, leakage=0.0, average=2)
    for pattern, levels in enumerate([(0, 0), (0, 255)]):
        for sub, level in enumerate(levels):
            frame = np.full((2, 2), level, dtype=np.uint8)
            estimator.update(frame, Observation(pattern=pattern, last=sub == 1))
    assert estimator.result().direct.tolist() == [[127.5, 127.5]] * 2


def test_an_average_without_its_last_frame_is_over_the_rest() -> None:
    estimator = Extremes(BYTE, lit_fraction=1.0, leakage=0.0, average=2)
    dark, lit, garbled = (np.full((2, 2), v, dtype=np.uint8) for v in (10, 50, 255))
    estimator.update(dark, Observation(pattern=0, last=False))
    estimator.update(garbled, Observation(pattern=0, last=True, used=False, reason="incomplete"))
    estimator.update(lit, Observation(pattern=1, last=False))
    with pytest.raises(NotYet):
        estimator.result()
    estimator.update(lit, Observation(pattern=1, last=True))
    found = estimator.result()
    assert (found.direct == 40).all()
    assert found.facts["unused_frames"] == 1
    assert not (found.quality & Quality.SATURATED).any()


def test_a_result_changes_nothing() -> None:
    rng = np.random.default_rng(2)
    frames = rng.integers(0, 65536, (5, 6, 7), dtype=np.uint16)
    response = Response(full_scale=65535)
    asked = Extremes(response, lit_fraction=0.5, leakage=0.1)
    for index, frame in enumerate(frames):
        asked.update(frame, Observation(pattern=index))
        if index:
            asked.result()
    left_alone = feed(Extremes(response, lit_fraction=0.5, leakage=0.1), frames)
    assert asked.result().direct.tobytes() == left_alone.result().direct.tobytes()
    assert asked.result().global_.tobytes() == left_alone.result().global_.tobytes()


def test_frames_are_only_read_and_not_kept() -> None:
    frame = np.full((3, 3), 7, dtype=np.uint8)
    frame.setflags(write=False)
    estimator = Extremes(BYTE, lit_fraction=0.5, leakage=0.0)
    estimator.update(frame, Observation())
    buffer = np.full((3, 3), 9, dtype=np.uint8)
    estimator.update(buffer, Observation(pattern=1))
    buffer[...] = 200
    assert (estimator.result().direct == 2).all()


@pytest.mark.parametrize("references", ["ambient", "black", "black+white"])
def test_ambient_light_is_removed_whatever_tells_of_it(references: str) -> None:
    rng = np.random.default_rng(3)
    direct, indirect = rng.uniform(2000, 9000, (2, 8, 9))
    ambient, leakage, alpha = 3000.0, 0.08, 0.5
    g = alpha + leakage * (1 - alpha)
    lit = direct + g * indirect + ambient
    unlit = leakage * direct + g * indirect + ambient
    shown = {
        "ambient": np.full_like(direct, ambient),
        "black": ambient + leakage * (direct + indirect),
        "white": ambient + direct + indirect,
    }
    estimator = Extremes(Response(full_scale=65535, black=100), lit_fraction=alpha, leakage=leakage)

    for name in references.split("+"):
        estimator.update(counts(shown[name], 100), Observation(lighting=Lighting(name)))
    for index, light in enumerate((lit, unlit)):
        estimator.update(counts(light, 100), Observation(pattern=index))
    found = estimator.result()
    np.testing.assert_allclose(found.direct, direct, atol=2)
    np.testing.assert_allclose(found.global_, indirect, atol=4)


def test_what_cannot_be_respected_is_refused() -> None:
    estimator = Extremes(BYTE, lit_fraction=0.5, leakage=0.0)
    frame = np.zeros((2, 2), dtype=np.uint8)
    with pytest.raises(ValueError, match="strength"):
        estimator.update(frame, Observation(strength=0.9))
