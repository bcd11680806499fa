"""What `umbra` exits with, so that scripts need not read sentences."""

from __future__ import annotations

import enum

from protocol.errors import Code


class Exit(enum.IntEnum):
    """Exit codes; docs/cli.md lists the same."""

    OK = 0
    FAILED = 1  # the run or a device failed, or something unforeseen
    USAGE = 2  # a bad option, bad input, or a scan or a number that this rig cannot do
    UNREACHABLE = 3  # no daemon there, or one of another version
    REFUSED = 4  # the daemon said no: wrong state, busy, locked, unknown run, forbidden
    ABORTED = 5  # the run was aborted
    INTERRUPTED = 130  # Ctrl-C; a run that was being watched goes on


_USAGE = {Code.BAD_REQUEST, Code.BAD_INPUT, Code.BAD_KEYS, Code.UNSUITABLE}
_UNREACHABLE = {Code.UNREACHABLE, Code.VERSION_MISMATCH}
_REFUSED = {
    Code.FORBIDDEN, Code.LOCKED, Code.BUSY, Code.UNKNOWN_RUN, Code.UNKNOWN_PRODUCT,
    Code.WRONG_STATE, Code.NO_RESULT, Code.ESTOPPED, Code.STOPPING, Code.DEVICE_MISSING,
}  # fmt: skip


def exit_of(code: Code) -> Exit:
    """The exit code that an error's code becomes."""
    if code in _USAGE:
        return Exit.USAGE
    if code in _UNREACHABLE:
        return Exit.UNREACHABLE
    return Exit.REFUSED if code in _REFUSED else Exit.FAILED
