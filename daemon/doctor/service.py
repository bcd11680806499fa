"""Whether somebody restarts umbrad when it hangs."""

from __future__ import annotations

from collections.abc import Mapping

from daemon.doctor.verdict import ok, skipped, warning
from protocol.messages.findings import Check


def watchdog(environ: Mapping[str, str], interval_s: float | None) -> Check:
    """systemd's watchdog; `interval_s` as the notifier understood it."""
    name = "watchdog"
    if interval_s is not None:
        return ok(name, f"systemd restarts umbrad after {interval_s:g} s without a beat")
    if not environ.get("NOTIFY_SOCKET"):
        return skipped(
            name,
            "umbrad was not started by systemd: nobody restarts it if it hangs",
            "for unattended work: docs/operators-guide.md, As a service",
        )
    return warning(
        name,
        "the unit has no watchdog: a hang is not noticed",
        "systemctl edit umbrad: [Service] WatchdogSec=30",
    )
