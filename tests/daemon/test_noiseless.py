"""Frames without any noise, as of a renderer or of a few coarse counts, are separated exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans import catalog
from daemon.scans.method import Bench, Expose, Taken
from daemon.separation.estimator import Components
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.scans.anyscan import AnyScan
from protocol.scans.projected import Checkerboard, RandomBinary, TwoImage

HEIGHT, WIDTH = 48, 64
BENCH = Bench(
    CameraInfo(WIDTH, HEIGHT, PixelFormat.MONO8), ProjectorInfo(WIDTH, HEIGHT, refresh_hz=60)
)
DIRECT = np.tile(np.linspace(40, 120, WIDTH).round(), (HEIGHT, 1))
INDIRECT = 30.0  # the same everywhere, whatever the pattern: half of it in every image


def frame(step: Expose) -> NDArray[Any]:
    """What an ideal camera counts."""
    if step.pattern is None:
        return np.zeros((HEIGHT, WIDTH), np.uint8)
    shown = patterns.render(step.pattern, WIDTH, HEIGHT) / 255
    level = shown.mean() if shown.min() == shown.max() else 0.5
    return np.asarray(np.rint(DIRECT * shown + INDIRECT * level), dtype=np.uint8)


@pytest.mark.parametrize(
    "spec",
    [
        Checkerboard(estimator="maxmin"),
        Checkerboard(estimator="maxmin-unbiased"),
        Checkerboard(estimator="topk"),
        Checkerboard(shifts=3, shift=4, checker=6),
        RandomBinary(estimator="maxmin"),
        RandomBinary(estimator="topk"),
        TwoImage(),
    ],
    ids=lambda spec: f"{type(spec).__name__}-{spec.estimator}-{getattr(spec, 'shifts', '')}",
)
def test_without_noise(spec: AnyScan) -> None:
    method = catalog.method_for(spec, BENCH)
    estimator = method.estimator()
    index = 0
    while (step := method.step(index, estimator.summary())) is not None:
        assert isinstance(step, Expose)
        observation = method.observe(step, Taken(index, 0, incomplete=False))
        estimator.update(frame(step), observation)
        index += 1
    found = estimator.result()
    assert isinstance(found, Components)
    # of counts as coarse as these rounding is taken for noise, and its bias of a count off
    np.testing.assert_allclose(found.direct, DIRECT, atol=1.1)
    np.testing.assert_allclose(found.global_, INDIRECT, atol=2.0)
