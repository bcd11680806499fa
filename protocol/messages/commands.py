"""Commands: what a client may ask for, and the least role that may."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta, Struct

from protocol.messages.access import Role
from protocol.messages.rig import CameraSettings
from protocol.messages.runs import RunState
from protocol.patterns import AnyPattern
from protocol.scans.anyscan import AnyScan
from protocol.scans.projected import SingleImage


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


class Draw(Command, frozen=True, kw_only=True, tag="draw"):
    """One image of a scan's patterns, to project it by other means. Array: `png` (uint8), 8-bit
    grey. Of the projector that is attached nothing is used.

    Image 0 is black, 1 is white, then comes each pattern once, in the scan's order; `facts` has
    `images`, how many there are, and what this one is for (`lighting`).
    """

    spec: AnyScan
    image: Annotated[int, Meta(ge=0)] = 0
    width: Annotated[int, Meta(ge=1, le=16_384)]
    height: Annotated[int, Meta(ge=1, le=16_384)]
    gamma: Annotated[float, Meta(gt=0, le=10)] = 1.0  # light is level to this power: taken off


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
    | Show | Draw | Snap | SetCamera | SetLight | GetStage | StageHome | StageMove
    | StageCircle | StageStop | StageUnlock | Dark | Lock | RenewLock | Unlock
)  # fmt: skip
