"""What went wrong, as the protocol's errors: one place where exceptions get their codes."""

from __future__ import annotations

import errno

from daemon.devices.devicethread import Revoked
from daemon.scans.method import Unsuitable
from daemon.separation.estimator import NotYet
from drivers.base.errors import (
    DeviceError,
    DeviceGarbled,
    DeviceLost,
    DeviceRefused,
    DeviceTimeout,
    EndOfRecording,
    OutOfRange,
)
from protocol.errors import Code, UmbraError

_KINDS: tuple[tuple[type[DeviceError], Code], ...] = (
    (EndOfRecording, Code.BAD_INPUT),
    (OutOfRange, Code.UNSUITABLE),
    (DeviceLost, Code.DEVICE_LOST),
    (DeviceTimeout, Code.DEVICE_TIMEOUT),
    (DeviceRefused, Code.DEVICE_REFUSED),
    (DeviceGarbled, Code.DEVICE_GARBLED),
)


def as_error(error: BaseException) -> UmbraError:
    """Any exception as an error for the client; what nobody foresaw is `internal`."""
    if isinstance(error, UmbraError):
        return error
    if isinstance(error, DeviceError):
        code = next((c for kind, c in _KINDS if isinstance(error, kind)), Code.DEVICE_GARBLED)
        return UmbraError(code, str(error))
    if isinstance(error, Unsuitable | NotYet | Revoked):
        return _of_course(error)
    if isinstance(error, OSError):
        full = error.errno in {errno.ENOSPC, errno.EDQUOT}
        return UmbraError(
            Code.STORAGE_FULL if full else Code.STORAGE_FAILED,
            f"{error.filename or 'the data folder'}: {error.strerror or error}"
            + ("; free some space, then `umbra resume`" if full else ""),
        )
    return UmbraError(
        Code.INTERNAL, f"{type(error).__name__}: {error}; the daemon's log has the details"
    )


def _of_course(error: Unsuitable | NotYet | Revoked) -> UmbraError:
    """What may happen to any scan or command, and is nobody's fault."""
    match error:
        case Unsuitable():
            return UmbraError(Code.UNSUITABLE, str(error), error.where)
        case NotYet():
            return UmbraError(Code.NO_RESULT, str(error))
        case Revoked():
            return UmbraError(
                Code.BUSY, "the devices were taken away: by an abort, a stop, or a scan"
            )
