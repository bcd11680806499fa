"""One thread a device: it alone makes that device's calls, and a call that hangs is noticed.

Work is handed over with `submit` or `call`, each with a deadline in real seconds. A `Session`
stands for the right to use the devices: once it is revoked, its calls that have not begun are
refused, so that nothing it asked for can happen after the safe state that follows a revocation.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from concurrent.futures import TimeoutError as FutureTimeout
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import structlog

from drivers.base.device import Device
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceTimeout

D = TypeVar("D", bound=Device)
T = TypeVar("T")

_IDLE_BEAT_S = 0.25  # how often an idle thread shows life
_HALT_GRACE_S = 1.0  # for a call to come back after a halt; then it is stuck
_HALT_AGAIN_S = 0.25  # how often a wait looks whether its session has ended

log = structlog.get_logger(__name__)


class Revoked(Exception):
    """The session's right to the devices has ended: abort, e-stop, or a lost lock."""


class Stuck(DeviceTimeout):
    """A call into a driver does not come back, even halted: its thread is not to be had."""


class Session:
    """The right to use the rig's devices, of one run or one person, until it is revoked."""

    def __init__(self, owner: str) -> None:
        self.owner = owner
        self.ended = threading.Event()

    def revoke(self) -> None:
        """End it, from any thread; what has not begun will not begin."""
        self.ended.set()

    def check(self) -> None:
        """Raise Revoked if it has ended."""
        if self.ended.is_set():
            raise Revoked(self.owner)


@dataclass(slots=True)
class _Task:
    act: Callable[[Any], Any]
    deadline_s: float
    session: Session | None
    future: Future[Any]


def _broken(device: str, error: BaseException) -> DeviceError:
    """An exception that a driver should not have raised, as one that the daemon understands."""
    broken = DeviceGarbled(
        device, "call", f"the driver broke: {type(error).__name__}: {error}",
        "umbrad's log has the traceback",
    )  # fmt: skip
    broken.__cause__ = error
    return broken


class DeviceThread(Generic[D]):
    """A device with its thread.

    `call` may be used from any thread but this one; the device itself is touched by nobody else,
    save `halt()`.
    """

    def __init__(self, device: D) -> None:
        self.device = device
        self._tasks: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._beat = time.monotonic()
        self._closed = False
        self._due: float | None = None  # when the call under way must have come back
        self._switching = threading.Lock()
        self._session: Session | None = None  # of the call under way
        self._thread = threading.Thread(target=self._run, name=f"umbra-{device.name}", daemon=True)
        self._thread.start()

    def submit(
        self, act: Callable[[D], T], deadline_s: float, session: Session | None = None
    ) -> Future[T]:
        """Queue a call; its future raises DeviceError, or Revoked when the session ended first."""
        future: Future[T] = Future()
        self._tasks.put(_Task(act, deadline_s, session, future))
        return future

    def call(self, act: Callable[[D], T], deadline_s: float, session: Session | None = None) -> T:
        """Make a call and wait for it. Raises DeviceError; Stuck if it never came back.

        The call was sent; after a time-out it is not known whether the device acted.
        """
        return self.wait(self.submit(act, deadline_s, session), deadline_s)

    def wait(self, future: Future[T], deadline_s: float) -> T:
        """Wait for a submitted call as `call` does. A call that is late is halted first."""
        deadline = time.monotonic() + deadline_s
        while (left := deadline - time.monotonic()) > 0:
            if wait([future], min(left, _HALT_AGAIN_S)).done:
                return future.result()
            self.halt_revoked()
        if not future.done():
            self.device.halt()
        try:
            return future.result(_HALT_GRACE_S)
        except FutureTimeout:
            raise Stuck(
                self.device.name,
                "call",
                f"the driver has not come back in {deadline_s:.3g} s",
                "check the device's cable and power; umbrad restarts if it stays stuck",
            ) from None

    def halt_revoked(self) -> None:
        """Halt the call under way if its session has ended: the halt that came with the end is
        lost where it came between the driver's last look and the call's beginning. For whoever
        waits for a call; the safe state that follows it is not disturbed."""
        with self._switching:
            if self._session is not None and self._session.ended.is_set():
                self.device.halt()

    @property
    def stuck(self) -> bool:
        """Whether a call is long overdue."""
        due = self._due
        return due is not None and time.monotonic() > due + _HALT_GRACE_S

    @property
    def alive(self) -> bool:
        """Whether the thread has shown life lately, or is within a call's deadline."""
        late = time.monotonic() - self._beat
        return (
            self._thread.is_alive()
            and not self.stuck
            and (self._due is not None or late < 20 * _IDLE_BEAT_S)
        )

    @property
    def ended(self) -> bool:
        """Whether it was closed: nothing that is submitted will be done."""
        return self._closed

    def close(self, deadline_s: float) -> bool:
        """End the thread after what is queued; False when it does not come back in time."""
        self._closed = True
        self._tasks.put(None)
        self._thread.join(deadline_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            self._beat = time.monotonic()
            try:
                task = self._tasks.get(timeout=_IDLE_BEAT_S)
            except queue.Empty:
                continue
            if task is None:
                return
            self._due = time.monotonic() + task.deadline_s
            with self._switching:
                self._session = task.session
            try:
                if task.session is not None:
                    task.session.check()
                task.future.set_result(task.act(self.device))
            except (DeviceError, Revoked) as error:
                task.future.set_exception(error)
            except BaseException as error:  # whatever a vendor's library raises
                log.exception("a driver broke", device=self.device.name)
                task.future.set_exception(_broken(self.device.name, error))
            finally:
                with self._switching:
                    self._session = None
                self._due = None
                del task  # a frame's buffer must not outlive its call here
