"""What people ask of a run while it goes on: pause, resume, end. Thread-safe."""

from __future__ import annotations

import threading
from collections.abc import Callable

from daemon.devices.devicethread import Revoked, Session
from protocol.messages.runs import End, RunState

_CHECK_S = 0.25  # how often a pause looks whether there is anything left to go on with


class Control:
    """Asked from the loop, obeyed by the sequencer between two steps.

    running <──> paused;  either ──end──> ended (the session is revoked by the rig's safe state)
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._go = threading.Event()
        self._go.set()
        self._reason = ""
        self._end: End | None = None
        self.news = threading.Event()
        """Set when whoever waits for something should look again: the end, a device's health."""

    def pause(self, reason: str) -> None:
        """Ask for a pause after the step under way; an end that was asked for comes first."""
        with self._lock:
            if self._end is None:
                self._reason = reason
                self._go.clear()

    def resume(self) -> None:
        """Go on."""
        self._go.set()

    def end(self, state: RunState, reason: str, *, code: str = "", by: str = "") -> None:
        """Say why the run must end; the first one to say so is remembered."""
        with self._lock:
            if self._end is None:
                self._end = End(state=state, reason=reason, code=code, by=by)
            self._go.set()
        self.news.set()

    @property
    def verdict(self) -> End | None:
        """Why the run must end, if it must."""
        return self._end

    @property
    def paused(self) -> bool:
        """Whether a pause was asked for."""
        return not self._go.is_set()

    def checkpoint(
        self, session: Session, on_pause: Callable[[str], None], check: Callable[[], None]
    ) -> bool:
        """Between two steps: stay here while paused; True if there was a pause. Raises Revoked.

        `on_pause` is called once, with the reason, before the wait; `check` now and then in it, to
        raise what leaves nothing to go on with.
        """
        self.check(session)
        if self._go.is_set():
            return False
        on_pause(self._reason)
        while not self._go.wait(_CHECK_S):
            session.check()
            check()
        self.check(session)
        return True

    def await_resume(self) -> bool:
        """Wait, in a thread that has no devices, until the pause is over; False: the run ends."""
        self._go.wait()
        return self._end is None

    def check(self, session: Session) -> None:
        """Raise Revoked when the run must end, also before its session has been revoked."""
        if self._end is not None:
            raise Revoked(session.owner)
        session.check()
