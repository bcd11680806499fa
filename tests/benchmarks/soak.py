"""A night outdoors in minutes: scan after scan under a sun with clouds, in gusts, with faults.

Opt-in (`python -m tests.benchmarks soak`): eight hours of the rig's in twenty minutes, or as many
as UMBRA_SOAK_S seconds have. Each run must end done, or failed with a code and a reason; after the
faults the devices must come back by themselves; neither memory nor descriptors nor threads may grow
with the runs; and the runs that are kept must fit the room that they are given.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

from protocol.messages.runs import RunInfo, RunState
from protocol.scans.occluded import Mesh
from protocol.scans.spec import Ready
from tests.benchmarks.bench import Running, daemon
from tests.benchmarks.ratio import Ratio

NIGHT_S = 8 * 3600.0
SCALE = 24.0
SECONDS = float(os.environ.get("UMBRA_SOAK_S", NIGHT_S / SCALE))
READY_S = 60.0
WAIT_S = 300.0
KEEP_GB = 0.1
_LARGEST = 0.3  # of that: a run of ten minutes
SPEC = Mesh(
    hole_mm=25.0, pitch_mm=40.0, scene_mm=150.0, sun=True, coverage=0.99, time_limit_s=600.0,
    ready=Ready(deadline_s=900.0, look_s=30.0, light_min=0.2, steady=0.2),
)  # fmt: skip


def _every(kind: str, first: int, step: int) -> str:
    return ", ".join(f'"{kind}@{first + k * step}"' for k in range(200))


def _through(day: list[tuple[float, float]]) -> str:
    """A schedule of the rig's seconds, as TOML; it must be in order."""
    assert all(a < b for (a, _), (b, _) in pairwise(day))
    return ", ".join(f"[{s}, {level}]" for s, level in day)


GUSTS = [
    (900.0 * k + s, px)
    for k in range(33)
    for s, px in ((0, 0.0), (600, 0.0), (605, 3.0), (840, 0.0))
]
"""A gust of four minutes each quarter of an hour."""

CLOUDS = [
    (0.0, 1.0), (7000.0, 1.0), (7200.0, 0.1), (9000.0, 0.1), (9200.0, 1.0),  # half an hour
    (16000.0, 1.0), (16100.0, 0.5), (18000.0, 0.5), (18100.0, 1.0),  # as long, thinner
    (25000.0, 1.0), (27000.0, 0.02), (30000.0, 0.02),  # dusk
]  # fmt: skip

DEVICES = f"""
[storage]
keep_gb = {KEEP_GB}
[camera]
driver = "virtual"
width = 208
height = 156
pixel_format = "Mono12"
frame_rate_hz = 0.5
gusts = [{_through(GUSTS)}]
faults = [{_every("incomplete-frame", 97, 211)}, {_every("timeout", 400, 907)},
          {_every("vanish", 1100, 1709)}]
[stage]
driver = "virtual"
light = "sun"
before_scene_mm = 150
hole_mm = 25
pitch_mm = 40
homing_feed_mm_s = 200
faults = [{_every("vanish", 1500, 2903)}, {_every("timeout", 700, 3301)}]
[[light]]
name = "sun"
driver = "virtual"
kind = "sun"
position_mm = [-300, 620, -250]
clouds = [{_through(CLOUDS)}]
cloudiness = 0.4
"""


def run() -> list[Ratio]:
    """Growth of memory, descriptors and threads, room taken, and runs that ended without a word."""
    ends: Counter[str] = Counter()
    kept: list[tuple[float, float, float]] = []
    room: list[float] = []
    frames = missing = rejected = 0
    silent = 0
    with daemon(DEVICES, time_scale=SCALE) as rig:
        until = time.monotonic() + SECONDS
        while time.monotonic() < until:
            _ready(rig)
            info = rig.client.scan(SPEC).wait(WAIT_S, check=False)
            ends[_end(info)] += 1
            silent += not _said(info)
            frames, missing = frames + info.recorded, missing + info.missing
            rejected += info.rejected
            kept.append(_holds(rig))
            room.append(_takes(rig.data))
            if info.state is not RunState.DONE and info.end is not None:
                print(f"  {info.id} {info.end.code}: {info.end.reason}", flush=True)
    facts = {"runs": float(sum(ends.values())), "frames": float(frames), "missing": float(missing)}
    facts |= {"rejected": float(rejected), **{name: float(n) for name, n in ends.items()}}
    quarter = max(1, len(kept) // 4)
    ratios = [
        Ratio(
            name="soak: runs that ended without a reason",
            value=float(silent),
            of="runs that are neither done nor failed with a code, and a reason",
            at_most=0.0,
            facts=facts,
        ),
        Ratio(
            name="soak: disk",
            value=max(room) / (KEEP_GB * 1e9),
            of="the most that all runs took after one of them, over what they may take and one run",
            at_most=1.0 + _LARGEST,
            facts={"most_bytes": max(room), "last_bytes": room[-1]},
        ),
    ]
    for k, (what, most) in enumerate(
        (("resident memory", 1.1), ("open files", 1.1), ("threads", 1.25))
    ):
        early = statistics.median(one[k] for one in kept[quarter : 2 * quarter])
        late = statistics.median(one[k] for one in kept[-quarter:])
        ratios.append(
            Ratio(
                name=f"soak: {what}",
                value=late / early,
                of="after the runs of the last quarter over after those of the second",
                at_most=most,
                facts={"early": early, "late": late, "first": kept[0][k]},
            )
        )
    return ratios


def _ready(rig: Running) -> None:
    """Wait until every device is back; the wait is the question's own round trip."""
    deadline = time.monotonic() + READY_S
    while not all(device.health.value == "ready" for device in rig.client.devices()):
        if time.monotonic() > deadline:
            raise RuntimeError(f"devices did not come back: {rig.client.devices()}")


def _said(info: RunInfo) -> bool:
    if info.end is None or not info.end.reason:
        return False
    return info.state is RunState.DONE or (info.state is RunState.FAILED and bool(info.end.code))


def _end(info: RunInfo) -> str:
    """Of a run, in a few words."""
    if info.end is None:
        return info.state.value
    if info.state is not RunState.DONE:
        return f"{info.state.value}: {info.end.code}"
    for words, end in (
        ("time limit", "done: time limit"),
        ("wanted:", "done: no more to cover"),
        ("wanted", "done: covered"),
    ):
        if words in info.end.reason:
            return end
    return "done"


def _takes(data: Path) -> float:
    """Bytes of all files in a folder; those that are deleted meanwhile are none."""
    total = 0
    for where, _, names in os.walk(data):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += (Path(where) / name).stat().st_size
    return float(total)


def _holds(rig: Running) -> tuple[float, float, float]:
    """Resident bytes, open files and threads of the daemon."""
    here = Path(f"/proc/{rig.process.pid}")
    line = next(x for x in (here / "status").read_text().splitlines() if x.startswith("VmRSS"))
    return (
        int(line.split()[1]) * 1024.0,
        float(len(list((here / "fd").iterdir()))),
        float(len(list((here / "task").iterdir()))),
    )
