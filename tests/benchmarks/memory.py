"""Peak memory of the daemon after a scan of 1,000 frames, against one of 25."""

from __future__ import annotations

from protocol.scans.projected import Checkerboard
from tests.benchmarks.bench import daemon
from tests.benchmarks.pace import DEVICES
from tests.benchmarks.ratio import Ratio

FEW, MANY = 25, 1000


def run() -> list[Ratio]:
    """The greatest resident memory of the long scan over that of the short one."""
    few, many = _peak(1), _peak(MANY // FEW)
    return [
        Ratio(
            name=f"peak memory, {MANY} frames against {FEW}",
            value=many / few,
            of="greatest resident memory of the daemon, long over short scan",
            at_most=1.1,
            facts={"few_mb": few / 1e6, "many_mb": many / 1e6},
        )
    ]


def _peak(average: int) -> int:
    scan = Checkerboard(
        checker=8, shift=3, shifts=5, average=average, references=(), exposure_us=12_000
    )
    with daemon(DEVICES) as rig:
        info = rig.client.scan(scan).wait(300)
        if info.recorded != FEW * average:
            raise RuntimeError(f"{info.recorded} frames were recorded, not {FEW * average}")
        return rig.peak_bytes()
