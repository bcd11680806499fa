"""Whether an interrupted run can go on: only with what it began with, its devices and its sun."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from daemon.storage.frames import FrameRecord
from daemon.storage.runfolder import RunFolder
from drivers.clock import NS
from protocol.errors import Code, UmbraError
from protocol.scans.occluded import OccluderScan

SUN_DEG_PER_HOUR = 15.0


def require_same_devices(
    folder: RunFolder, before: Mapping[str, Any], now: Mapping[str, Any]
) -> None:
    """Compare the rig (`Rig.snapshot`) as it was and as it is. Raises UmbraError(unsuitable) for
    another device."""
    for name, device in now.items():
        then = before.get(name)
        if then is None or (then["model"], then["serial"]) != (device["model"], device["serial"]):
            raise UmbraError(
                Code.UNSUITABLE,
                f"{folder.id} cannot be resumed: its {name} was "
                f"{then and then['model']} {then and then['serial']}, "
                f"now it is {device['model']} {device['serial']}; scan again",
            )


def require_same_sun(folder: RunFolder, records: Sequence[FrameRecord], utc_ns: int) -> None:
    """A scan under the sun is not resumed when the sun has moved on since the last of its frames:
    shadows and shading have moved with it. Raises UmbraError(unsuitable)."""
    spec = folder.file.spec
    broke_off = max((record.utc for record in records), default="")
    if not isinstance(spec, OccluderScan) or not spec.sun or not broke_off:
        return
    away_s = utc_ns / NS - datetime.fromisoformat(broke_off).timestamp()
    moved_deg = away_s / 3600.0 * SUN_DEG_PER_HOUR
    if moved_deg > spec.drift_deg:
        raise UmbraError(
            Code.UNSUITABLE,
            f"{folder.id} cannot be resumed: the sun has gone {moved_deg:.1f} degrees since it "
            f"broke off, and {spec.drift_deg:g} are allowed (--drift-deg); scan again",
        )
