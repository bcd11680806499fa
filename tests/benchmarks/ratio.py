"""What a benchmark gives: a figure of Umbra's over one of the machine it runs on.

Ratios, because seconds of one machine say nothing about another. The two sides of a ratio are
measured in turn within the same seconds, so that a busy machine disturbs both.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence

import msgspec


class Skipped(Exception):
    """A benchmark cannot run here; says what it lacks."""


class Ratio(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the table, and of bench.json.

    `target` is what the design promises of `value`, as text ("" where it promises nothing);
    `at_least`/`at_most` the same for programs. `facts` are the figures that it was made of.
    """

    name: str
    value: float
    of: str  # what is over what
    at_least: float | None = None
    at_most: float | None = None
    facts: dict[str, float] = {}

    @property
    def target(self) -> str:
        """What was promised."""
        if self.at_least is not None:
            return f">= {self.at_least:g}"
        return f"<= {self.at_most:g}" if self.at_most is not None else ""

    @property
    def kept(self) -> bool | None:
        """Whether the promise is kept; None where there is none."""
        if self.at_least is not None:
            return self.value >= self.at_least
        return self.value <= self.at_most if self.at_most is not None else None


def in_turn(acts: Sequence[Callable[[], object]], rounds: int) -> list[float]:
    """Median seconds of each act, over rounds in which each is done once; the first is warm-up."""
    times: list[list[float]] = [[] for _ in acts]
    for number in range(rounds + 1):
        for act, taken in zip(acts, times, strict=True):
            began = time.perf_counter()
            act()
            if number:
                taken.append(time.perf_counter() - began)
    return [statistics.median(taken) for taken in times]


def percentile(values: Sequence[float], share: float) -> float:
    """The value below which a share of the values lies (nearest rank)."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
