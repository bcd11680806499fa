"""What must be so before a run's first frame: looked at in order, and waited for until a deadline.

    look ──all is so──> ready
     ^  └──something is not──> waiting ──> not ready (the deadline has passed)
     └──── a device's health changed, or it is time to look again

A check raises what stands against the run. What may mend itself is waited for: a device that is
away, no room on the disk, the wrong light; or somebody may mend it: a stage in alarm. What will not
(a device that refuses, a scan that does not fit the rig) ends the run at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import structlog

from daemon.devices.devicethread import Session
from daemon.exposing.control import Control
from daemon.runs.failures import as_error
from daemon.separation.metering import Level
from drivers.base.errors import DeviceError
from drivers.clock import NS, Clock
from protocol.errors import Code, UmbraError
from protocol.messages.runs import Waiting
from protocol.scans.spec import Ready

_MENDS = {
    Code.DEVICE_LOST,
    Code.DEVICE_TIMEOUT,
    Code.DEVICE_GARBLED,
    Code.STORAGE_FULL,
    Code.NOT_READY,
}
_STEADY_LOOKS = 3  # that must agree for light to be steady

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Precondition:
    """`check` raises UmbraError or DeviceError while it is not so; `what` is a name for people.

    `mended`: what a device refuses is waited for too, for somebody may mend it meanwhile.
    """

    what: str
    check: Callable[[], None]
    mended: bool = False


class Preconditions:
    """The wait of one run, in the thread that calls `wait`."""

    def __init__(
        self,
        wanted: Ready,
        conditions: Sequence[Precondition],
        *,
        clock: Clock,
        control: Control,
        session: Session,
        on_wait: Callable[[Waiting], None],
        on_failure: Callable[[DeviceError], None],
    ) -> None:
        """`on_wait` is told after each look what is waited for, `on_failure` of a device that
        failed in one."""
        self._wanted = wanted
        self._conditions = conditions
        self._clock = clock
        self._control = control
        self._session = session
        self._on_wait = on_wait
        self._on_failure = on_failure
        self._been: set[str] = set()  # what has been so at least once

    def wait(self) -> float:
        """Come back, with the seconds that it took, when everything is so.

        Raises UmbraError(not_ready) at the deadline, what a check raised where nothing is waited
        for, Revoked when the run is ended meanwhile.
        """
        began = self._clock.now_ns()
        deadline = began + round(self._wanted.deadline_s * NS)
        waiting: Waiting | None = None
        while True:
            self._control.news.clear()  # what comes from here on is a reason to look again
            self._control.check(self._session)
            unmet = self._unmet()
            now = self._clock.now_ns()
            if unmet is None:
                return (now - began) / NS
            what, error = unmet
            if not self._wanted.deadline_s:
                raise error
            if now >= deadline:
                raise UmbraError(Code.NOT_READY, self._too_late(what, error)) from error
            waiting = self._waiting(what, as_error(error).message, deadline - now, waiting)
            self._on_wait(waiting)
            again = now + round(self._wanted.look_s * NS)
            self._clock.wait_until(min(again, deadline), self._control.news)

    def _unmet(self) -> tuple[str, UmbraError | DeviceError] | None:
        """The first that is not so, and what was seen of it."""
        for condition in self._conditions:
            try:
                condition.check()
            except (UmbraError, DeviceError) as error:
                self._control.check(self._session)  # a device that was halted is no failure
                if isinstance(error, DeviceError):
                    self._on_failure(error)
                code = as_error(error).code
                if code not in _MENDS and not (condition.mended and code is Code.DEVICE_REFUSED):
                    raise
                return condition.what, error
            self._been.add(condition.what)
        return None

    def _waiting(self, what: str, seen: str, left_ns: int, before: Waiting | None) -> Waiting:
        if before is not None and before.what == what:
            return Waiting(what=what, seen=seen, since=before.since, until=before.until)
        log.info("waiting", what=what, seen=seen)
        now = self._clock.utc_ns()
        until = before.until if before is not None else _iso(now + left_ns)
        return Waiting(what=what, seen=seen, since=_iso(now), until=until)

    def _too_late(self, what: str, error: UmbraError | DeviceError) -> str:
        never = "had been so, and was no longer" if what in self._been else "never was so"
        return (
            f"not ready within {self._wanted.deadline_s:g} s: {what} {never}; "
            f"at the last look: {as_error(error).message}"
        )


class LightWatch:
    """Looks at the light, at most once in `look_s`, and judges what it saw."""

    def __init__(self, wanted: Ready, look: Callable[[], Level], clock: Clock) -> None:
        """`look` takes a picture; see `daemon.separation.metering`."""
        self._wanted = wanted
        self._look = look
        self._clock = clock
        self._due = clock.now_ns()
        self._seen: deque[Level] = deque(maxlen=_STEADY_LOOKS)

    def conditions(self) -> list[Precondition]:
        """The conditions on light that the scan asks for."""
        wanted = self._wanted
        found = []
        if wanted.light_min is not None or wanted.light_max is not None:
            found.append(Precondition("light", self._bounded))
        if wanted.steady is not None:
            found.append(Precondition("steadiness", self._steady))
        return found

    def _last(self) -> Level:
        now = self._clock.now_ns()
        if not self._seen or now >= self._due:
            self._due = now + round(self._wanted.look_s * NS)
            self._seen.append(self._look())
        return self._seen[-1]

    def _bounded(self) -> None:
        level, wanted = self._last(), self._wanted
        seen = "saturated" if level.clipped else f"at {level.share:.1%} of full scale"
        if wanted.light_min is not None and level.share < wanted.light_min:
            self._refuse(f"the light is {seen}, and at least {wanted.light_min:.1%} are wanted")
        if wanted.light_max is not None and (level.clipped or level.share > wanted.light_max):
            self._refuse(f"the light is {seen}, and at most {wanted.light_max:.1%} are wanted")

    def _steady(self) -> None:
        self._last()
        wanted, seen = self._wanted.steady, self._seen
        assert wanted is not None
        if any(level.clipped for level in seen):
            self._refuse("the light is saturated: nothing can be said of its steadiness")
        light = [max(level.light, 1e-12) for level in seen]
        change = max(light) / min(light) - 1.0
        if len(seen) < _STEADY_LOOKS or change > wanted:
            self._refuse(
                f"the light of the last {len(seen)} looks differs by {change:.1%}, and no more "
                f"than {wanted:.1%} in {_STEADY_LOOKS} are wanted"
            )

    @staticmethod
    def _refuse(message: str) -> None:
        raise UmbraError(Code.NOT_READY, message)


def _iso(utc_ns: int) -> str:
    return datetime.fromtimestamp(utc_ns / NS, UTC).isoformat(timespec="seconds")
