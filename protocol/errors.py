"""Errors are data: a stable code, a sentence that says what to do, and where."""

from __future__ import annotations

import enum

import msgspec


class Code(enum.StrEnum):
    """Every way in which the daemon can say no. Codes are stable; messages are for people."""

    BAD_REQUEST = "bad_request"  # the header does not parse, or a field is unknown or out of range
    VERSION_MISMATCH = "version_mismatch"  # client and daemon speak different protocols
    FORBIDDEN = "forbidden"  # an observer's key asked for an operator's command
    LOCKED = "locked"  # someone else holds the rig
    BUSY = "busy"  # a run is using the devices
    UNKNOWN_RUN = "unknown_run"
    UNKNOWN_PRODUCT = "unknown_product"
    WRONG_STATE = "wrong_state"  # e.g. resume of a run that is done
    NO_RESULT = "no_result"  # no frame has been separated yet
    UNSUITABLE = "unsuitable"  # the rig lacks what is asked for, or the numbers don't fit it
    NOT_READY = "not_ready"  # what a run waited for before its first frame did not come in time
    ESTOPPED = "estopped"  # an emergency stop is in force until it is reset
    DEVICE_MISSING = "device_missing"  # the rig has no such device
    DEVICE_LOST = "device_lost"
    DEVICE_TIMEOUT = "device_timeout"
    DEVICE_REFUSED = "device_refused"
    DEVICE_GARBLED = "device_garbled"
    BAD_INPUT = "bad_input"  # recorded images that cannot be used
    FRAMES_MISSING = "frames_missing"  # a step could not be exposed, repeats included
    STORAGE_FULL = "storage_full"
    STORAGE_FAILED = "storage_failed"
    STOPPING = "stopping"  # the daemon is shutting down
    UNREACHABLE = "unreachable"  # made by the client: no answer from the daemon
    BAD_KEYS = "bad_keys"  # a CURVE key file is missing, malformed, or readable by others
    INTERNAL = "internal"  # a bug; the daemon's log has the traceback


class ErrorInfo(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An error as it travels: ``where`` is the path of the offending field, if there is one."""

    code: Code
    message: str
    where: str = ""


class UmbraError(Exception):
    """An error that a person can act upon; raised by the client and by the daemon's commands."""

    def __init__(self, code: Code, message: str, where: str = "") -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.where = where

    def __str__(self) -> str:
        """The message, after the field that it is about: "spec.checker: Expected `int` >= 1"."""
        field = self.where.removeprefix("$").removeprefix(".").removeprefix("command.")
        return f"{field}: {self.message}" if field else self.message

    @property
    def info(self) -> ErrorInfo:
        """The same error as it travels."""
        return ErrorInfo(code=self.code, message=self.message, where=self.where)
