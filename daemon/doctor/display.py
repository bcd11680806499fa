"""The projector's refresh as it is, against what it says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from daemon.devices.devicethread import DeviceThread, Session
from daemon.doctor.verdict import failed, ok, skipped, warning
from drivers.base.errors import DeviceRefused
from drivers.base.projector import Projector
from drivers.clock import NS
from protocol.messages.findings import Check

FLIPS = 16
_SHOW_S = 5.0
_TOLERANCE = 0.03  # part of a period by which flips may be off


def check(projector: DeviceThread[Projector], session: Session) -> Check:
    """Flip, and judge. Raises DeviceError."""
    try:
        flips = measure(projector, session)
    except DeviceRefused as error:  # a sequencer with a fixed store of patterns
        return skipped("projector: refresh", f"it shows no free images: {error.problem}")
    return refresh(flips, projector.device.info().refresh_hz)


def measure(projector: DeviceThread[Projector], session: Session) -> list[int]:
    """When each of a row of flips happened, ns; black and a very dark grey. Raises DeviceError."""
    info = projector.device.info()
    images = [np.full((info.height, info.width), level, np.uint8) for level in (0, 8)]

    def flips(device: Projector) -> list[int]:
        return [device.show(images[n % 2]) for n in range(FLIPS)]

    return projector.call(flips, FLIPS * _SHOW_S, session)


def refresh(flips_ns: Sequence[int], stated_hz: float) -> Check:
    """The time between flips against the stated refresh."""
    name = "projector: refresh"
    apart = np.diff(np.asarray(flips_ns)) / NS * stated_hz  # in stated periods
    # a flip that the host missed comes a whole number of periods late: the rest shows the period
    whole = np.maximum(1, np.rint(apart))
    period = float(np.median(apart / whole))
    if abs(period - 1) > _TOLERANCE or float(np.median(apart)) < 1 - _TOLERANCE:
        measured = stated_hz / max(float(np.median(apart)), 1e-9)
        return failed(
            name,
            f"it flips {measured:.2f} times a second, and says {stated_hz:.2f} Hz",
            "set the output's mode, and vsync; a flip that does not wait for the display tears",
        )
    missed = int(np.sum(whole - 1))
    if missed > len(whole) // 4:
        return warning(
            name,
            f"{stated_hz / period:.2f} Hz, as it says, but {missed} refreshes passed unused in "
            f"{len(whole)} flips",
            "the machine is busy, or drawing is slow: scans are slower than they could be",
        )
    return ok(name, f"{stated_hz / period:.2f} Hz in {len(whole)} flips, as it says")
