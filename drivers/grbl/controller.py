"""What is at the end of the line: firmware, label, buffer, travel and speeds, as it says itself.

Grbl and grblHAL list their settings by number (``$$``); FluidNC keeps its axes in config.yaml and
tells one item at a time. Everything here is asked with the stage at rest, and changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.base.errors import DeviceRefused
from drivers.grbl import protocol as grbl
from drivers.grbl.faults import Firmware
from drivers.grbl.link import REPLY_S, GrblLink

Range = tuple[float, float]

MOST_RX = 256  # bytes in flight: more would only make a stop forget more
OLDEST = (1, 1)


@dataclass(frozen=True, slots=True)
class Controller:
    """One controller. Lengths in mm, machine coordinates; None, 0: it does not tell."""

    firmware: Firmware
    version: str = ""
    label: str = ""
    rx_bytes: int = 127
    travel: tuple[Range | None, Range | None] = (None, None)
    feed_mm_s: float = 0.0  # the slower axis's
    acceleration_mm_s2: float = 0.0
    inches: bool = False  # in its reports
    homing: bool = False
    soft_limits: bool = False
    hard_limits: bool = False


NOBODY = Controller(Firmware.GRBL)


def ask(link: GrblLink, phase: str, *, identity: str) -> Controller:
    """Find out what has answered; `identity` must be in what it says of itself.

    Raises DeviceRefused: too old, or another controller; DeviceTimeout, DeviceLost.
    """
    banner, device = link.banner, link.port.device
    assert banner is not None
    if banner.version < OLDEST:
        raise DeviceRefused(
            device, phase, f"its firmware is {banner.text[:40]!r}", "install Grbl 1.1"
        )
    said = link.command("$I", REPLY_S, phase)
    build = grbl.parse_build(said)
    if build.firmware is not None:
        link.firmware = build.firmware
    # Grbl keeps its label in capitals, whatever was sent
    if identity and not any(identity.lower() in text.lower() for text in said):
        raise DeviceRefused(
            device,
            phase,
            f"the controller at {link.port.path} is {build.label or 'unnamed'!r}, not {identity!r}",
            f"correct `port`, or name the controller once with $I={identity}",
        )
    settings = grbl.parse_settings(link.command("$$", REPLY_S, phase))
    if link.firmware is Firmware.FLUIDNC and 130 not in settings:
        return _from_items(link, phase, build, inches=bool(settings.get(13)))
    return _from_settings(link.firmware, build, settings, banner.text)


def _from_settings(
    firmware: Firmware, build: grbl.Build, settings: dict[int, float], banner: str
) -> Controller:
    return Controller(
        firmware,
        build.version or banner,
        build.label,
        _rx(build),
        (_travel(settings, build, 0), _travel(settings, build, 1)),
        min((settings[n] / 60 for n in (110, 111) if settings.get(n, 0) > 0), default=0.0),
        min((settings[n] for n in (120, 121) if n in settings), default=0.0),
        inches=bool(settings.get(13)),
        homing=bool(settings.get(22)),
        soft_limits=bool(settings.get(20)),
        hard_limits=bool(settings.get(21)),
    )


def _rx(build: grbl.Build) -> int:
    return min(build.rx_bytes, MOST_RX) - 1


def _travel(settings: dict[int, float], build: grbl.Build, axis: int) -> Range | None:
    """Least and greatest machine position of an axis, from $130 and $131.

    Grbl homes to 0 at one end, and counts down from there wherever the switch is ($23), unless it
    was built to set the origin at the switch (Z in $I; grblHAL: bit 3 of $22).
    """
    length = settings.get(130 + axis)
    if not length:
        return None
    homes_low = int(settings.get(23, 0)) >> axis & 1
    sets_origin = "Z" in build.options or int(settings.get(22, 0)) & 8
    low = 0.0 if sets_origin and homes_low else -length
    return low, low + length


def _from_items(link: GrblLink, phase: str, build: grbl.Build, *, inches: bool) -> Controller:
    """FluidNC's axes, item by item; one that its configuration lacks is not told."""
    rates, accelerations, travels = [], [], []
    homing = soft = hard = True
    for axis in "xy":
        most, acceleration, length = (
            _number(link, phase, f"/axes/{axis}/{item}")
            for item in ("max_rate_mm_per_min", "acceleration_mm_per_sec2", "max_travel_mm")
        )
        cycle = _number(link, phase, f"/axes/{axis}/homing/cycle")
        origin = _number(link, phase, f"/axes/{axis}/homing/mpos_mm") or 0.0
        upwards = _item(link, phase, f"/axes/{axis}/homing/positive_direction") != "false"
        rates += [most / 60] if most else []
        accelerations += [acceleration] if acceleration else []
        low = origin - length if length and upwards else origin
        travels.append((low, low + length) if length else None)
        homing &= cycle is not None and cycle > 0
        soft &= _item(link, phase, f"/axes/{axis}/soft_limits") == "true"
        hard &= _item(link, phase, f"/axes/{axis}/motor0/hard_limits") == "true"
    return Controller(
        Firmware.FLUIDNC,
        build.version,
        build.label,
        _rx(build),
        (travels[0], travels[1]),
        min(rates, default=0.0),
        min(accelerations, default=0.0),
        inches=inches,
        homing=homing,
        soft_limits=soft,
        hard_limits=hard,
    )


def _number(link: GrblLink, phase: str, path: str) -> float | None:
    try:
        return float(_item(link, phase, path))
    except ValueError:
        return None


def _item(link: GrblLink, phase: str, path: str) -> str:
    try:
        return grbl.parse_item(link.command(f"${path}", REPLY_S, phase), path)
    except DeviceRefused:
        return ""  # its configuration has no such item
