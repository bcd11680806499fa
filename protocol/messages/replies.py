"""Replies: what each command is answered with."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from protocol.messages.access import Role
from protocol.messages.commands import (
    Abort,
    Command,
    Dark,
    Discover,
    Draw,
    EStop,
    Examine,
    GetDevices,
    GetLog,
    GetPreview,
    GetProduct,
    GetQueue,
    GetResult,
    GetRun,
    GetStage,
    GetStatus,
    Hello,
    ListRuns,
    Lock,
    MoveQueued,
    Pause,
    RenewLock,
    Reprocess,
    Reset,
    Resume,
    SetCamera,
    SetLight,
    Show,
    Snap,
    StageCircle,
    StageHome,
    StageMove,
    StageStop,
    StageUnlock,
    StartLive,
    StopLive,
    Submit,
    Unlock,
)
from protocol.messages.findings import Check, Search
from protocol.messages.rig import CameraSettings, DeviceInfo, LockInfo, RigState, StageState
from protocol.messages.runs import Product, Progress, RunInfo


class Reply(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """What a command is answered with."""


class Welcome(Reply, frozen=True, kw_only=True, tag="welcome"):
    """Answer to `hello`."""

    protocol: int
    server: str  # the daemon's version
    rig: str
    epoch: str  # new at each start of the daemon: event counters begin again
    role: Role
    events: str  # where events are published; host * or 0.0.0.0 means: the one you reached
    methods: tuple[str, ...]
    devices: tuple[str, ...]


class Status(Reply, frozen=True, kw_only=True, tag="status"):
    """Answer to `status`: the snapshot that events modify."""

    rig: str
    state: RigState
    epoch: str
    uptime_s: float
    devices: tuple[DeviceInfo, ...]
    run: RunInfo | None
    progress: Progress | None
    queue: tuple[RunInfo, ...]
    lock: LockInfo | None
    free_bytes: int
    reserve_bytes: int
    sequences: dict[str, int]  # topic -> sequence number of its last event
    reprocessing: Progress | None = None  # of a run that is reprocessed beside


class Devices(Reply, frozen=True, kw_only=True, tag="devices"):
    """Answer to `devices`."""

    devices: tuple[DeviceInfo, ...]


class Discovered(Reply, frozen=True, kw_only=True, tag="discovered"):
    """Answer to `discover`."""

    searches: tuple[Search, ...]


class Examined(Reply, frozen=True, kw_only=True, tag="examined"):
    """Answer to `doctor`: the findings in the order in which they are best repaired."""

    checks: tuple[Check, ...]


class Run(Reply, frozen=True, kw_only=True, tag="run"):
    """Answer to all that is about one run."""

    run: RunInfo


class Runs(Reply, frozen=True, kw_only=True, tag="runs"):
    """Answer to `runs` and `queue`."""

    runs: tuple[RunInfo, ...]


class Result(Reply, frozen=True, kw_only=True, tag="result"):
    """Answer to `result`; final when the run is done. `facts` is the content so far of
    quality.json, or the figures of a run that measures."""

    run: RunInfo
    final: bool
    facts: dict[str, Any] = {}


class ProductPart(Reply, frozen=True, kw_only=True, tag="product"):
    """Answer to `product`: `offset + len(data) == size` at the end."""

    product: Product
    offset: int
    size: int


class Log(Reply, frozen=True, kw_only=True, tag="log"):
    """Answer to `log`: JSON objects, oldest first."""

    records: tuple[dict[str, Any], ...]


class Picture(Reply, frozen=True, kw_only=True, tag="picture"):
    """Answer to `preview` and `snap`. `facts`: exposure, saturated fraction, histogram, times; to
    `draw`: how many `images` there are, and the `lighting` of this one."""

    facts: dict[str, Any] = {}


class Camera(Reply, frozen=True, kw_only=True, tag="camera"):
    """Answer to `camera`: the settings in force. `facts`: of auto-exposure, what it came to; with a
    `problem` where the level is not as it should be."""

    settings: CameraSettings
    facts: dict[str, Any] = {}


class StageStatus(Reply, frozen=True, kw_only=True, tag="stage"):
    """Answer to all that is about the stage. `position_mm` is None while it is unknown."""

    state: StageState
    position_mm: tuple[float, float] | None
    travel_mm: tuple[tuple[float, float], tuple[float, float]]  # (x min, max), (y min, max)
    max_feed_mm_s: float
    detail: str = ""  # which alarm, what holds it, and the remedy


class Locked(Reply, frozen=True, kw_only=True, tag="locked"):
    """Answer to `lock`: send the token with every request."""

    token: str
    lease_s: float


class Done(Reply, frozen=True, kw_only=True, tag="done"):
    """Answer where there is nothing more to say."""

    message: str = ""


AnyReply = (
    Welcome | Status | Devices | Discovered | Examined | Run | Runs | Result | ProductPart | Log
    | Picture | Camera | StageStatus | Locked | Done
)  # fmt: skip


ANSWERS: dict[type[Command], type[Reply]] = {
    Hello: Welcome,
    GetStatus: Status,
    GetDevices: Devices,
    Discover: Discovered,
    Examine: Examined,
    Submit: Run,
    Reprocess: Run,
    GetQueue: Runs,
    MoveQueued: Runs,
    Pause: Run,
    Resume: Run,
    Abort: Run,
    EStop: Done,
    Reset: Done,
    ListRuns: Runs,
    GetRun: Run,
    GetResult: Result,
    GetProduct: ProductPart,
    GetLog: Log,
    GetPreview: Picture,
    StartLive: Done,
    StopLive: Done,
    Show: Done,
    Draw: Picture,
    Snap: Picture,
    SetCamera: Camera,
    SetLight: Done,
    GetStage: StageStatus,
    StageHome: StageStatus,
    StageMove: StageStatus,
    StageCircle: StageStatus,
    StageStop: StageStatus,
    StageUnlock: StageStatus,
    Dark: Done,
    Lock: Locked,
    RenewLock: Locked,
    Unlock: Done,
}
"""What each command is answered with, unless with an error."""
