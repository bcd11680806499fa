"""Commands, replies and events: everything that travels, as msgspec tagged structs.

A request is a `Request` header (JSON) and one raw buffer for each entry of `arrays`; its answer
is a `Response` of the same form with the same `id`. Events come on the second endpoint as
``[topic, header, buffers...]``. `docs/protocol.md` is generated from this file.
"""

from __future__ import annotations

import enum
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta, Struct

from protocol.errors import ErrorInfo
from protocol.patterns import AnyPattern
from protocol.scans import AnyScan, SingleImage

PROTOCOL = 1
"""The one version of everything in this package; both sides must have the same."""

DEFAULT_COMMAND = "tcp://127.0.0.1:5750"
DEFAULT_EVENTS = "tcp://127.0.0.1:5751"


class Role(enum.StrEnum):
    """What a key may do."""

    OBSERVER = "observer"  # read and subscribe
    OPERATOR = "operator"  # everything


# ---------------------------------------------------------------- states


class RunState(enum.StrEnum):
    """Where a run is in its life.

        queued ──> waiting ──> running <──> paused
           │          │          │ │          │
           │          │          │ └────┬─────┘
           │          │          v      v
           │          │      finishing  aborted | failed | interrupted ──resume──> queued
           │          │          v
           │          │         done
           └──────────┴──> aborted;  waiting ──> failed

    `waiting`: for what it needs before its first frame (`Progress.waits`); left out where all is
    there. `interrupted` is what a restart makes of a run that was under way; one that waited is
    queued again.
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


class RigState(enum.StrEnum):
    """What the rig as a whole is doing.

    idle ──> manual ──> idle       a person shows patterns or takes snaps
    idle | manual ──> waiting ──> scanning <──> paused      the state of the run under way
    waiting | scanning | paused ──> idle
    any ──> estopped ──reset──> idle
    any ──> stopping               the daemon is shutting down
    """

    IDLE = "idle"
    MANUAL = "manual"
    WAITING = "waiting"  # a run waits for what it needs before its first frame
    SCANNING = "scanning"
    PAUSED = "paused"  # dark and held, in the middle of a run
    ESTOPPED = "estopped"
    STOPPING = "stopping"


class Health(enum.StrEnum):
    """How a device is."""

    READY = "ready"
    LOST = "lost"  # it was there; reconnection is being tried
    FAULT = "fault"  # it answers, and says that something is wrong
    STUCK = "stuck"  # a call into its driver has not come back in time


class StageState(enum.StrEnum):
    """What a stage is doing. Unknown: its position is not known, and only homing is allowed.

    unknown ──home──> homing ──> idle <──> moving | held;  any ──> alarm ──unlock──> unknown
    any ──reconnect──> unknown
    """

    UNKNOWN = "unknown"
    HOMING = "homing"
    IDLE = "idle"
    MOVING = "moving"
    HELD = "held"
    ALARM = "alarm"


class Outcome(enum.StrEnum):
    """What a check of `doctor` came to."""

    OK = "ok"
    WARNING = "warning"  # scans work, but not as well as they could
    FAILED = "failed"  # scans fail, or lie
    SKIPPED = "skipped"  # it could not be looked at


# ---------------------------------------------------------------- facts


class Fact(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A piece of a reply or an event."""


class ArrayHeader(Fact, frozen=True, kw_only=True):
    """One raw buffer that follows the header: C order, native little endian."""

    name: str
    dtype: str  # NumPy's: uint8, uint16, float32
    shape: tuple[int, ...]


class DeviceInfo(Fact, frozen=True, kw_only=True):
    """One device of the rig. `facts` is what its driver says of it (size, refresh, format)."""

    name: str  # "camera", "projector", "stage", or a light's name
    kind: str  # camera, projector, stage, light
    driver: str
    health: Health
    model: str = ""
    serial: str = ""
    firmware: str = ""
    message: str = ""  # of the last fault
    facts: dict[str, Any] = {}


class Product(Fact, frozen=True, kw_only=True):
    """A file that a run made."""

    name: str  # direct, global, quality, preview, report ...
    kind: str  # image, mask, facts, picture, report
    file: str  # in the run's folder
    unit: str = ""
    bytes: int = 0


class End(Fact, frozen=True, kw_only=True):
    """Why a run ended; `by` names who aborted it."""

    state: RunState
    reason: str
    code: str = ""
    by: str = ""


class RunInfo(Fact, frozen=True, kw_only=True):
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


class Waiting(Fact, frozen=True, kw_only=True):
    """What a run waits for before its first frame; times are UTC, ISO 8601."""

    what: str  # disk, devices, stage, light, steadiness
    seen: str  # how it is at the last look, in words, with what is wanted
    since: str
    until: str  # then the run fails


class Progress(Fact, frozen=True, kw_only=True):
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


class LockInfo(Fact, frozen=True, kw_only=True):
    """Who holds the rig for manual work, and why."""

    owner: str
    note: str
    remaining_s: float


class CameraSettings(Fact, frozen=True, kw_only=True):
    """What a camera can be told; None leaves a setting as it is. Names: SFNC's, in snake case."""

    exposure_us: Annotated[float, Meta(gt=0, description="exposure of a frame in µs")] | None = None
    gain: Annotated[float, Meta(description="in the camera's own unit")] | None = None
    pixel_format: Annotated[str, Meta(description="Mono8, BayerRG12 ...")] | None = None
    frame_rate_hz: Annotated[float, Meta(gt=0, description="of a free-running camera")] | None = (
        None
    )
    roi: (
        Annotated[tuple[int, int, int, int], Meta(description="x, y, width, height in pixels")]
        | None
    ) = None


class Found(Fact, frozen=True, kw_only=True):
    """A device that is attached."""

    model: str
    serial: str
    toml: str  # to paste into rig.toml
    used_by: str = ""  # the rig's device that is this one already


class Search(Fact, frozen=True, kw_only=True):
    """What one driver found, or why it could not look."""

    kind: str
    driver: str
    found: tuple[Found, ...] = ()
    problem: str = ""  # with the remedy


class Check(Fact, frozen=True, kw_only=True):
    """One finding of `doctor`."""

    name: str  # "disk: speed": what was looked at
    outcome: Outcome
    message: str
    remedy: str = ""  # what to do


# ---------------------------------------------------------------- commands


class Command(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """Something a client asks for. `role` is the least role that may."""

    role: ClassVar[Role] = Role.OBSERVER


class Hello(Command, frozen=True, kw_only=True, tag="hello"):
    """First of all: who speaks, and which version."""

    client: str = ""


class GetStatus(Command, frozen=True, kw_only=True, tag="status"):
    """A snapshot of everything that changes: rig, devices, current run, queue, event counters."""


class GetDevices(Command, frozen=True, kw_only=True, tag="devices"):
    """The devices in detail."""


class Discover(Command, frozen=True, kw_only=True, tag="discover"):
    """What is attached, driver by driver. Refused while a run uses the devices.

    Vendors' libraries look for cameras by broadcasts on every network, so this happens only when
    it is asked for, and by the drivers that are named, or else installed.
    """

    role: ClassVar[Role] = Role.OPERATOR
    drivers: tuple[str, ...] = ()  # none named: every one that is installed
    timeout_s: Annotated[float, Meta(gt=0, le=120)] = 15.0  # for each; they look side by side


class Examine(Command, frozen=True, kw_only=True, tag="doctor"):
    """Look for what is wrong with the rig. Exposes, as manual work: not while a run goes on.

    `passive` leaves the devices alone, and is answered at any time.
    """

    role: ClassVar[Role] = Role.OPERATOR
    passive: bool = False


class Submit(Command, frozen=True, kw_only=True, tag="submit"):
    """Queue a scan; answers at once with its run. Durable once answered."""

    role: ClassVar[Role] = Role.OPERATOR
    spec: AnyScan
    by: str = ""
    first: bool = False  # ahead of the queue


class Reprocess(Command, frozen=True, kw_only=True, tag="reprocess"):
    """Separate the recorded frames of a run that has ended anew; answers at once with a new run.

    `changes` are other values for fields of its spec by name, also for those of `radiometry`: the
    ones that say how frames are read; null is as if it had not been said: as calibrated, or its
    default. What says what was shown or exposed is refused. Needs no device, and does not wait in
    the queue of scans. The run that it is made from stays as it is.
    """

    role: ClassVar[Role] = Role.OPERATOR
    run: str
    changes: dict[str, Any] = {}
    calibration: Literal["recorded", "now"] = "recorded"  # the run's own, or what applies today
    by: str = ""


class GetQueue(Command, frozen=True, kw_only=True, tag="queue"):
    """The runs that wait, in order."""


class MoveQueued(Command, frozen=True, kw_only=True, tag="move-queued"):
    """Put a waiting run at another place in the queue (0 is next)."""

    role: ClassVar[Role] = Role.OPERATOR
    run: str
    to: Annotated[int, Meta(ge=0)]


class Pause(Command, frozen=True, kw_only=True, tag="pause"):
    """Pause the run after the step under way; the projector goes dark, the stage holds."""

    role: ClassVar[Role] = Role.OPERATOR
    run: str = ""  # "": the current one


class Resume(Command, frozen=True, kw_only=True, tag="resume"):
    """Go on with a paused run, or queue an interrupted one again where it stopped."""

    role: ClassVar[Role] = Role.OPERATOR
    run: str = ""


class Abort(Command, frozen=True, kw_only=True, tag="abort"):
    """End a run, waiting or running, and go to the safe state; what was recorded is kept."""

    role: ClassVar[Role] = Role.OPERATOR
    run: str = ""
    by: str = ""


class EStop(Command, frozen=True, kw_only=True, tag="estop"):
    """Safe state now: abort the run, hold the queue, refuse everything until `reset`."""

    role: ClassVar[Role] = Role.OPERATOR
    by: str = ""


class Reset(Command, frozen=True, kw_only=True, tag="reset"):
    """End an emergency stop: devices are checked, then the queue goes on."""

    role: ClassVar[Role] = Role.OPERATOR


class ListRuns(Command, frozen=True, kw_only=True, tag="runs"):
    """Runs, the newest first."""

    limit: Annotated[int, Meta(ge=1, le=10_000)] = 50
    state: RunState | None = None


class GetRun(Command, frozen=True, kw_only=True, tag="run"):
    """One run; "" is the current or else the newest."""

    run: str = ""


class GetResult(Command, frozen=True, kw_only=True, tag="result"):
    """Direct and global as float32 arrays, at any time from the first frames on.

    Arrays: `direct`, `global` (H x W or H x W x 3, RGB, linear counts), `quality` (uint16 bits).
    A run that measures (a calibration, a verification) is answered with its facts, and no arrays.
    """

    run: str = ""


class GetProduct(Command, frozen=True, kw_only=True, tag="product"):
    """The bytes of a product's file, a part at a time. Array: `data` (uint8)."""

    run: str
    name: str
    offset: Annotated[int, Meta(ge=0)] = 0
    limit: Annotated[int, Meta(ge=1, le=64 << 20)] = 8 << 20


class GetLog(Command, frozen=True, kw_only=True, tag="log"):
    """The last log records of a run, also of before a restart; or of the daemon since its start."""

    run: str = ""
    limit: Annotated[int, Meta(ge=1, le=10_000)] = 200


class GetPreview(Command, frozen=True, kw_only=True, tag="preview"):
    """The latest frame, small: array `preview` (uint8, RGB), with counts of saturated pixels.

    Array `saturated` (uint8, of a frame): 1 where a pixel under it is at its full scale.
    """

    width: Annotated[int, Meta(ge=16, le=4096)] = 640
    what: str = "frame"  # frame, direct, global


class StartLive(Command, frozen=True, kw_only=True, tag="live"):
    """Look through the camera live: pictures come as `preview-taken`, until nobody asks again.

    Asked again it goes on for another `lease_s`. A run that begins ends it, and publishes previews
    of its own. With `separate` its stripes are shown, and each frame's direct and global published.
    """

    role: ClassVar[Role] = Role.OPERATOR
    rate_hz: Annotated[float, Meta(gt=0, le=15)] = 4.0  # fewer where they cost too much time
    lease_s: Annotated[float, Meta(ge=1, le=600)] = 10.0
    separate: SingleImage | None = None


class StopLive(Command, frozen=True, kw_only=True, tag="stop-live"):
    """End the live view; what is shown and lit by hand stays."""

    role: ClassVar[Role] = Role.OPERATOR


class Show(Command, frozen=True, kw_only=True, tag="show"):
    """Show a pattern by hand; the projector goes dark when nobody has asked again for `lease_s`."""

    role: ClassVar[Role] = Role.OPERATOR
    pattern: AnyPattern
    lease_s: Annotated[float, Meta(gt=0, le=86_400)] = 600.0


class Snap(Command, frozen=True, kw_only=True, tag="snap"):
    """Take one frame as things are. Array: `frame`, native depth, or `png` (uint8) if asked."""

    role: ClassVar[Role] = Role.OPERATOR
    png: bool = False
    demosaic: bool = True


class SetCamera(Command, frozen=True, kw_only=True, tag="camera"):
    """Change camera settings (none given: only read); answers with those in force.

    With `auto_exposure` the exposure is then chosen by pictures of the scene as it is lit now; an
    exposure that is given is the longest.
    """

    role: ClassVar[Role] = Role.OPERATOR
    settings: CameraSettings = CameraSettings()
    auto_exposure: bool = False


class SetLight(Command, frozen=True, kw_only=True, tag="light"):
    """Switch a light."""

    role: ClassVar[Role] = Role.OPERATOR
    name: str
    on: bool


class GetStage(Command, frozen=True, kw_only=True, tag="stage"):
    """Where the stage is and what it is doing."""


class StageHome(Command, frozen=True, kw_only=True, tag="stage-home"):
    """Find the stage's origin; answered at once, the end shows in `stage`."""

    role: ClassVar[Role] = Role.OPERATOR
    timeout_s: Annotated[float, Meta(gt=0, le=600)] = 60.0


class StageMove(Command, frozen=True, kw_only=True, tag="stage-move"):
    """Go straight to a point, mm; refused outside the travel. Answered when accepted."""

    role: ClassVar[Role] = Role.OPERATOR
    x_mm: float
    y_mm: float
    feed_mm_s: Annotated[float, Meta(gt=0)]


class StageCircle(Command, frozen=True, kw_only=True, tag="stage-circle"):
    """Go round a circle, counter-clockwise; refused if any of it is outside the travel.

    `turns` None goes on until `stage-stop`. Answered when accepted.
    """

    role: ClassVar[Role] = Role.OPERATOR
    centre_mm: tuple[float, float]
    radius_mm: Annotated[float, Meta(gt=0)]
    feed_mm_s: Annotated[float, Meta(gt=0)]
    turns: Annotated[float, Meta(gt=0)] | None = None


class StageStop(Command, frozen=True, kw_only=True, tag="stage-stop"):
    """End every motion of the stage, which then holds; nothing is left to resume."""

    role: ClassVar[Role] = Role.OPERATOR


class StageUnlock(Command, frozen=True, kw_only=True, tag="stage-unlock"):
    """Leave the stage's alarm without homing; its position stays unknown."""

    role: ClassVar[Role] = Role.OPERATOR


class Dark(Command, frozen=True, kw_only=True, tag="dark"):
    """End manual work: projector dark, lights off, stage held."""

    role: ClassVar[Role] = Role.OPERATOR


class Lock(Command, frozen=True, kw_only=True, tag="lock"):
    """Hold the rig for one client. It must be renewed before `lease_s` is over.

    A lock that loses its heartbeat ends in the safe state. Others' motion, show, snap and scans
    are refused with the owner's name meanwhile; abort and e-stop never are.
    """

    role: ClassVar[Role] = Role.OPERATOR
    owner: str
    note: str = ""
    lease_s: Annotated[float, Meta(gt=0, le=3600)] = 10.0


class RenewLock(Command, frozen=True, kw_only=True, tag="renew-lock"):
    """The heartbeat of a lock; the request's `token` says which."""

    role: ClassVar[Role] = Role.OPERATOR


class Unlock(Command, frozen=True, kw_only=True, tag="unlock"):
    """Give the rig back. An operator may break another's lock with `force`."""

    role: ClassVar[Role] = Role.OPERATOR
    force: bool = False


AnyCommand = (
    Hello | GetStatus | GetDevices | Discover | Examine | Submit | Reprocess | GetQueue
    | MoveQueued | Pause | Resume | Abort | EStop | Reset | ListRuns | GetRun | GetResult
    | GetProduct | GetLog | GetPreview | StartLive | StopLive
    | Show | Snap | SetCamera | SetLight | GetStage | StageHome | StageMove
    | StageCircle | StageStop | StageUnlock | Dark | Lock | RenewLock | Unlock
)  # fmt: skip


# ---------------------------------------------------------------- replies


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
    """Answer to `preview` and `snap`. `facts`: exposure, saturated fraction, histogram, times."""

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


# ---------------------------------------------------------------- events


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


# ---------------------------------------------------------------- envelopes


class Preamble(Struct, frozen=True, kw_only=True):
    """The part of a request that every version can read: checked before the rest."""

    id: str = ""
    protocol: int = 0


class Request(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A request's header. The client makes `id`, at random: a repeat gets the first answer."""

    id: Annotated[str, Meta(min_length=8, max_length=64)]
    protocol: int
    command: AnyCommand
    token: str = ""  # of the lock, if the client holds it
    arrays: tuple[ArrayHeader, ...] = ()


class Response(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A response's header: a reply or an error, never both."""

    id: str
    reply: AnyReply | None = None
    error: ErrorInfo | None = None
    arrays: tuple[ArrayHeader, ...] = ()


class Event(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An event's header. `sequence` counts from 1 within topic and epoch, without gaps."""

    topic: str
    sequence: int
    epoch: str
    utc: str
    body: AnyEvent
    arrays: tuple[ArrayHeader, ...] = ()
