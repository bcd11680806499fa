"""What has become of a run's frames, told record by record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daemon.storage.frames import FrameRecord


@dataclass(frozen=True, slots=True)
class Tally:
    """Frames on the disk, frames that could not be had, and those on the disk that are not used."""

    recorded: int = 0
    missing: int = 0
    rejected: int = 0

    @property
    def taken(self) -> int:
        """Frames that the plan need not expose again."""
        return self.recorded + self.missing


class Ledger:
    """Notes records in order; for one thread. What it tells may be read by any."""

    def __init__(self) -> None:
        self._tally = Tally()
        self._exposing: Counter[str] = Counter()
        self._missing: dict[int, str] = {}  # patterns of which a frame is missing, and why, last
        self._seen: set[int] = set()  # patterns of which a frame is used
        self._why_unused = ""

    def note(self, record: FrameRecord) -> None:
        """Take in one more record."""
        tally, observation = self._tally, record.observation
        self._exposing.update(record.exposing)
        if record.missing:
            self._missing[observation.pattern] = record.missing
            self._tally = replace(tally, missing=tally.missing + 1)
            return
        if observation.used:
            self._seen.add(observation.pattern)
        else:
            self._why_unused = observation.reason
        self._tally = Tally(
            tally.recorded + 1, tally.missing, tally.rejected + (not observation.used)
        )

    @property
    def tally(self) -> Tally:
        """How many frames there are of each kind."""
        return self._tally

    @property
    def exposing(self) -> Mapping[str, int]:
        """The sum of what the records say of the exposing: see `FrameRecord`."""
        return dict(self._exposing)

    @property
    def why_unused(self) -> str:
        """Why the last frame was not used that was not; "": all were."""
        return self._why_unused

    @property
    def lost_patterns(self) -> dict[int, str]:
        """Patterns of which no frame could be had, and why."""
        missing = sorted(self._missing.items())
        return {pattern: why for pattern, why in missing if pattern not in self._seen}
