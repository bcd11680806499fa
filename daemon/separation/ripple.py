"""The pattern in what should be free of it: a sinusoid's components against its own phase.

Three phases fit any three frames, so that nothing is left over to tell that the light was no
sinusoid. But then mean and amplitude depend on where in the wave a pixel lies: the harmonics of a
projector's gamma make the amplitude go up and down three times a period, a frame that was brighter
or is another's makes mean and amplitude do so once or twice.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

_HARMONICS = 3
_COLLAPSED = 0.8  # of one: what phases add up to that are all alike
_ENOUGH = 400  # pixels


def ripple(mean: Plane, wave: NDArray[np.complex64], strong: NDArray[np.bool_]) -> float | None:
    """The largest part of the amplitude by which the mean or the amplitude goes with the phase.

    `mean` (H, W), `wave` (H, W) complex: amplitude and phase; `strong` (H, W): where the wave is
    told from noise. Both are compared with their surroundings. None where too little is strong.
    """
    if np.count_nonzero(strong) < _ENOUGH:
        return None
    amplitude = np.abs(wave).astype(np.float32)
    around = _local(amplitude, strong)
    turn = np.angle(wave[strong])
    basis = [np.ones(turn.shape)]
    for harmonic in range(1, _HARMONICS + 1):
        basis += [np.cos(harmonic * turn), np.sin(harmonic * turn)]
    design = np.stack(basis)
    normal = design @ design.T
    once, twice = (abs(np.mean(np.exp(1j * n * turn))) for n in (1, 2))
    if twice > _COLLAPSED and once < _COLLAPSED:
        return 1.0  # two opposite phases alone: two of the frames are one
    if np.linalg.cond(normal) > 1e3:  # the phases do not go round
        return None
    sizes = []
    for plane in (amplitude, np.asarray(mean, dtype=np.float32)):
        part = ((plane - _local(plane, strong)) / np.maximum(around, np.float32(1e-6)))[strong]
        found = np.linalg.solve(normal, design @ np.clip(part, -1.0, 1.0))
        sizes += [float(np.hypot(found[2 * n - 1], found[2 * n])) for n in (1, 2, 3)]
    return max(sizes)


def _local(plane: Plane, strong: NDArray[np.bool_]) -> Plane:
    """The mean of the strong pixels around each."""
    size = (33, 33)
    weight = cv2.blur(strong.astype(np.float32), size)
    total = cv2.blur(np.where(strong, plane, np.float32(0)), size)
    return np.asarray(total / np.maximum(weight, np.float32(1e-3)), dtype=np.float32)
