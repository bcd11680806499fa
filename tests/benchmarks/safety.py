"""How soon it is dark after an abort, and how soon a result is there after the last frame.

Both are promised as times, so they are given as parts of what is promised: 100 ms beyond the
device's own latency, and the interval of one frame.
"""

from __future__ import annotations

import json
import time
from typing import Literal

import numpy as np

from daemon.config import parse
from daemon.devices.rig import Rig
from drivers.base.camera import Acquisition
from protocol.scans.projected import Checkerboard
from tests.benchmarks.bench import daemon
from tests.benchmarks.pace import CAMERA, DEVICES
from tests.benchmarks.ratio import Ratio, percentile

ROUNDS = 40
DARK_S = 0.100
EXPOSURE_US = 1e6  # long: the abort always comes in the middle of a grab


def run() -> list[Ratio]:
    """The slowest of many aborts, and the time of the separation in a scan's own record."""
    return [_dark(), _result("maxmin", at_most=1.0), _result("auto", at_most=1.0)]


def _dark() -> Ratio:
    """From `make_safe` to the last device's answer, with a camera that is in a long grab."""
    rig = Rig(parse(DEVICES + f"exposure_us = {EXPOSURE_US}\n", "bench"), lambda _: None)
    rig.connect()
    projector = rig.projector
    assert projector is not None
    taken = []
    try:
        info, shape = projector.device.info(), rig.camera.device.info()
        image = np.full((info.height, info.width), 255, np.uint8)
        out = np.zeros(shape.shape, shape.pixel_format.dtype)
        for _ in range(ROUNDS):
            session = rig.take("bench")
            projector.call(lambda p: p.show(image), 5, session)
            rig.camera.call(lambda c: c.start(Acquisition.SOFTWARE), 5, session)
            rig.camera.call(lambda c: c.trigger(), 5, session)
            grab = rig.camera.submit(lambda c: c.grab(out, 5.0), 10, session)
            began = time.perf_counter()
            if not rig.safe_within(rig.make_safe(), 5.0):
                raise RuntimeError("a device was not safe in time")
            taken.append(time.perf_counter() - began)
            rig.leave(session)
            grab.exception(5)
    finally:
        rig.close()
    return Ratio(
        name="abort to dark projector and stopped camera",
        value=max(taken) / DARK_S,
        of="the slowest of the aborts over 100 ms",
        at_most=1.0,
        facts={"slowest_ms": max(taken) * 1e3, "median_ms": percentile(taken, 0.5) * 1e3},
    )


def _result(estimator: Literal["maxmin", "auto"], at_most: float) -> Ratio:
    """From the end of the scan to components in memory, over the interval of a frame."""
    with daemon(DEVICES) as rig:
        scan = Checkerboard(shift=4, shifts=4, estimator=estimator)
        rig.client.scan(scan).wait(120)
        second = rig.client.scan(scan).wait(120)
        timings = json.loads((rig.data / "runs" / second.id / "run.json").read_text())["timings"]
    interval_s = timings["scan_s"] / second.recorded
    return Ratio(
        name=f"result after the last frame, {estimator}",
        value=timings["separate_s"] / interval_s,
        of=f"separating {CAMERA['width']} x {CAMERA['height']} over the interval of one frame",
        at_most=at_most,
        facts={"separate_ms": timings["separate_s"] * 1e3, "interval_ms": interval_s * 1e3},
    )
