"""The devices as the rig knows them: health, and firmware against the newest run's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from daemon.doctor.verdict import failed, ok, warning
from protocol.messages.findings import Check
from protocol.messages.rig import DeviceInfo, Health

_REMEDIES = {
    Health.LOST: "check cable and power; it is tried again by itself",
    Health.FAULT: "see its message; `umbra log` has more",
    Health.STUCK: "power-cycle it; the watchdog restarts umbrad if it stays stuck",
}


def health(devices: Iterable[DeviceInfo]) -> list[Check]:
    """A check for each device."""
    checks = []
    for device in devices:
        name = f"device: {device.name}"
        if device.health is Health.READY:
            serial = f", serial {device.serial}" if device.serial else ""
            checks.append(ok(name, f"{device.model or device.driver}{serial}"))
        else:
            said = device.message or device.driver
            checks.append(failed(name, f"{device.health}: {said}", _REMEDIES[device.health]))
    return checks


def firmware(devices: Iterable[DeviceInfo], before: Mapping[str, Any], run: str) -> list[Check]:
    """Whether a device answers with another firmware than in the newest run.

    `before`: that run's rig snapshot by device name; another device of the same name says nothing.
    """
    checks = []
    for device in devices:
        if not device.firmware:
            continue
        name = f"firmware: {device.name}"
        was = before.get(device.name, {})
        same = (was.get("model"), was.get("serial")) == (device.model, device.serial)
        if same and was.get("firmware") != device.firmware:
            checks.append(
                warning(
                    name,
                    f"{device.firmware}; in {run} it was {was.get('firmware') or 'unknown'}",
                    "calibrate again: an update may change timing, gain and limits",
                )
            )
        else:
            checks.append(ok(name, device.firmware))
    return checks
