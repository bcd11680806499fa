"""The four outcomes of a check; whoever says that something is wrong says what to do."""

from __future__ import annotations

from protocol.messages.findings import Check, Outcome


def ok(name: str, message: str) -> Check:
    """It is as it should be."""
    return Check(name=name, outcome=Outcome.OK, message=message)


def warning(name: str, message: str, remedy: str) -> Check:
    """Scans work, but not as well as they could."""
    return Check(name=name, outcome=Outcome.WARNING, message=message, remedy=remedy)


def failed(name: str, message: str, remedy: str) -> Check:
    """Scans fail, or lie."""
    return Check(name=name, outcome=Outcome.FAILED, message=message, remedy=remedy)


def skipped(name: str, message: str, remedy: str = "") -> Check:
    """It could not be looked at."""
    return Check(name=name, outcome=Outcome.SKIPPED, message=message, remedy=remedy)
