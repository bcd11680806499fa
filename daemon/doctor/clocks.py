"""The clocks that frames are stamped with: UTC against the monotonic one, and its source."""

from __future__ import annotations

import ctypes
import os
import time
from pathlib import Path

from daemon.doctor.verdict import ok, skipped, warning
from drivers.clock import NS, Clock, ScaledClock
from protocol.messages.findings import Check

STEP_S = 0.1
"""More than a synchronised clock is slewed by in weeks of uptime is a step."""
TIMESYNC = Path("/run/systemd/timesync/synchronized")
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised
_TIMEX_BYTES = 512  # more than struct timex has on any architecture; modes = 0 only reads


def step(clock: Clock) -> Check:
    """Frames carry UTC by an offset that was fixed when umbrad started: has UTC moved since?"""
    name = "clock: UTC"
    if isinstance(clock, ScaledClock):
        return skipped(name, f"the virtual rig's clock runs {clock.speed:g} times as fast")
    moved_s = (time.time_ns() - clock.utc_ns()) / NS
    if abs(moved_s) > STEP_S:
        return warning(
            name,
            f"UTC has moved by {moved_s:+.3f} s since umbrad started; frames carry the old one",
            "restart umbrad between two runs",
        )
    return ok(name, f"within {abs(moved_s) * 1e3:.1f} ms of the one that umbrad started with")


def synchronised() -> Check:
    """Whether the machine's clock follows a time server, as the kernel says."""
    name = "clock: NTP"
    libc = ctypes.CDLL(None, use_errno=True)
    state = int(libc.adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)))
    if state == -1:
        if TIMESYNC.exists():  # the unit's ProtectClock= forbids to ask the kernel
            return ok(name, "synchronised (systemd-timesyncd)")
        reason = os.strerror(ctypes.get_errno())
        return skipped(name, f"the kernel does not tell: {reason}", "timedatectl tells")
    if state == _TIME_ERROR:
        return warning(
            name,
            "the machine's clock is not synchronised: times of runs are as good as its crystal",
            "timedatectl set-ntp true, or chrony",
        )
    return ok(name, "synchronised")
