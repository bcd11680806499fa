"""A run as it is now: its state, how far it is, why it ended, what it made."""

from __future__ import annotations

import enum
from typing import Any

from msgspec import Struct

from protocol.scans.anyscan import AnyScan


class RunState(enum.StrEnum):
    """Where a run is in its life.

        queued ──> waiting <─> running <──> paused
           │          │          │ │          │
           │          │          │ └────┬─────┘
           │          │          v      v
           │          │      finishing  aborted | failed | interrupted ──resume──> queued
           │          │          v
           │          │         done
           └──────────┴──> aborted;  waiting ──> failed

    `waiting`: for what it needs before its first frame (`Progress.waits`); left out where all is
    there; and again for a device that fails later, where a deadline says so. `interrupted` is what
    a restart makes of a run that was under way; one that waited is queued again.
    """

    QUEUED = "queued"
    WAITING = "waiting"
    RUNNING = "running"
    PAUSED = "paused"
    FINISHING = "finishing"  # the last frame is in; products are being written
    DONE = "done"
    ABORTED = "aborted"
    FAILED = "failed"
    INTERRUPTED = "interrupted"

    @property
    def ended(self) -> bool:
        """Whether nothing more happens to the run by itself."""
        return self in {self.DONE, self.ABORTED, self.FAILED, self.INTERRUPTED}


class Product(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file that a run made."""

    name: str  # direct, global, quality, preview, report ...
    kind: str  # image, mask, facts, picture, report
    file: str  # in the run's folder
    unit: str = ""
    bytes: int = 0


class End(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Why a run ended; `by` names who aborted it."""

    state: RunState
    reason: str
    code: str = ""
    by: str = ""


class RunInfo(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run as it is now: an immutable snapshot. Times are UTC, ISO 8601."""

    id: str
    state: RunState
    spec: AnyScan
    submitted: str
    by: str = ""
    started: str = ""
    ended: str = ""
    planned: int | None = None  # frames, where the plan knows
    recorded: int = 0
    missing: int = 0
    rejected: int = 0
    end: End | None = None
    products: tuple[Product, ...] = ()
    parents: tuple[str, ...] = ()
    #: how exposures were kept in step with patterns: mode, why, warnings, counts
    sequencing: dict[str, Any] | None = None


class Waiting(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a run waits for before its first frame; times are UTC, ISO 8601."""

    what: str  # disk, devices, stage, light, steadiness
    seen: str  # how it is at the last look, in words, with what is wanted
    since: str
    until: str  # then the run fails


class Progress(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How far a run is. `fraction` is of the plan, or of the coverage wanted."""

    run: str
    state: RunState
    recorded: int
    planned: int | None
    missing: int
    rejected: int
    fraction: float | None
    rate_hz: float  # frames recorded a second, lately
    remaining_s: float | None
    phase: str = ""  # what is going on, for people
    summary: dict[str, float] = {}  # the estimator's own figures
    waits: Waiting | None = None
