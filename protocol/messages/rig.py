"""The rig as it is now: its state, its devices, and who holds it."""

from __future__ import annotations

import enum
from typing import Annotated, Any

from msgspec import Meta, Struct


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


class DeviceInfo(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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


class CameraSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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


class LockInfo(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who holds the rig for manual work, and why."""

    owner: str
    note: str
    remaining_s: float
