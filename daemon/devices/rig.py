"""The rig: owns the devices and their threads, watches their health, knows the safe state."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, cast

import structlog

from daemon.config import RigConfig
from daemon.devices.devicethread import DeviceThread, Revoked, Session
from daemon.scans.method import Bench
from drivers import registry
from drivers.base.camera import Camera
from drivers.base.device import Context, Device, Identity
from drivers.base.errors import DeviceError, DeviceLost
from drivers.base.light import Light
from drivers.base.projector import Projector
from drivers.base.stage import Stage
from drivers.clock import Clock, RealClock, ScaledClock
from protocol.errors import Code, UmbraError
from protocol.messages.rig import DeviceInfo, Health

CONNECT_S = 20.0
"""Deadline of a connect: the slowest is a camera's SDK that enumerates."""
CHECK_S = 2.0  # deadline of a sign of life
SAFE_S = 5.0  # deadline of a safe state
CHECK_EVERY_S = 2.0  # between two signs of life
_RETRY_S = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)  # pauses between attempts to connect

log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Member:
    """A device of the rig, and what is known of it."""

    thread: DeviceThread[Any]
    driver: str
    health: Health = Health.LOST
    identity: Identity | None = None
    message: str = "not connected yet"
    failures: int = 0
    next_try: float = 0.0
    pending: Future[Any] | None = None  # a connect or check under way
    stale: Future[Any] | None = None  # one that was asked before the device was seen to be lost

    @property
    def device(self) -> Device:
        return cast(Device, self.thread.device)

    def info(self) -> DeviceInfo:
        identity = self.identity or Identity(model="")
        return DeviceInfo(
            name=self.device.name,
            kind=self.device.kind,
            driver=self.driver,
            health=self.health,
            model=identity.model,
            serial=identity.serial,
            firmware=identity.firmware,
            message=self.message,
            facts=self.device.facts() if self.identity else {},
        )


class Rig:
    """All devices of one rig.toml, connected and kept so.

    Health of a device:  lost ──connect──> ready <──> fault;  any ──call overdue──> stuck.
    A lost device is connected again with growing pauses, and must be the same one (identity).
    """

    def __init__(self, config: RigConfig, on_health: Callable[[DeviceInfo], None]) -> None:
        scale = config.rig.time_scale
        self.clock: Clock = RealClock() if scale == 1.0 else ScaledClock(scale)
        context = Context(clock=self.clock)
        self._on_health = on_health
        self._lock = threading.Lock()
        self._members: dict[str, _Member] = {}
        self._session: Session | None = None
        self._latched = False  # an emergency stop is in force
        for table in config.devices:
            device = registry.build(table.kind, table.driver, table.name, table.options, context)
            self._members[table.name] = _Member(DeviceThread(device), table.driver)

    # ------------------------------------------------------------ devices by kind

    def _only(self, kind: str) -> DeviceThread[Any] | None:
        return next((m.thread for m in self._members.values() if m.device.kind == kind), None)

    @property
    def camera(self) -> DeviceThread[Camera]:
        """The camera's thread. Raises UmbraError(device_missing)."""
        return self._need("camera")

    @property
    def projector(self) -> DeviceThread[Projector] | None:
        """The projector's thread, if the rig has one."""
        return self._only("projector")

    @property
    def stage(self) -> DeviceThread[Stage] | None:
        """The stage's thread, if the rig has one."""
        return self._only("stage")

    @property
    def lights(self) -> dict[str, DeviceThread[Light]]:
        """The switchable sources by name."""
        return {n: m.thread for n, m in self._members.items() if m.device.kind == "light"}

    def _need(self, kind: str) -> DeviceThread[Any]:
        thread = self._only(kind)
        if thread is None:
            raise UmbraError(
                Code.DEVICE_MISSING, f"this rig has no {kind}: add [{kind}] to rig.toml"
            )
        return thread

    def devices(self) -> tuple[DeviceInfo, ...]:
        """Snapshots of all devices."""
        return tuple(m.info() for m in self._members.values())

    def names(self) -> tuple[str, ...]:
        """The devices' names."""
        return tuple(self._members)

    def bench(self, calibration: Mapping[str, Any] | None = None) -> Bench:
        """The rig as a scan method sees it, with the calibration that applies.

        Raises UmbraError where a device is missing or lost.
        """
        self.require_ready()
        projector, stage = self.projector, self.stage
        settings = self.camera.device.settings()
        return Bench(
            camera=self.camera.device.info(),
            projector=projector.device.info() if projector else None,
            stage=stage.device.info() if stage else None,
            lights=tuple(self.lights),
            exposure_us=settings.exposure_us,
            gain=settings.gain,
            calibration=calibration,
        )

    @property
    def ready(self) -> bool:
        """Whether there is a camera, and every device is ready."""
        members = self._members.values()
        return self._only("camera") is not None and all(m.health is Health.READY for m in members)

    def require_ready(self) -> None:
        """Raise UmbraError(device_lost) naming the first device that is not ready."""
        self._need("camera")
        for kind in dict.fromkeys(m.device.kind for m in self._members.values()):
            self.require_kind(kind)

    def require_kind(self, kind: str) -> None:
        """Raise UmbraError(device_lost) naming a device of this kind that is not ready."""
        for member in self._members.values():
            if member.device.kind == kind and member.health is not Health.READY:
                raise UmbraError(
                    Code.DEVICE_LOST,
                    f"{member.device.name} ({member.driver}) is {member.health}: {member.message}",
                )

    # ------------------------------------------------------------ health

    def connect(self) -> None:
        """Connect everything, side by side; a device that fails stays `lost` and is tried again."""
        for member in self._members.values():
            self._begin(member, CONNECT_S, self._connecting(member))
        for member in self._members.values():
            self._finish(member, CONNECT_S)

    def tend(self) -> None:
        """Keep devices connected; call about once a second from one thread; never blocks.

        While a session uses the devices only lost ones are tended: the session notices the rest.
        """
        now = time.monotonic()
        for member in self._members.values():
            if member.thread.stuck and member.health is not Health.STUCK:
                self._set(member, Health.STUCK, "a call into its driver does not come back")
            if member.pending is not None:
                if member.pending.done():
                    self._finish(member, 0)
            elif now >= member.next_try:
                if member.health is Health.READY:
                    if self._session is None:
                        self._begin(member, CHECK_S, lambda d: d.check())
                elif member.health is not Health.STUCK or not member.thread.stuck:
                    self._begin(member, CONNECT_S, self._connecting(member))

    def failed(self, error: DeviceError) -> None:
        """A session met this error: the device's health is corrected at once."""
        member = self._members.get(error.device)
        if member is None:
            return
        if isinstance(error, DeviceLost) or member.thread.stuck:
            member.stale = member.pending
            known = member.health is Health.LOST  # the first error was the cause
            message = member.message if known else str(error)
            self._set(member, Health.STUCK if member.thread.stuck else Health.LOST, message)

    @contextlib.contextmanager
    def noticing(self) -> Iterator[None]:
        """What a device says meanwhile counts for its health: a lost one is connected again."""
        try:
            yield
        except DeviceError as error:
            self.failed(error)
            raise

    def _connecting(self, member: _Member) -> Callable[[Device], None]:
        def connect(device: Device) -> None:
            identity = device.connect()
            known = member.identity
            if known is not None and (known.model, known.serial) != (
                identity.model,
                identity.serial,
            ):
                device.close()
                raise DeviceLost(
                    device.name,
                    "connect",
                    f"another device came back: {identity.model} {identity.serial}, "
                    f"not {known.model} {known.serial}",
                    "plug the first one in again, or restart umbrad to accept this one",
                )
            device.safe()
            member.identity = identity

        return connect

    def _begin(self, member: _Member, deadline_s: float, act: Callable[[Any], None]) -> None:
        member.next_try = time.monotonic() + CHECK_EVERY_S
        member.pending = member.thread.submit(act, deadline_s)

    def _finish(self, member: _Member, wait_s: float) -> None:
        pending, member.pending = member.pending, None
        if pending is None:
            return
        if pending is member.stale and pending.done():
            member.next_try = time.monotonic()  # what it says is older than the loss
            return
        try:
            if wait_s:
                member.thread.wait(pending, wait_s)
            else:
                pending.result(0)
        except DeviceError as error:
            pause = _RETRY_S[min(member.failures, len(_RETRY_S) - 1)]
            member.failures += 1
            member.next_try = time.monotonic() + pause
            lost = isinstance(error, DeviceLost) or member.identity is None
            self._set(member, Health.LOST if lost else Health.FAULT, str(error))
        else:
            member.failures = 0
            self._set(member, Health.READY, "")

    def _set(self, member: _Member, health: Health, message: str) -> None:
        message = message.removeprefix(f"{member.device.name}: ")  # it is said beside the name
        if (member.health, member.message) == (health, message):
            return
        member.health, member.message = health, message
        say = log.info if health is Health.READY else log.warning
        say("device " + health, device=member.device.name, driver=member.driver, message=message)
        self._on_health(member.info())

    @property
    def alive(self) -> bool:
        """Whether every device thread has beaten recently (the watchdog's question)."""
        return all(m.thread.alive for m in self._members.values())

    # ------------------------------------------------------------ use and safety

    def take(self, owner: str) -> Session:
        """Begin a session: the one user of the devices. Raises UmbraError(busy, estopped)."""
        with self._lock:
            if self._latched:
                raise UmbraError(
                    Code.ESTOPPED, "an emergency stop is in force; `umbra reset` ends it"
                )
            if self._session is not None and not self._session.ended.is_set():
                raise UmbraError(Code.BUSY, f"the rig is in use: {self._session.owner}")
            self._session = Session(owner)
            return self._session

    def leave(self, session: Session) -> None:
        """End a session; the devices are tended again."""
        session.revoke()
        with self._lock:
            if self._session is session:
                self._session = None

    def latch(self) -> None:
        """From now on nobody gets the devices: an emergency stop. `make_safe` follows."""
        with self._lock:
            self._latched = True

    def unlatch(self) -> None:
        """The emergency stop is over."""
        with self._lock:
            self._latched = False

    def make_safe(self, *, halt: bool = True) -> list[Future[None]]:
        """Revoke the session and send every device to its safe state, from any thread, at once.

        With `halt` a blocked call is ended first, so that dark does not wait for a grab. Gives
        the futures of the devices' `safe()`; see `safe_within`.
        """
        with self._lock:
            if self._session is not None:
                self._session.revoke()
        if halt:
            for member in self._members.values():
                member.device.halt()
        # The projector first: light is what a person in front of it notices.
        members = sorted(self._members.values(), key=lambda m: m.device.kind != "projector")
        return [
            m.thread.submit(lambda d: d.safe(), SAFE_S)
            for m in members
            if m.identity is not None and not m.thread.ended  # closed: it was made safe before
        ]

    def safe_within(self, futures: list[Future[None]], seconds: float) -> bool:
        """Wait until all are safe; False, with the log saying who is not, after `seconds`."""
        deadline = time.monotonic() + seconds
        safe = True
        for future in futures:
            try:
                future.result(max(0.0, deadline - time.monotonic()))
            except (DeviceError, Revoked, TimeoutError) as error:
                safe = False
                log.error(  # noqa: TRY400 - the device's sentence says it all
                    "device not in its safe state", error=str(error) or "no answer in time"
                )
                if isinstance(error, DeviceError):
                    self.failed(error)
        return safe

    def close(self) -> None:
        """Safe state, then let go of every device. For shutdown only."""
        self.safe_within(self.make_safe(), SAFE_S)
        for member in self._members.values():
            member.thread.submit(lambda d: d.close(), SAFE_S)
        for member in self._members.values():
            if not member.thread.close(SAFE_S):
                log.error("device thread did not end", device=member.device.name)

    def snapshot(self) -> dict[str, Any]:
        """The rig as a run remembers it, JSON-able."""
        return {
            info.name: {
                "kind": info.kind,
                "driver": info.driver,
                "model": info.model,
                "serial": info.serial,
                "firmware": info.firmware,
                "facts": info.facts,
            }
            for info in self.devices()
        }
