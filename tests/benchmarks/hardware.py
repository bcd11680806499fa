"""Real drivers over emulated devices: a display on a screenless X server, Basler's emulation.

Pace: a calibration of the tone (its frames need not look like their patterns, and the emulation
does not see the screen) against what the screen's refresh and the exposure allow, as in `pace`. A
screenless server's refresh is a timer that begins anew at a flip, so more than 1 is possible.

Bandwidth: a recording of one second after the other at rising frame rates, recorded and separated
while frames arrive; the highest rate at which no frame is missing, against the same bytes written
to the same folder as the recorder writes them (a file a frame, synchronised) and copied in memory,
measured in the same minute. What the emulation itself can give is a third limit.
"""

from __future__ import annotations

import importlib.util
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from daemon.storage.frames import FrameStore
from drivers import registry
from drivers.base.camera import Acquisition, Camera, CameraSettings
from drivers.base.device import Context
from protocol.scans.calibrations import CalibrateTone
from protocol.scans.occluded import Stick
from tests.benchmarks.bench import Running, daemon
from tests.benchmarks.ratio import Ratio, Skipped
from tests.drivers.xserver import screen_tools_missing, xvfb

EXPOSURES = {"one refresh": 1.0, "0.6 of a refresh": 0.6}
LATENCY_S = 100e-6  # from the emulation's trigger to its exposure
WIDTH, HEIGHT = 1280, 1024
SECONDS = 3.0
RATES = (5.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 40.0, 50.0, 65.0, 80.0, 100.0, 130.0, 160.0, 200.0)
CAMERA = 'driver = "pylon"\nserial = "0815-0000"\ntransport = "BaslerCamEmu"\n'


def run() -> list[Ratio]:
    """Ratios of pace and of bandwidth."""
    if importlib.util.find_spec("pypylon") is None:
        raise Skipped("needs the extra: pip install 'umbra-rig[pylon]'")
    os.environ["PYLON_CAMEMU"] = "1"
    return [*_pace(), *_bandwidth()]


def _pace() -> Iterator[Ratio]:
    if importlib.util.find_spec("pygame") is None:
        raise Skipped("needs the extra: pip install 'umbra-rig[display]'")
    if missing := screen_tools_missing():
        raise Skipped(f"no {missing}: apt install xvfb x11-apps")
    with xvfb(1280, 800) as screen, _environment(DISPLAY=screen):
        devices = (
            f'[projector]\ndriver = "display"\nlatency_frames = 0\n'
            f"[camera]\n{CAMERA}roi = [0, 0, 640, 480]\n"
        )
        with daemon(devices) as rig:
            (shown,) = [d for d in rig.client.status().devices if d.kind == "projector"]
            refresh_hz = float(shown.facts["refresh_hz"])
            for name, refreshes in EXPOSURES.items():
                exposure_s = refreshes / refresh_hz
                spec = CalibrateTone(levels=33, exposure_us=exposure_s * 1e6)
                before = _cpu_s(rig)
                done = rig.client.scan(spec).wait(120, check=False)
                used_s = _cpu_s(rig) - before
                records = FrameStore.open(rig.data / "runs" / done.id, readonly=True).records()
                starts = [r.start_ns for r in records if r.observation.used]
                taken_s = float(np.median(np.diff(starts))) / 1e9
                mean_s = (starts[-1] - starts[0]) / (len(starts) - 1) / 1e9
                ideal_s = math.ceil((exposure_s + LATENCY_S) * refresh_hz) / refresh_hz
                yield Ratio(
                    name=f"display + pylon pace, exposure of {name}",
                    value=ideal_s / mean_s,
                    of="what refresh and exposure allow over what the run took, a pattern",
                    facts={
                        "ideal_ms": ideal_s * 1e3,
                        "mean_ms": mean_s * 1e3,
                        "median_ms": taken_s * 1e3,
                        "patterns_a_s": 1 / mean_s,
                        "refresh_hz": refresh_hz,
                        "cpu_ms_a_frame": used_s / len(starts) * 1e3,
                    },
                )


def _bandwidth() -> Iterator[Ratio]:
    camera_fps = _camera_alone_fps()
    frame_bytes = WIDTH * HEIGHT
    camera = f"{CAMERA}exposure_us = 100\nroi = [0, 0, {WIDTH}, {HEIGHT}]\n"
    with daemon(f"[camera]\n{camera}") as rig:
        rates = [rate for rate in RATES if rate < 0.95 * camera_fps]
        best, used_s, frames = 0.0, math.nan, 0
        for rate in rates:
            before = _cpu_s(rig)
            info = rig.client.scan(
                Stick(frames=round(rate * SECONDS), frame_rate_hz=rate, align=False)  # it moves
            ).wait(120, check=False)
            records = FrameStore.open(rig.data / "runs" / info.id, readonly=True).records()
            whole = [r for r in records if r.sequence >= 0]
            if info.missing or len(whole) < round(rate * SECONDS):
                break
            real = (len(whole) - 1) / ((whole[-1].start_ns - whole[0].start_ns) / 1e9)
            best, used_s, frames = real, _cpu_s(rig) - before, len(whole)
        disk_fps, memory_fps = _disk_fps(rig.data, frame_bytes), _memory_fps(frame_bytes)
    limit = min(disk_fps, memory_fps, camera_fps)
    facts = {
        "fps": best,
        "MB_a_s": best * frame_bytes / 1e6,
        "disk_MB_a_s": disk_fps * frame_bytes / 1e6,
        "memory_MB_a_s": memory_fps * frame_bytes / 1e6,
        "camera_fps": camera_fps,
        "cpu_ms_a_frame": used_s / frames * 1e3 if frames else math.nan,
    }
    yield Ratio(
        name="record + separate with no loss",
        value=best / limit,
        of="frames a second over the least of disk, memory and the emulated camera alone",
        facts=facts,
    )
    yield Ratio(
        name="record + separate against the disk",
        value=best / disk_fps,
        of="bytes a second over a synchronised file a frame in the same folder",
        facts=facts,
    )


# ---------------------------------------------------------------- the machine's own


def _camera_alone_fps() -> float:
    """Frames a second of the driver in a loop that does nothing else."""
    options: dict[str, Any] = {
        "serial": "0815-0000",
        "transport": "BaslerCamEmu",
        "exposure_us": 100.0,
        "roi": [0, 0, WIDTH, HEIGHT],
    }
    camera = registry.build("camera", "pylon", "camera", options, Context())
    assert isinstance(camera, Camera)
    camera.connect()
    try:
        camera.configure(CameraSettings(frame_rate_hz=1000.0))
        out = np.empty(camera.info().shape, np.uint8)
        camera.start(Acquisition.FREE)
        camera.grab(out, 2.0)
        began, count = time.perf_counter(), 0
        while time.perf_counter() - began < 2.0:
            camera.grab(out, 2.0)
            count += 1
        return count / (time.perf_counter() - began)
    finally:
        camera.close()


def _disk_fps(folder: Path, size: int) -> float:
    """Files of a frame's size a second, each synchronised."""
    pixels = np.random.default_rng(0).integers(0, 256, size, np.uint8).tobytes()
    count, began = 0, time.perf_counter()
    while time.perf_counter() - began < 2.0:
        path = folder / f"bench-{count}"
        with path.open("wb", buffering=0) as file:
            file.write(pixels)
            os.fdatasync(file.fileno())
        count += 1
    taken = time.perf_counter() - began
    for k in range(count):
        (folder / f"bench-{k}").unlink()
    return count / taken


def _memory_fps(size: int) -> float:
    """Copies of a frame a second, with its maximum and minimum: all that separating needs."""
    frames = np.random.default_rng(0).integers(0, 256, (16, size), np.uint8)
    ring, high, low = np.empty_like(frames), frames[0].copy(), frames[0].copy()
    count, began = 0, time.perf_counter()
    while time.perf_counter() - began < 1.0:
        k = count % 16
        np.copyto(ring[k], frames[k])
        np.maximum(high, ring[k], out=high)
        np.minimum(low, ring[k], out=low)
        count += 1
    return count / (time.perf_counter() - began)


def _cpu_s(rig: Running) -> float:
    """What the daemon has used of the processors so far."""
    fields = Path(f"/proc/{rig.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def _environment(**values: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
