"""The cost of taking a frame in: `Extremes.update` against in-place NumPy maximum and minimum."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Observation
from daemon.separation.extremes import Extremes
from daemon.separation.radiometry import Response
from tests.benchmarks.ratio import Ratio, in_turn

FRAMES = {
    "1024 x 768 u8": (768, 1024, 8),
    "2448 x 2048 u8": (2048, 2448, 8),
    "2448 x 2048 u16": (2048, 2448, 16),
}
ROUNDS = 60


def run() -> list[Ratio]:
    """Floor over update: 1 is as fast as memory allows."""
    ratios = []
    for name, (height, width, bits) in FRAMES.items():
        full_scale = (1 << bits) - 1
        noise = np.random.default_rng(1)
        frames = [
            noise.integers(0, full_scale, (height, width), np.dtype(f"uint{bits}"))
            for _ in range(3)
        ]  # more than one, so that no cache holds them all
        estimator = Extremes(
            Response(full_scale=full_scale, black=0.0, tone="linear"),
            lit_fraction=0.5,
            leakage=0.0,
        )
        estimator.update(frames[0], Observation())
        high, low = frames[0].copy(), frames[0].copy()
        floor_s, update_s = in_turn([_floor(frames, high, low), _update(frames, estimator)], ROUNDS)
        ratios.append(
            Ratio(
                name=f"separation update, {name}",
                value=floor_s / update_s,
                of="in-place np.maximum + np.minimum over update",
                at_least=0.9,
                facts={"floor_ms": floor_s * 1e3, "update_ms": update_s * 1e3},
            )
        )
    return ratios


def _floor(frames: list[NDArray[Any]], high: NDArray[Any], low: NDArray[Any]) -> Callable[[], None]:
    def act() -> None:
        for frame in frames:
            np.maximum(high, frame, out=high)
            np.minimum(low, frame, out=low)

    return act


def _update(frames: list[NDArray[Any]], estimator: Extremes) -> Callable[[], None]:
    observations = [Observation(pattern=n) for n in range(len(frames))]

    def act() -> None:
        for frame, observation in zip(frames, observations, strict=True):
            estimator.update(frame, observation)

    return act
