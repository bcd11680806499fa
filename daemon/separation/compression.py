"""Whether a picture was compressed in blocks of 8 x 8 pixels, as JPEG files and most videos are.

Of each block's cosine transform most fine waves are then exactly none; of blocks that begin
elsewhere, and of pictures that were never compressed, none are but by chance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_BLOCK = 8
_LOOK = 512  # pixels a side, about the middle
_FEWEST = 64  # blocks
_NONE = 0.5  # counts: the rounding of decoded samples leaves as much of a wave that is none
_MORE = 0.1  # of the waves that are none, beyond those of blocks that begin elsewhere
_ELSEWHERE = ((4, 4), (3, 5), (5, 3))  # where others begin: not at a half of a block alone
_LUMA = np.array([0.299, 0.587, 0.114])  # of RGB (ITU-R BT.601, as JFIF has it)

COMPRESSED = (
    "the frames were compressed in blocks of 8 pixels (JPEG, or a video): the deviations hold what "
    "that changes from frame to frame, not the fine texture and colours that it takes from all of "
    "them, and global light may be off by up to four times what is stated: save PNG, TIFF or RAW"
)
"""Advice where `in_blocks` says so."""


def in_blocks(pixels: NDArray[Any]) -> bool:
    """Whether a frame, (H, W) or (H, W, 3) RGB, was compressed so. One of more than 8 bits, or that
    begins within a block, is taken for not; a pattern that lies just as blocks do, and has hardly
    any noise, for one: a white frame tells better."""
    if pixels.dtype != np.uint8:
        return False
    height, width = (max(0, (n - _LOOK) // 2) // _BLOCK * _BLOCK for n in pixels.shape[:2])
    part = pixels[height : height + _LOOK, width : width + _LOOK]
    grey = part.astype(np.float64) if part.ndim == 2 else part @ _LUMA
    if min(grey.shape) < _BLOCK or (grey.shape[0] // _BLOCK) * (grey.shape[1] // _BLOCK) < _FEWEST:
        return False
    here = _vanishing(grey)
    return here > max(_vanishing(grey[y:, x:]) for y, x in _ELSEWHERE) + _MORE


def _vanishing(grey: NDArray[np.float64]) -> float:
    """The part of the fine waves of blocks that are none; saturated or black blocks have no say."""
    rows, columns = (n // _BLOCK for n in grey.shape)
    whole = grey[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    blocks = whole.transpose(0, 2, 1, 3).reshape(-1, _BLOCK, _BLOCK)
    blocks = blocks[(blocks.min(axis=(1, 2)) > 1.0) & (blocks.max(axis=(1, 2)) < 254.0)]
    if len(blocks) == 0:
        return 0.0
    waves = np.abs(_COSINES @ blocks @ _COSINES.T)
    return float(np.mean(waves[:, _FINE] < _NONE))


def _cosines() -> NDArray[np.float64]:
    wave, at = np.indices((_BLOCK, _BLOCK))
    found = np.cos(np.pi * (at + 0.5) * wave / _BLOCK) * np.sqrt(2.0 / _BLOCK)
    found[0] /= np.sqrt(2.0)
    return np.asarray(found)


_COSINES = _cosines()
_FINE = np.add.outer(np.arange(_BLOCK), np.arange(_BLOCK)) >= _BLOCK
