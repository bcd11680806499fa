"""Events: what the daemon tells everyone, by topic."""

from __future__ import annotations

from typing import Any, ClassVar

from msgspec import Struct

from protocol.messages.rig import DeviceInfo, LockInfo, RigState, StageState
from protocol.messages.runs import Progress, RunInfo


class EventBody(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """What happened."""

    topic: ClassVar[str]


class RunChanged(EventBody, frozen=True, kw_only=True, tag="run-changed"):
    """A run has another state, or products."""

    topic: ClassVar[str] = "run"
    run: RunInfo


class Progressed(EventBody, frozen=True, kw_only=True, tag="progressed"):
    """The current run went on, or one that is reprocessed; at most some ten times a second."""

    topic: ClassVar[str] = "progress"
    progress: Progress


class QueueChanged(EventBody, frozen=True, kw_only=True, tag="queue-changed"):
    """Other runs wait, or in another order."""

    topic: ClassVar[str] = "queue"
    queue: tuple[str, ...]


class DeviceChanged(EventBody, frozen=True, kw_only=True, tag="device-changed"):
    """A device's health changed."""

    topic: ClassVar[str] = "device"
    device: DeviceInfo


class RigChanged(EventBody, frozen=True, kw_only=True, tag="rig-changed"):
    """The rig as a whole changed its state, or its lock its owner."""

    topic: ClassVar[str] = "rig"
    state: RigState
    lock: LockInfo | None = None
    reason: str = ""


class StageChanged(EventBody, frozen=True, kw_only=True, tag="stage-changed"):
    """The stage is moved by hand: told a few times a second, and when it has come to rest."""

    topic: ClassVar[str] = "stage"
    state: StageState
    position_mm: tuple[float, float] | None  # None while it is unknown
    detail: str = ""  # why it stopped short


class PreviewTaken(EventBody, frozen=True, kw_only=True, tag="preview-taken"):
    """A small picture of the latest frame or separation. Array: `preview` (uint8, RGB).

    Array `saturated` (uint8, of the same size): 1 where a pixel under it is at its full scale.
    """

    topic: ClassVar[str] = "preview"
    run: str  # "": by hand
    what: str  # frame, direct, global
    facts: dict[str, Any] = {}


class Logged(EventBody, frozen=True, kw_only=True, tag="logged"):
    """The daemon logged something: a JSON object, as in the answer to `log`."""

    topic: ClassVar[str] = "log"
    record: dict[str, Any]


AnyEvent = (
    RunChanged | Progressed | QueueChanged | DeviceChanged | RigChanged | StageChanged
    | PreviewTaken | Logged
)  # fmt: skip
