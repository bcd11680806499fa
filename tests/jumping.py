"""A clock for tests that jumps to whatever is waited for."""

from __future__ import annotations

import threading

from drivers.clock import NS, Clock


class Jumping(Clock):
    """Time that passes only while somebody waits: exact, for one thread."""

    def __init__(self) -> None:
        self.now = NS

    def now_ns(self) -> int:
        return self.now

    def utc_ns(self) -> int:
        return self.now + 1_700_000_000 * NS

    def wait_until(self, deadline_ns: int, wake: threading.Event | None = None) -> bool:
        if wake is not None and wake.is_set():
            return True
        self.now = max(self.now, deadline_ns)
        return False
