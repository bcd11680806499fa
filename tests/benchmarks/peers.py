"""The same frames decoded by another package, where it is installed: `fringes`.

It is no dependency and no extra: it wants OpenCV's other distribution, which would overwrite the
headless one. To run beside it: `pip install --no-deps fringes`, then numba, scikit-image, scipy,
sympy and pyyaml.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

NEEDED = ("fringes", "numba", "skimage", "scipy", "sympy", "yaml")


def missing() -> str:
    """Why there is no peer; "": there is."""
    absent = [name for name in NEEDED if find_spec(name) is None]
    return f"no peer: {', '.join(absent)} not installed" if absent else ""


def fringes(
    frames: Sequence[NDArray[Any]], black: NDArray[Any], period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Direct and global (H, W) from phases of one sinusoid less the black frame, in counts."""
    logging.getLogger("fringes").setLevel(logging.ERROR)
    package, components = import_module("fringes"), import_module("fringes.filter")
    height, width = black.shape
    rig = package.Fringes()
    rig.Y, rig.X, rig.D, rig.K = height, width, 1, 1
    rig.N, rig.v = len(frames), width / period
    less = np.stack([frame.astype(np.float64) - black for frame in frames])
    brightness, modulation, _ = rig.decode(less, unwrap=False)
    direct = components.direct(modulation)
    indirect = components.indirect(brightness, modulation)
    return (
        np.asarray(direct, dtype=np.float64).reshape(height, width),
        np.asarray(indirect, dtype=np.float64).reshape(height, width),
    )


def fringes_of_mosaics(
    frames: Sequence[NDArray[Any]], black: NDArray[Any], period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same (H, W, 3) RGB from RGGB mosaics: it has no mosaics, so that frames are made colour
    pictures first, as one would with OpenCV, and each colour is decoded."""
    shown = [cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2RGB) for frame in frames]
    dark = cv2.cvtColor(black, cv2.COLOR_BayerRGGB2RGB)
    colours = [fringes([f[..., c] for f in shown], dark[..., c], period) for c in range(3)]
    direct, indirect = zip(*colours, strict=True)
    return np.stack(direct, axis=-1), np.stack(indirect, axis=-1)
