"""`make bench`: run the benchmarks, print a table of ratios, write bench.json.

Each benchmark is a module with a function `run` that gives named ratios. Names on the command
line choose some of them; `soak` is done only if it is named. A promise that is not kept is marked;
the exit code is 1 then.
"""

from __future__ import annotations

import importlib
import os
import platform
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from tests.benchmarks.ratio import Ratio, Skipped

NAMES = ("separation", "accuracy", "pace", "latency", "memory", "startup", "safety", "hardware")
OPT_IN = ("soak",)  # too long for all of them
MARKS = {True: "kept", False: "NOT KEPT", None: ""}


def main(names: list[str]) -> int:
    """Run the benchmarks named, or all."""
    if unknown := set(names) - {*NAMES, *OPT_IN}:
        print(
            f"no benchmark {sorted(unknown)[0]!r}; there are {', '.join(NAMES + OPT_IN)}",
            file=sys.stderr,
        )
        return 2
    found: list[Ratio] = []
    for name in names or NAMES:
        began = time.monotonic()
        try:
            ratios = importlib.import_module(f"tests.benchmarks.{name}").run()
        except Skipped as reason:
            print(f"{name} skipped: {reason}")
            continue
        print(f"{name} ({time.monotonic() - began:.0f} s)")
        for ratio in ratios:
            mark = MARKS[ratio.kept]
            print(f"  {ratio.name:<42} {ratio.value:8.3f}  {ratio.target:<7} {mark}")
            print(f"    {ratio.of}")
            print("    " + ", ".join(f"{key} {value:.4g}" for key, value in ratio.facts.items()))
        found += ratios
    page = {
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {
            "cpus": os.cpu_count(),
            "system": platform.platform(),
            "python": platform.python_version(),
        },
        "ratios": [
            {**msgspec.to_builtins(ratio), "target": ratio.target, "kept": ratio.kept}
            for ratio in found
        ],
    }
    Path("bench.json").write_bytes(msgspec.json.format(msgspec.json.encode(page)) + b"\n")
    print(f"\nbench.json: {len(found)} ratios")
    return int(any(ratio.kept is False for ratio in found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
