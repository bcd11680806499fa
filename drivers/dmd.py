"""How an image lies on a diamond DMD, and how binary images travel as bits of a colour one.

A diamond DMD (DLP4500: 912 columns, 1140 rows) has square mirrors that stand on a corner. A row's
mirrors touch at their corners; the next row lies half a mirror lower, and half a mirror to the
side, in the gaps:

    row 0   ◇ ◇ ◇ ◇          a mirror is as wide and as high as its diagonal p (10.8 um);
    row 1    ◇ ◇ ◇ ◇         columns are p apart, rows p / 2
    row 2   ◇ ◇ ◇ ◇

A picture that is sent at 912 x 1140 is therefore seen twice as wide as it was drawn, with every
other row shifted by half a column. Patterns are drawn on a square grid of p / 2 instead, 1824 x
1140, where each mirror's centre is one point: `to_mirrors` takes the image there, and nothing is
filtered, so that black and white stay so. Details below 2 pixels of that grid (one mirror) cannot
be shown; the picture's shape is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

COLUMNS, ROWS = 912, 1140
PLANES = 24
ORDER = (1, 0, 2)  # planes 0-7 are green's bits, 8-15 red's, 16-23 blue's; the least first


def to_mirrors(image: NDArray[Any], *, odd_rows_right: bool = True) -> NDArray[Any]:
    """An image on the square grid, (H, 2 W), as its diamond mirrors, (H, W).

    `odd_rows_right`: rows 1, 3, 5 ... lie half a column to the right of the others, else to the
    left.
    """
    shift = 1 if odd_rows_right else 0
    mirrors = np.empty((image.shape[0], image.shape[1] // 2), image.dtype)
    mirrors[0::2] = image[0::2, 1 - shift :: 2]
    mirrors[1::2] = image[1::2, shift::2]
    return mirrors


def pack(planes: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Up to 24 black and white images (H, W), 0 or not, as one (H, W, 3) RGB frame."""
    if not 0 < len(planes) <= PLANES:
        raise ValueError(f"a frame carries 1 to {PLANES} planes, not {len(planes)}")
    frame = np.zeros((*planes[0].shape, 3), np.uint8)
    for number, image in enumerate(planes):
        frame[..., ORDER[number // 8]] |= (image != 0).astype(np.uint8) << np.uint8(number % 8)
    return frame


def plane(frame: NDArray[np.uint8], number: int, bits: int = 1) -> NDArray[np.uint8]:
    """Pattern `number` of a frame (H, W, 3), 0 to 255: a bit (1) or a whole channel (8)."""
    if bits == 8:
        return frame[..., ORDER[number]]
    bit = frame[..., ORDER[number // 8]] >> np.uint8(number % 8)
    return (bit & np.uint8(1)) * np.uint8(255)
