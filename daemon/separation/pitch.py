"""A mesh's pitch in the picture, from the lengths of light and shade in a frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

FINEST, COARSEST = 5.0, 201.0
"""Pitches in pixels that are believed."""


def pitch_px(
    frame: NDArray[Any],
    brightest: NDArray[Any],
    darkest: NDArray[Any],
    beta: float,
    least_part: float,
    least: float,
) -> float:
    """The pitch, pixels. `frame` and each pixel's brightest and darkest samples are of one shape,
    (H, W) or (H, W, 3); places tell where the two differ by `least` counts and by `least_part` of
    the brightest.

    A line across holes of diameter d and pitch p meets one every p²/d, and d/p follows from β
    (square grid); the mean of rows and columns.
    """
    rows = np.s_[::7]  # in no step with a pitch
    spacings = []
    pictures = [_green(x) for x in (frame, brightest, darkest)]
    for turned in (pictures, [x.T for x in pictures]):
        now, high, low = (x[rows].astype(np.float32) for x in turned)
        tells = high - low > np.maximum(np.float32(least_part) * high, np.float32(least))
        lit = now > (high + low) / 2
        edges = (lit[:, 1:] != lit[:, :-1]) & tells[:, 1:] & tells[:, :-1]
        if edges.any():
            spacings.append(2.0 * np.count_nonzero(tells) / np.count_nonzero(edges))
    if not spacings:
        return FINEST
    diameter = math.sqrt(4.0 * beta / math.pi)  # of the pitch
    return float(np.clip(np.mean(spacings) * min(diameter, 1.0), FINEST, COARSEST))


def _green(picture: NDArray[Any]) -> NDArray[Any]:
    """The channel with most light, of a colour picture."""
    return picture if picture.ndim == 2 else picture[..., 1]
