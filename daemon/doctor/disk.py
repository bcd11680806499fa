"""Whether the disk has room, and keeps up with the camera."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from daemon.doctor.verdict import failed, ok, skipped, warning
from protocol.messages.findings import Check

_PART = 4 << 20  # bytes written at a time
_MOST = 128 << 20  # bytes that are written at most ...
_SECONDS = 1.0  # ... and for how long
_FEW_FRAMES = 1000  # room for fewer is worth a warning
_MARGIN = 1.5  # times the camera's rate that a disk should manage


def space(free: int, reserve: int, frame_bytes: int | None) -> Check:
    """Bytes free and kept in reserve, in frames of the camera where it is known."""
    name = "disk: space"
    room = free - reserve
    told = f"{free / 1e9:.1f} GB free, {reserve / 1e9:.1f} GB of them in reserve"
    if room <= 0:
        return failed(
            name, f"{told}: a run would pause at once", "free some, or lower [storage] reserve_mb"
        )
    if frame_bytes is None:
        return ok(name, told)
    frames = room // frame_bytes
    told += f": room for {frames} frames"
    if frames < _FEW_FRAMES:
        return warning(name, told, "free some before a long scan")
    return ok(name, told)


def write_speed(folder: Path) -> float:
    """Bytes a second that reach the disk: fsync'd writes for a second. Raises OSError.

    The file has no name, so nothing can be left of it.
    """
    part = os.urandom(_PART)  # a file system that compresses must not cheat
    written = 0
    with tempfile.TemporaryFile(dir=folder) as file:
        begun = time.monotonic()
        while written < _MOST and time.monotonic() - begun < _SECONDS:
            file.write(part)
            file.flush()
            os.fsync(file.fileno())
            written += _PART
        return written / (time.monotonic() - begun)


def speed(folder: Path, frame_bytes: int | None, rate_hz: float) -> Check:
    """The disk's speed against the camera's fastest stream; see `write_speed`."""
    name = "disk: speed"
    try:
        measured = write_speed(folder)
    except OSError as error:
        return failed(
            name, f"{folder} cannot be written: {error.strerror}", "check [rig] data and its owner"
        )
    told = f"{measured / 1e6:.0f} MB/s"
    if frame_bytes is None or not rate_hz:
        return ok(name, f"{told}; the camera's rate is not known")
    needed = frame_bytes * rate_hz
    told += f"; the camera gives up to {needed / 1e6:.0f} MB/s ({rate_hz:.4g} Hz)"
    if measured < needed * _MARGIN:
        return warning(
            name,
            told,
            "video scans may lose frames (explicitly), stepped ones wait: a faster disk for "
            "[rig] data, a smaller roi, or a lower frame rate",
        )
    return ok(name, told)


def speed_unknown() -> Check:
    """While a run needs the disk."""
    return skipped("disk: speed", "a run is writing", "ask again when it has ended")
