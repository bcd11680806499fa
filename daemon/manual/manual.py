"""Work by hand: show a pattern, take a frame, set the camera, hold the rig for oneself.

Manual work and scans exclude each other through the rig's session. A pattern that is shown has a
lease, a lock has a heartbeat; when either is over, the rig goes to its safe state.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace

import structlog

from daemon.devices.devicethread import Session
from daemon.devices.lightmeter import limits_of
from daemon.devices.rig import SAFE_S, Rig
from daemon.devices.snapshot import snap, snap_whole
from daemon.exposing.apparatus import CALL_S, SHOW_S
from daemon.manual.live import Live
from daemon.manual.manualstage import ManualStage
from daemon.patterns import render
from daemon.pictures.viewfinder import Viewfinder
from daemon.scans.method import Bench
from daemon.scans.single_image import SingleImageMethod
from daemon.separation.exposure import LONGEST_US
from daemon.separation.metering import Exposure, Level, choose, level_of
from daemon.separation.radiometry import Response
from drivers.base.camera import Camera, CameraInfo, CameraSettings, Frame
from protocol.errors import Code, UmbraError
from protocol.messages.events import AnyEvent
from protocol.messages.rig import LockInfo
from protocol.patterns import AnyPattern, Stripes
from protocol.scans.projected import SingleImage

_LIGHT_S = 600.0
"""How long a light that was switched on by hand stays on when nobody asks again."""
_OFF_S = 2.0
"""How long manual work goes on after one was switched off."""
OWNER = "manual work"

log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Lock:
    token: str
    owner: str
    note: str
    lease_s: float
    until: float


class Manual:
    """What people do without a scan. Device calls block: never call them from the loop."""

    def __init__(
        self,
        rig: Rig,
        viewfinder: Viewfinder,
        on_change: Callable[[], None],
        publish: Callable[[AnyEvent], None],
    ) -> None:
        """`on_change` and `publish` must be safe to call from any thread."""
        self._rig = rig
        self.stage = ManualStage(rig, self.use, self._keep, self._lasting, publish)
        self.live = Live(rig, viewfinder, self.use)
        self._viewfinder = viewfinder
        self._on_change = on_change
        self._mutex = threading.RLock()
        self._session: Session | None = None
        self._lock: _Lock | None = None
        self._dark_at = 0.0
        self._acts = 0  # under way; they last as long as they last, whatever the lease
        self._for_acts = False  # manual work was begun for them: nobody wants it to go on

    # ------------------------------------------------------------ the lock

    def lock(self, owner: str, note: str, lease_s: float) -> str:
        """Hold the rig; gives the token. Raises UmbraError(locked) naming the holder."""
        with self._mutex:
            self.admit("")
            self._lock = _Lock(
                secrets.token_hex(8), owner, note, lease_s, time.monotonic() + lease_s
            )
            self._on_change()
            return self._lock.token

    def renew(self, token: str) -> float:
        """The lock's heartbeat; gives its lease. Raises UmbraError(locked) when it was lost."""
        with self._mutex:
            if self._lock is None or self._lock.token != token:
                raise UmbraError(
                    Code.LOCKED, "the lock was lost: it was not renewed in time, or broken"
                )
            self._lock.until = time.monotonic() + self._lock.lease_s
            return self._lock.lease_s

    def unlock(self, token: str, *, force: bool) -> None:
        """Give the rig back. Raises UmbraError(locked) for another's lock without `force`."""
        with self._mutex:
            if self._lock is None:
                return
            if not force:
                self.admit(token)
            self._lock = None
        self.end()
        self._on_change()

    def admit(self, token: str) -> None:
        """Raise UmbraError(locked) unless nobody, or this token, holds the rig."""
        with self._mutex:
            held = self._lock
            if held is not None and held.token != token:
                note = f" ({held.note})" if held.note else ""
                raise UmbraError(
                    Code.LOCKED,
                    f"the rig is held by {held.owner}{note}; wait, or `unlock` it with force",
                )

    def lock_info(self) -> LockInfo | None:
        """Who holds the rig."""
        with self._mutex:
            held = self._lock
            if held is None:
                return None
            return LockInfo(
                owner=held.owner,
                note=held.note,
                remaining_s=max(0.0, held.until - time.monotonic()),
            )

    # ------------------------------------------------------------ the lease

    @property
    def active(self) -> bool:
        """Whether something may be shown by hand just now."""
        session = self._session
        return session is not None and not session.ended.is_set()

    def tend(self) -> None:
        """Call now and then: end what nobody renewed. Never blocks."""
        now = time.monotonic()
        with self._mutex:
            if self._session is not None and self._session.ended.is_set():
                self._rig.leave(self._session)  # an emergency stop took it
                self._session = None
                self._on_change()
            if self._lock is not None and now >= self._lock.until:
                log.warning("lock lost its heartbeat: safe state", owner=self._lock.owner)
                self._lock = None
                self._end()
                self._on_change()
            elif self.active and now >= self._dark_at and self._lock is None and not self._acts:
                log.info("manual work ended: nobody asked again")
                self._end()
                self._on_change()

    def end(self) -> None:
        """End manual work and wait for the safe state."""
        with self._mutex:
            futures = self._end()
        self._rig.safe_within(futures, SAFE_S)
        self._on_change()

    def make_way(self) -> None:
        """Before a scan: end manual work, and wait for the safe state."""
        self.stage.finish()
        if self.active:
            self.end()

    def _end(self) -> list[Future[None]]:
        session, self._session = self._session, None
        if session is None or session.ended.is_set():
            return []
        futures = self._rig.make_safe()
        self._rig.leave(session)
        return futures

    def use(self, lease_s: float) -> Session:
        """Begin manual work, or join it, for at least `lease_s`. Raises UmbraError(busy)."""
        with self._mutex:
            if not self.active:
                self._session = self._rig.take(OWNER)
                self._on_change()
            assert self._session is not None
            self._for_acts = False
            self._dark_at = max(self._dark_at, time.monotonic() + lease_s)
            return self._session

    def _keep(self, session: Session, lease_s: float) -> None:
        """Prolong manual work, unless it has ended."""
        with self._mutex:
            if self._session is session:
                self._dark_at = max(self._dark_at, time.monotonic() + lease_s)

    # ------------------------------------------------------------ acts

    @contextlib.contextmanager
    def _lasting(self) -> Iterator[None]:
        """Something that lasts as long as it lasts, whatever the lease."""
        with self._mutex:
            self._acts += 1
        try:
            yield
        finally:
            with self._mutex:
                self._acts -= 1

    @contextlib.contextmanager
    def _act(self) -> Iterator[Session]:
        """Something that is over when it is done: then the rig is as safe as before, unless another
        act is under way or somebody wants manual work to go on. Raises UmbraError(busy)."""
        with self._mutex:
            if not self.active:
                self.use(0.0)
                self._for_acts = True
            session = self._session
            assert session is not None
            self._acts += 1
        try:
            with self._rig.noticing():
                yield session
        finally:
            with self._mutex:
                self._acts -= 1
                over = self._for_acts and not self._acts and self._session is session
                futures = self._end() if over else []
            if over:
                self._rig.safe_within(futures, SAFE_S)
                self._on_change()

    def show(self, pattern: AnyPattern, lease_s: float) -> None:
        """Show a pattern until the lease is over. Raises UmbraError, DeviceError."""
        projector = self._rig.projector
        if projector is None:
            raise UmbraError(
                Code.DEVICE_MISSING, "this rig has no projector: add [projector] to rig.toml"
            )
        with self._mutex:
            self._dark_at = 0.0
            session = self.use(lease_s)
        info = projector.device.info()
        image = render(pattern, info.width, info.height)
        with self._rig.noticing():
            projector.call(lambda p: p.show(image), SHOW_S, session)

    def look(
        self, rate_hz: float, lease_s: float, separate: SingleImage | None, bench: Bench | None
    ) -> None:
        """Look through the camera live; with `separate` under its stripes, which are shown.

        Raises UmbraError, DeviceError, Unsuitable.
        """
        method = None
        if separate is not None and bench is not None:
            method = SingleImageMethod(separate, bench)
            if not self.live.separating:
                stripes = Stripes(width=separate.stripe, axis=separate.axis)
                self.show(stripes, lease_s)
        self.live.start(rate_hz, lease_s, method)

    def light(self, name: str, on: bool) -> None:
        """Switch a light by hand. Raises UmbraError(device_missing), DeviceError."""
        thread = self._rig.lights.get(name)
        if thread is None:
            known = ", ".join(self._rig.lights) or "none"
            raise UmbraError(Code.DEVICE_MISSING, f"no light {name!r}: this rig has {known}")
        session = self.use(_LIGHT_S if on else _OFF_S)
        with self._rig.noticing():
            thread.call(lambda light: light.set(on), CALL_S, session)

    def snap(self) -> tuple[Frame, CameraInfo]:
        """Take one frame as things are. Raises UmbraError, DeviceError."""
        with self._act() as session, self.live.aside():
            frame, info = snap(self._rig.camera, session, self._rig.clock)
        self._viewfinder.offer(frame, info, now=True)
        return frame, info

    def expose(self, wanted: CameraSettings, response: Response) -> Exposure:
        """Choose the exposure for the scene as it is lit now; that of `wanted` is the longest, the
        rest is set. See `daemon.separation.metering.choose`. Raises UmbraError, DeviceError."""
        camera = self._rig.camera
        start = camera.device.settings().exposure_us or LONGEST_US / 100

        with self._act() as session, self.live.aside():

            def look(exposure_us: float) -> Level:
                settings = replace(wanted, exposure_us=exposure_us)
                frame, info = snap_whole(camera, session, self._rig.clock, settings)
                self._viewfinder.offer(frame, info, now=True)
                return level_of(frame.pixels, response, frame.exposure_us or exposure_us)

            return choose(look, start, limits_of(self._rig, wanted.exposure_us))

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """Change camera settings; gives those in force. Raises UmbraError, DeviceError."""
        camera = self._rig.camera
        if wanted == CameraSettings():
            return camera.device.settings()

        def set_camera(device: Camera) -> CameraSettings:
            device.stop()  # a live view may have left it acquiring
            return device.configure(wanted)

        with self._act() as session, self.live.aside():
            return camera.call(set_camera, CALL_S, session)
