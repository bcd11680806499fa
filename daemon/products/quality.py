"""What the quality bits mean to a person (quality.toml), and a picture of where they are."""

from __future__ import annotations

from importlib import resources

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.pictures.display import Picture, encode, fit
from daemon.separation.estimator import Quality

_DIMMED = 0.3


class Bit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One quality bit, explained. `name` is as in quality.json, `colour` sRGB as in CSS."""

    name: str
    meaning: str
    remedy: str
    colour: str

    @property
    def flag(self) -> Quality:
        """The bit itself."""
        return Quality[self.name.upper()]

    @property
    def rgb(self) -> tuple[int, ...]:
        """The colour's parts, 0 to 255."""
        return tuple(bytes.fromhex(self.colour.removeprefix("#")))


class _Table(msgspec.Struct, forbid_unknown_fields=True):
    bit: tuple[Bit, ...]


def _read() -> tuple[Bit, ...]:
    text = resources.files("daemon.products").joinpath("quality.toml").read_text("utf-8")
    return msgspec.toml.decode(text, type=_Table).bit


BITS = _read()
"""In the order in which they are painted: the worse over the milder."""


def overlay(
    light: NDArray[np.float32], white: float, quality: NDArray[np.uint16], width: int | None = None
) -> Picture:
    """The scene in dim grey, its flagged pixels in their bits' colours.

    `light` (H, W[, 3]) linear, shown as white at `white`; `quality` (H, W). When reduced to `width`
    columns, a lone flagged pixel still tints its place.
    """
    height, width = fit(quality.shape[0], quality.shape[1], width)

    def small(plane: NDArray[np.float32]) -> NDArray[np.float32]:
        if plane.shape == (height, width):
            return plane
        return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_AREA))

    grey = np.nan_to_num(light if light.ndim == 2 else light.mean(axis=2))
    dim = encode(small(grey.astype(np.float32)) * np.float32(_DIMMED / white))
    painted = np.repeat(dim[..., None], 3, axis=2).astype(np.float32)
    for bit in BITS:
        flagged = (quality & np.uint16(bit.flag)) != 0
        if not flagged.any():
            continue
        opacity = np.sqrt(small(flagged.astype(np.float32)))[..., None] * np.float32(0.85)
        painted += (np.asarray(bit.rgb, dtype=np.float32) - painted) * opacity
    return np.clip(painted, 0, 255).astype(np.uint8)
