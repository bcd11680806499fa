"""A scan as the daemon does it, without its threads, store and devices."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from numpy.typing import NDArray

from daemon.scans import catalog
from daemon.scans.method import Bench, Expose, Taken, Watch
from daemon.separation.estimator import Components, Observation
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from protocol.scans.anyscan import AnyScan


def scanned(spec: AnyScan, bench: Bench, expose: Callable[[Expose], NDArray[Any]]) -> Components:
    """The whole of a scan; `expose` gives each frame of a step."""
    method = catalog.method_for(spec, bench)
    estimator = method.estimator()
    index = 0
    while (step := method.step(index, estimator.summary())) is not None:
        assert isinstance(step, Expose)
        for sub in range(step.frames):
            observation = method.observe(step, Taken(index, sub, incomplete=False))
            estimator.update(expose(step), observation)
        index += 1
    assert index
    found = estimator.result()
    assert isinstance(found, Components)
    return method.conclude(found)


def watched(
    spec: AnyScan, bench: Bench, frames: Iterable[NDArray[Any]]
) -> tuple[Components, list[Observation]]:
    """The whole of a video under an occluder, and what each frame was used for."""
    method = catalog.method_for(spec, bench)
    step = method.step(0, {})
    assert isinstance(step, Watch)
    estimator, decided = method.estimator(), []
    for k, frame in enumerate(frames):
        observation = method.observe(step, Taken(0, k, incomplete=False, pixels=frame))
        estimator.update(frame, observation)
        decided.append(observation)
    found = estimator.result()
    assert isinstance(found, Components)
    return method.conclude(found), decided


def declared(spec: AnyScan, frames: Sequence[NDArray[Any]]) -> Components:
    """What a folder of frames comes to when it is said to be a scan."""
    height, width = frames[0].shape
    camera = CameraInfo(width, height, PixelFormat.MONO16, recorded=True, frame_count=len(frames))
    method = catalog.method_for(spec, Bench(camera))
    estimator = method.estimator()
    for index, frame in enumerate(frames):
        step = method.step(index, {})
        assert step is not None
        estimator.update(frame, method.observe(step, Taken(index, 0, incomplete=False)))
    found = estimator.result()
    assert isinstance(found, Components)
    return found
