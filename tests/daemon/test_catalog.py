"""What a rig cannot do is refused when it is asked for, not when its turn comes."""

from __future__ import annotations

import pytest

from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Unsuitable
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.scans.projected import TwoImage

BENCH = Bench(
    CameraInfo(64, 48, PixelFormat.MONO12, exposure_range_us=(20.0, 1e6)),
    ProjectorInfo(64, 48, refresh_hz=60),
)


@pytest.mark.parametrize("exposure_us", [1.0, 9e12])
def test_an_exposure_that_the_camera_cannot_make(exposure_us: float) -> None:
    with pytest.raises(Unsuitable, match="20 to 1e") as caught:
        method_for(TwoImage(exposure_us=exposure_us), BENCH)
    assert caught.value.where == "$.exposure_us"


def test_an_exposure_that_it_can() -> None:
    assert method_for(TwoImage(exposure_us=20_000.0), BENCH).planned()
    assert method_for(TwoImage(exposure_us=9e12, auto_exposure=True), BENCH).planned()  # a limit
