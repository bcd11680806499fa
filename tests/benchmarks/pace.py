"""The pace of a stepped scan, against what refresh and camera allow, and against fixed sleeps.

With a refresh of T seconds and an exposure of E that begins l after its trigger, a pattern cannot
take less than T * ceil((l + E) / T): the next one is flipped at the first refresh after the
exposure, and the readout goes on meanwhile. Two exposures: one refresh, which most projectors
need, so that a pattern takes two; and one that leaves the host 4.6 ms to have the next pattern up
at the very next refresh. Each scan is done twice, and the second one measured: the first renders
each pattern for the first time, which is the simulation's own work.

Hardware mode has no refresh to wait for: a pattern cannot take less than the exposure, and what
comes on top is the margin of each period, the two images that prove each sequence, and the pause
between two sequences (the long scan has three). A camera that runs free with a frame every P
seconds cannot do better than P * ceil((E + T) / P): the exposure, and a flip at some refresh, until
the next frame begins.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Literal

import numpy as np

from daemon.storage.frames import FrameRecord, FrameStore
from drivers import registry
from drivers.base.camera import Acquisition, Camera, CameraSettings
from drivers.base.device import Context
from drivers.base.projector import Projector
from protocol.scans.projected import Checkerboard
from tests.benchmarks.bench import Running, daemon
from tests.benchmarks.ratio import Ratio

REFRESH_HZ = 60.0
LATENCY_S = 50e-6
EXPOSURES_S = {"one refresh": 1 / 60, "12 ms": 12e-3}
NAIVE_SLEEP_S = 0.25
NAIVE_PATTERNS = 8
FREE_HZ = 30.0
CAMERA = {
    "width": 320,
    "height": 240,
    "readout_ms": 2.0,
    "trigger_latency_us": LATENCY_S * 1e6,
    "frame_rate_hz": FREE_HZ,
    "buffers": 64,
}
DEVICES = (
    f'[projector]\ndriver = "virtual"\nrefresh_hz = {REFRESH_HZ}\n[camera]\ndriver = "virtual"\n'
    + "".join(f"{key} = {value}\n" for key, value in CAMERA.items())
)


Mode = Literal["hardware", "software", "free"]


def scan(exposure_s: float, average: int = 1, mode: Mode = "software") -> Checkerboard:
    """16 patterns, few enough for the simulation to remember them all."""
    return Checkerboard(
        checker=8, shift=4, shifts=4, average=average, exposure_us=exposure_s * 1e6, mode=mode
    )


def run() -> list[Ratio]:
    """Ideal over real seconds a pattern, and the loop that sleeps over Umbra's."""
    refresh_s, frame_s = 1 / REFRESH_HZ, 1 / FREE_HZ
    stepped = {name: _stepped_ideal(exposure_s) for name, exposure_s in EXPOSURES_S.items()}
    free_s = math.ceil((refresh_s + refresh_s) / frame_s) * frame_s
    cases: list[tuple[str, Checkerboard, float, float | None]] = [
        (f"scan pace, exposure of {name}", scan(exposure_s), stepped[name], 0.9)
        for name, exposure_s in EXPOSURES_S.items()
    ]
    cases += [
        ("scan pace, hardware mode", scan(refresh_s, 1, "hardware"), refresh_s, 0.9),
        ("scan pace, hardware mode, 3 sequences", scan(12e-3, 32, "hardware"), 12e-3, 0.9),
        ("scan pace, free-running mode", scan(refresh_s, 2, "free"), free_s, None),
    ]
    with daemon(DEVICES) as rig:
        ratios = [_measured(rig, *case) for case in cases]
    exposure_s = next(iter(EXPOSURES_S.values()))
    naive_s, umbra_ms = _naive(exposure_s), ratios[0].facts["umbra_ms"]
    against = Ratio(
        name="scan pace against fixed sleeps",
        value=naive_s * 1e3 / umbra_ms,
        of=f"a loop that sleeps {NAIVE_SLEEP_S * 1e3:g} ms a pattern over the scan, a pattern",
        facts={"naive_ms": naive_s * 1e3, "umbra_ms": umbra_ms},
    )
    return [*ratios, against]


def _stepped_ideal(exposure_s: float) -> float:
    return math.ceil((LATENCY_S + exposure_s) * REFRESH_HZ) / REFRESH_HZ


def _measured(
    rig: Running, name: str, spec: Checkerboard, ideal_s: float, at_least: float | None
) -> Ratio:
    rig.client.scan(spec).wait(120)
    second = rig.client.scan(spec).wait(120)
    records = FrameStore.open(rig.data / "runs" / second.id, readonly=True).records()
    taken_s = _seconds_a_frame(records)
    sequencing = second.sequencing or {}
    return Ratio(
        name=name,
        value=ideal_s / taken_s,
        of="what refresh and exposure allow over what the scan took, a frame",
        at_least=at_least,
        facts={
            "ideal_ms": ideal_s * 1e3,
            "umbra_ms": taken_s * 1e3,
            "repeated": float(sequencing.get("counts", {}).get("repeated", 0)),
        },
    )


def _seconds_a_frame(records: Sequence[FrameRecord]) -> float:
    starts = [record.start_ns for record in records]
    return (starts[-1] - starts[0]) / (len(starts) - 1) / 1e9


def _naive(exposure_s: float) -> float:
    """Seconds a pattern of the loop that one writes first, on the same devices."""
    context = Context()
    projector = registry.build(
        "projector", "virtual", "projector", {"refresh_hz": REFRESH_HZ}, context
    )
    camera = registry.build("camera", "virtual", "camera", dict(CAMERA), context)
    assert isinstance(projector, Projector)
    assert isinstance(camera, Camera)
    projector.connect()
    camera.connect()
    camera.configure(CameraSettings(exposure_us=exposure_s * 1e6))
    info = camera.info()
    out = np.zeros(info.shape, info.pixel_format.dtype)
    image = np.full((projector.info().height, projector.info().width), 255, np.uint8)
    camera.start(Acquisition.SOFTWARE)
    taken = []
    for _ in range(NAIVE_PATTERNS + 1):
        began = time.perf_counter()
        projector.show(image)
        time.sleep(NAIVE_SLEEP_S)
        camera.trigger()
        camera.grab(out, 5.0)
        taken.append(time.perf_counter() - began)
    camera.close()
    projector.close()
    return sum(taken[1:]) / NAIVE_PATTERNS
