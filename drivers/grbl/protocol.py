"""What Grbl 1.1 says, as data: banner, build info, settings, status reports.

Facts from Grbl's own interface documentation (1.1: gnea/grbl, doc/markdown/interface.md), and from
the sources of grblHAL and FluidNC, which say the same and a little more:

- grblHAL: ``GrblHAL 1.1f ['$' or '$HELP' for help]``; four numbers in ``[OPT:...]``; more lines in
  ``$I`` (the firmware's name among them, for builds whose banner says Grbl); substates of Run and
  Alarm, the state Tool, fields such as ``A:``, ``H:``, ``TLR:``;
- FluidNC: ``Grbl 3.9 [FluidNC v3.9.1 (esp32-wifi) '$' for help]``, the owner's to change; no sizes
  in ``[OPT:...]``; boot messages as ``[MSG:INFO: ...]``; the state Starting; no axis settings in
  ``$$`` (``$/axes/x/max_travel_mm`` and so on instead); terminal colours and telnet negotiation
  where a person's tools asked for them.

Nothing here does I/O, and nothing raises: a line that makes no sense is None.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.grbl.faults import Firmware

STATUS = b"?"
HOLD = b"!"
RESUME = b"~"
RESET = b"\x18"

MM_PER_INCH = 25.4

_NOISE = re.compile("\x1b\\[[0-9;?]*[A-Za-z]|^\ufffd+")


def plain(line: str) -> str:
    """Without terminal colours, and without what telnet or a bad start put before the text."""
    return _NOISE.sub("", line).strip()


_BANNER = re.compile(r"\b(GrblHAL|Grbl)\s+(\d+)\.(\d+)\w*(?:\s*\[|.*'\$')", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Banner:
    """The welcome after a reset."""

    name: Firmware
    version: tuple[int, int]
    text: str


def parse_banner(line: str) -> Banner | None:
    """``Grbl 1.1h ['$' for help]``, grblHAL's and FluidNC's alike."""
    match = None if line.startswith("[") else _BANNER.search(line)
    if not match:
        return None
    name = Firmware.GRBL
    if "FluidNC" in line:
        name = Firmware.FLUIDNC
    elif "HAL" in match[1].upper():
        name = Firmware.GRBLHAL
    return Banner(name, (int(match[2]), int(match[3])), line)


@dataclass(frozen=True, slots=True)
class Build:
    """What ``$I`` says: version, the owner's own string, option letters, buffer sizes."""

    version: str = ""
    label: str = ""
    options: str = ""
    planner_blocks: int = 15
    rx_bytes: int = 128
    firmware: Firmware | None = None  # where it is told here


def parse_build(lines: list[str]) -> Build:
    """From the lines before ``$I``'s ok; what is not told has Grbl 1.1's value."""
    version = label = options = ""
    blocks, rx, firmware = 15, 128, None
    for line in lines:
        if line.startswith("[VER:") and line.endswith("]"):
            version, _, label = (part.strip() for part in line[5:-1].partition(":"))
            if "FluidNC" in version:
                firmware = Firmware.FLUIDNC
        elif line.startswith("[FIRMWARE:grblHAL"):
            firmware = Firmware.GRBLHAL
        elif line.startswith("[OPT:") and line.endswith("]"):
            options, *numbers = line[5:-1].split(",")
            sizes = [int(n) for n in numbers if n.isascii() and n.isdigit()]
            if len(sizes) >= 2 and sizes[0] > 1 and sizes[1] >= 64:
                blocks, rx = sizes[0], sizes[1]
    return Build(version, label, options, blocks, rx, firmware)


_SETTING = re.compile(r"^\$(\d{1,4})=(-?\d+(?:\.\d+)?)(?:\s|$|\()")


def parse_settings(lines: list[str]) -> dict[int, float]:
    """``$110=500.000`` ... as numbers; other lines are skipped."""
    return {int(m[1]): float(m[2]) for line in lines if (m := _SETTING.match(line))}


def parse_item(lines: list[str], path: str) -> str:
    """FluidNC's answer to ``$/axes/x/max_travel_mm``: the value, "" if it has none."""
    wanted = f"${path}="
    return next((line[len(wanted) :].strip() for line in lines if line.startswith(wanted)), "")


STATES = frozenset(
    {"Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep"}
    | {"Tool", "Starting"}  # grblHAL's, FluidNC's
)


@dataclass(frozen=True, slots=True)
class Report:
    """One status report, mm and mm/s in machine coordinates.

    `position` is None where the report has work coordinates and no offset is known yet.
    `at_ns`: when its first byte came; `asked_ns`: when it was asked for at the earliest.
    """

    state: str
    substate: int | None
    position: tuple[float, float] | None
    offset: tuple[float, float] | None  # WCO, if this report or one before it had it
    speed: float | None
    pins: str
    at_ns: int
    asked_ns: int


def parse_report(
    line: str,
    *,
    scale: float = 1.0,
    offset: tuple[float, float] | None = None,
    at_ns: int = 0,
    asked_ns: int = 0,
) -> Report | None:
    """``<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0,0,0>``; None if it makes no sense.

    `scale` is mm a reported unit (25.4 with $13=1); `offset` the last WCO, mm.
    """
    if not (line.startswith("<") and line.endswith(">")):
        return None
    head, *fields = line[1:-1].split("|")
    state, _, sub = head.partition(":")
    if state not in STATES or (sub and not (sub.isascii() and sub.isdigit())):
        return None
    said = dict(entry.partition(":")[::2] for entry in fields)
    pairs: dict[str, tuple[float, float]] = {}
    for key in ("MPos", "WPos", "WCO"):
        if key in said:
            numbers = _numbers(said[key])
            if numbers is None or len(numbers) < 2:
                return None
            pairs[key] = (numbers[0] * scale, numbers[1] * scale)
    offset, position = pairs.get("WCO", offset), pairs.get("MPos")
    if position is None:
        if "WPos" not in pairs:
            return None
        if offset is not None:
            position = (pairs["WPos"][0] + offset[0], pairs["WPos"][1] + offset[1])
    feed = _numbers(said.get("FS", said.get("F", "")))
    speed = feed[0] * scale / 60 if feed else None
    pins = said.get("Pn", "")
    return Report(state, int(sub) if sub else None, position, offset, speed, pins, at_ns, asked_ns)


_NUMBER = re.compile(r"^-?\d{1,7}(?:\.\d{1,6})?$")


def _numbers(text: str) -> list[float] | None:
    """Comma-separated numbers as Grbl prints them; None for anything else (inf, 1e9, 1_0)."""
    parts = text.split(",")
    return [float(p) for p in parts] if all(_NUMBER.match(p) for p in parts) else None
