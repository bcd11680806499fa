"""Pictures side by side, with a caption over each."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from daemon.pictures.display import Picture

_PAPER = (18, 19, 22)
_INK = (226, 228, 232)
_GAP = 12
_CAPTION = 34
_FONT = cv2.FONT_HERSHEY_DUPLEX


def side_by_side(pictures: Mapping[str, Picture]) -> Picture:
    """One row of pictures by caption, brought to the height of the tallest."""
    height = max(p.shape[0] for p in pictures.values())
    tiles = {caption: _to_height(p, height) for caption, p in pictures.items()}
    width = sum(p.shape[1] for p in tiles.values()) + _GAP * (len(tiles) + 1)
    sheet = np.full((height + _CAPTION + _GAP, width, 3), _PAPER, dtype=np.uint8)
    x = _GAP
    for caption, tile in tiles.items():
        sheet[_CAPTION : _CAPTION + height, x : x + tile.shape[1]] = tile
        cv2.putText(sheet, caption, (x, _CAPTION - 11), _FONT, 0.55, _INK, 1, cv2.LINE_AA)
        x += tile.shape[1] + _GAP
    return sheet


def _to_height(picture: Picture, height: int) -> Picture:
    if picture.shape[0] == height:
        return picture
    width = max(1, round(picture.shape[1] * height / picture.shape[0]))
    shrinks = height < picture.shape[0]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, (width, height), interpolation=how), dtype=np.uint8)
