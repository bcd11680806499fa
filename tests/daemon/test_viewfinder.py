"""The small picture, and what in it is over-exposed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.pictures.viewfinder import Glimpse, Viewfinder, cells, saturation_of
from drivers.base.camera import CameraInfo, Frame
from drivers.base.pixelformat import PixelFormat


def frame(pixels: NDArray[Any]) -> Frame:
    return Frame(pixels, 0, 0, 1, 0, 1000.0)


@pytest.mark.parametrize(
    "pixel_format", [PixelFormat.MONO12, PixelFormat.BAYER_RG12, PixelFormat.RGB8]
)
def test_one_saturated_pixel_is_marked(pixel_format: PixelFormat) -> None:
    info = CameraInfo(2448, 2048, pixel_format)
    pixels = np.full(info.shape, 50, pixel_format.dtype)
    assert not saturation_of(pixels, info, 100, 120).any()
    pixels[(1000, 1300, *([2] if pixels.ndim == 3 else []))] = pixel_format.full_scale
    mask = saturation_of(pixels, info, 100, 120)
    assert mask.sum() >= 1
    assert mask[1000 * 100 // 2048, 1300 * 120 // 2448]
    assert cells(mask, 10, 12).sum() >= 1


def test_glimpses_are_paced_and_kept_by_kind() -> None:
    told: list[Glimpse] = []
    viewfinder = Viewfinder(told.append)
    info = CameraInfo(64, 48, PixelFormat.MONO8)
    pixels = np.full(info.shape, 255, np.uint8)
    viewfinder.offer(frame(pixels), info, "run-1")
    viewfinder.offer(frame(pixels), info, "run-1")  # too soon
    assert len(told) == 1
    viewfinder.offer(frame(pixels), info, now=True)
    assert [g.run for g in told] == ["run-1", ""]
    assert told[0].saturated.shape == told[0].picture.shape[:2] == (48, 64)
    assert told[0].saturated.all()
    assert viewfinder.latest("direct") is None
    assert viewfinder.latest() is told[-1]
