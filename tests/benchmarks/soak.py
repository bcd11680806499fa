"""A night outdoors in minutes: scan after scan under a sun with clouds, in gusts, with faults.

Opt-in (`python -m tests.benchmarks soak`): ten minutes, or UMBRA_SOAK_S seconds. Each run must end
done, or failed with a code and a reason; after the faults the devices must come back by themselves;
and neither memory nor descriptors nor threads may grow with the runs.
"""

from __future__ import annotations

import os
import statistics
import time
from collections import Counter
from pathlib import Path

from protocol.messages.runs import RunInfo, RunState
from protocol.scans import Mesh
from tests.benchmarks.bench import Running, daemon
from tests.benchmarks.ratio import Ratio

SECONDS = float(os.environ.get("UMBRA_SOAK_S", "600"))
SCALE = 3.0
READY_S = 60.0
SPEC = Mesh(
    hole_mm=25.0, pitch_mm=40.0, scene_mm=150.0, sun=True, coverage=0.99, time_limit_s=60.0
)  # fmt: skip


def _every(kind: str, first: int, step: int) -> str:
    return ", ".join(f'"{kind}@{first + k * step}"' for k in range(60))


def _gusts() -> str:
    """A gust of a quarter of a minute each minute, for two hours of the rig's."""
    points = [(60 * k + s, px) for k in range(120) for s, px in ((0, 0), (40, 0), (45, 3), (55, 0))]
    return ", ".join(f"[{s}, {px}]" for s, px in points)


DEVICES = f"""
[storage]
keep_gb = 0.2
[camera]
driver = "virtual"
width = 208
height = 156
pixel_format = "Mono12"
frame_rate_hz = 8
gusts = [{_gusts()}]
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
cloudiness = 0.4
"""


def run() -> list[Ratio]:
    """Growth of memory, descriptors and threads; and runs that ended without a word."""
    ends: Counter[str] = Counter()
    kept: list[tuple[float, float, float]] = []
    frames = missing = rejected = 0
    silent = 0
    with daemon(DEVICES, time_scale=SCALE) as rig:
        until = time.monotonic() + SECONDS
        while time.monotonic() < until:
            _ready(rig)
            info = rig.client.scan(SPEC).wait(300, check=False)
            ends[_end(info)] += 1
            silent += not _said(info)
            frames, missing = frames + info.recorded, missing + info.missing
            rejected += info.rejected
            kept.append(_holds(rig))
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
        )
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
    for words in ("wanted:", "wanted", "time limit"):
        if words in info.end.reason:
            return {"wanted:": "done: no more to cover", "wanted": "done: covered"}.get(
                words, "done: time limit"
            )
    return "done"


def _holds(rig: Running) -> tuple[float, float, float]:
    """Resident bytes, open files and threads of the daemon."""
    here = Path(f"/proc/{rig.process.pid}")
    line = next(x for x in (here / "status").read_text().splitlines() if x.startswith("VmRSS"))
    return (
        int(line.split()[1]) * 1024.0,
        float(len(list((here / "fd").iterdir()))),
        float(len(list((here / "task").iterdir()))),
    )
