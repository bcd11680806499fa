"""What a look at the rig finds: devices that are attached, and what is wrong."""

from __future__ import annotations

import enum

from msgspec import Struct


class Outcome(enum.StrEnum):
    """What a check of `doctor` came to."""

    OK = "ok"
    WARNING = "warning"  # scans work, but not as well as they could
    FAILED = "failed"  # scans fail, or lie
    SKIPPED = "skipped"  # it could not be looked at


class Found(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A device that is attached."""

    model: str
    serial: str
    toml: str  # to paste into rig.toml
    used_by: str = ""  # the rig's device that is this one already


class Search(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one driver found, or why it could not look."""

    kind: str
    driver: str
    found: tuple[Found, ...] = ()
    problem: str = ""  # with the remedy


class Check(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One finding of `doctor`."""

    name: str  # "disk: speed": what was looked at
    outcome: Outcome
    message: str
    remedy: str = ""  # what to do
