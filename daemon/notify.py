"""What umbrad tells the service manager (sd_notify): ready, status, still alive, stopping.

A datagram to the socket named by NOTIFY_SOCKET; without one every call does nothing, so that the
daemon is the same on a terminal. Nothing is retried here: each call says whether its datagram was
taken, and a watchdog beat that was not is followed by the next.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping


class Notifier:
    """Speaks to the service manager, if there is one. Thread-safe: each call is one datagram.

    Every call gives True when the manager's socket took it, or when there is no manager to tell.
    It never blocks and never raises: a service manager that is ill must not stop a scan.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._watchdog_s = _watchdog_s(environ)

    def watchdog_interval(self) -> float | None:
        """Seconds within which the manager wants `watchdog()`; None: it does not watch us.

        Beat at half of it or faster.
        """
        return self._watchdog_s if self._address else None

    def ready(self, status: str = "") -> bool:
        """Start-up is over: commands are being answered."""
        return self._send("READY=1" + (f"\nSTATUS={_line(status)}" if status else ""))

    def status(self, text: str) -> bool:
        """One line for `systemctl status`."""
        return self._send(f"STATUS={_line(text)}")

    def watchdog(self) -> bool:
        """Alive; to be sent only while everything that must move has moved lately."""
        return self._send("WATCHDOG=1")

    def stopping(self) -> bool:
        """Shutdown has begun."""
        return self._send("STOPPING=1")

    def _send(self, message: str) -> bool:
        if not self._address:
            return True
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
            sock.setblocking(False)
            try:
                sock.sendto(message.encode(), self._address)
            except OSError:
                return False
        return True


def _line(text: str) -> str:
    return " ".join(text.split())


def _watchdog_s(environ: Mapping[str, str]) -> float | None:
    """WATCHDOG_USEC, unless WATCHDOG_PID says that it is meant for another process."""
    usec = environ.get("WATCHDOG_USEC", "")
    pid = environ.get("WATCHDOG_PID", "")
    if not usec.isdigit() or int(usec) == 0 or (pid and pid != str(os.getpid())):
        return None
    return int(usec) / 1e6
