"""Standard deviations of the components: of noise, and of all that is known to be unsure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.radiometry import Plane

NOISE = {"direct_std": "direct_noise", "global_std": "global_noise"}
"""The plane of noise's part of each plane of deviations, where it is not all."""

PLANES = frozenset({*NOISE, *NOISE.values()})
"""Planes that have a component's shape."""


def of_noise(planes: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """Noise's part of a plane of deviations, which is all of it where it is not a plane itself."""
    return planes.get(NOISE[name], planes[name])


def stated(direct: Plane, indirect: Plane, *off: Plane) -> dict[str, NDArray[Any]]:
    """The planes of deviations, from those of noise, which repeated scans show, and how far `off`
    components may be besides, as deviations: what is missing in one is in the other. All of a
    frame's shape."""
    square = np.square(off[0])
    for one in off[1:]:
        square += np.square(one)
    whole = [square + np.square(noise) for noise in (direct, indirect)]
    return {
        "direct_std": np.sqrt(whole[0], out=whole[0]),
        "global_std": np.sqrt(whole[1], out=whole[1]),
        "direct_noise": direct,
        "global_noise": indirect,
    }
