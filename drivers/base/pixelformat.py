"""How a camera's samples are coded: depth, mosaic, channels."""

from __future__ import annotations

import enum
from typing import Any

import numpy as np


class PixelFormat(enum.StrEnum):
    """SFNC PixelFormat names that Umbra understands; 10 to 14 bit come unpacked and unshifted."""

    MONO8 = "Mono8"
    MONO10 = "Mono10"
    MONO12 = "Mono12"
    MONO14 = "Mono14"
    MONO16 = "Mono16"
    BAYER_RG8 = "BayerRG8"
    BAYER_GR8 = "BayerGR8"
    BAYER_GB8 = "BayerGB8"
    BAYER_BG8 = "BayerBG8"
    BAYER_RG10 = "BayerRG10"
    BAYER_GR10 = "BayerGR10"
    BAYER_GB10 = "BayerGB10"
    BAYER_BG10 = "BayerBG10"
    BAYER_RG12 = "BayerRG12"
    BAYER_GR12 = "BayerGR12"
    BAYER_GB12 = "BayerGB12"
    BAYER_BG12 = "BayerBG12"
    BAYER_RG14 = "BayerRG14"
    BAYER_GR14 = "BayerGR14"
    BAYER_GB14 = "BayerGB14"
    BAYER_BG14 = "BayerBG14"
    BAYER_RG16 = "BayerRG16"
    BAYER_GR16 = "BayerGR16"
    BAYER_GB16 = "BayerGB16"
    BAYER_BG16 = "BayerBG16"
    RGB8 = "RGB8"
    RGB10 = "RGB10"
    RGB12 = "RGB12"
    RGB14 = "RGB14"
    RGB16 = "RGB16"

    @property
    def bits(self) -> int:
        """Significant bits a sample."""
        return int("".join(c for c in self.value if c.isdigit()))

    @property
    def full_scale(self) -> int:
        """The largest count."""
        return (1 << self.bits) - 1

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)

    @property
    def bayer(self) -> str:
        """The mosaic's first two pixels, "RG", "GR", "GB" or "BG"; "" where there is none."""
        return self.value[5:7] if self.value.startswith("Bayer") else ""

    @property
    def channels(self) -> int:
        """Samples a pixel: 3 for RGB, else 1."""
        return 3 if self.value.startswith("RGB") else 1
