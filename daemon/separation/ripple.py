"""The pattern in what should be free of it: a sinusoid's components against its own phase.

Three phases fit any three frames, so that nothing is left over to tell that the light was no
sinusoid. But then mean and amplitude depend on where in the wave a pixel lies. The harmonics of a
gamma make the amplitude go up and down three times a period. Phases that are not thirds of a turn
(they add up to 0 if they are, and only then) make the mean do so once, and a frame that was
brighter than the others both of them.

In a crease, light between surfaces closer than a period goes with the phase as well. That is a part
of the pixels, and once and twice a period; so the fit is a robust one, and twice is not looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane

_HARMONICS = 3  # of the phase that are fitted
_COLLAPSED = 0.8  # of one: what phases add up to that are all alike
_ENOUGH = 400  # pixels
_MOST = 100_000  # pixels that are fitted
_ROUNDS = 5  # of reweighting
_OUTLYING = 3.0  # deviations, from where on a pixel has no weight


@dataclass(frozen=True, slots=True)
class Ripple:
    """Parts of the wave's amplitude: `tone` of the amplitude goes with the phase three times a
    period, `frames` of mean or amplitude once."""

    tone: float
    frames: float


def ripple(mean: Plane, wave: NDArray[np.complex64], strong: NDArray[np.bool_]) -> Ripple | None:
    """How mean and amplitude of a fit of three phases go with the phase.

    `mean` (H, W), `wave` (H, W) complex: amplitude and phase; `strong` (H, W): where the wave is
    told from noise. Both are compared with their surroundings. None where too little is strong.
    """
    if np.count_nonzero(strong) < _ENOUGH:
        return None
    amplitude = np.abs(wave).astype(np.float32)
    around = _local(amplitude, strong)
    at = np.flatnonzero(strong)
    at = at[:: max(1, at.size // _MOST)]
    turn = np.angle(wave.ravel()[at])
    basis = [np.ones(turn.shape)]
    for harmonic in range(1, _HARMONICS + 1):
        basis += [np.cos(harmonic * turn), np.sin(harmonic * turn)]
    design = np.stack(basis)
    once, twice = (abs(np.mean(np.exp(1j * n * turn))) for n in (1, 2))
    if twice > _COLLAPSED and once < _COLLAPSED:
        return Ripple(tone=0.0, frames=1.0)  # two opposite phases alone: two frames are one
    if np.linalg.cond(design @ design.T) > 1e3:  # the phases do not go round
        return None
    sizes = []
    for plane in (amplitude, np.asarray(mean, dtype=np.float32)):
        part = (plane - _local(plane, strong)) / np.maximum(around, np.float32(1e-6))
        found = _robust(design, np.clip(part.ravel()[at], -1.0, 1.0))
        sizes.append([float(np.hypot(found[2 * n - 1], found[2 * n])) for n in (1, 2, 3)])
    of_amplitude, of_mean = sizes
    return Ripple(tone=of_amplitude[2], frames=max(of_amplitude[0], of_mean[0]))


def _robust(design: NDArray[np.float64], values: Plane) -> NDArray[np.float64]:
    """The factors (7,) of a design (7, N) that explain most of the values (N,): Tukey's weights."""
    weight = np.ones(values.shape)
    for _ in range(_ROUNDS):
        weighted = design * weight
        found = np.linalg.solve(weighted @ design.T, weighted @ values)
        off = np.abs(values - found @ design)
        scale = max(1.4826 * float(np.median(off)), 1e-9)
        weight = np.square(np.maximum(1.0 - np.square(off / (_OUTLYING * scale)), 0.0))
    return np.asarray(found, dtype=np.float64)


def _local(plane: Plane, strong: NDArray[np.bool_]) -> Plane:
    """The mean of the strong pixels around each."""
    size = (33, 33)
    weight = cv2.blur(strong.astype(np.float32), size)
    total = cv2.blur(np.where(strong, plane, np.float32(0)), size)
    return np.asarray(total / np.maximum(weight, np.float32(1e-3)), dtype=np.float32)
