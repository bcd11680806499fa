"""What Grbl 1.1 says, as data: status reports, settings, build info, alarms and errors by name.

Facts from Grbl's own interface documentation (1.1: gnea/grbl, doc/markdown/interface.md);
grblHAL and FluidNC say the same and a little more. Nothing here does I/O, and nothing raises: a
line that makes no sense is None.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

STATUS = b"?"
HOLD = b"!"
RESUME = b"~"
RESET = b"\x18"
JOG_CANCEL = b"\x85"

MM_PER_INCH = 25.4

HOME_AGAIN = "then `umbra stage home`"

ALARMS: dict[int, tuple[str, str]] = {
    1: (
        "a limit switch was hit in motion",
        "clear what is in the way, check that no switch wire picks up noise, " + HOME_AGAIN,
    ),
    2: (
        "the controller's soft limit stopped a motion",
        "the travel told to the driver exceeds the controller's ($130, $131): make them agree, "
        + HOME_AGAIN,
    ),
    3: ("it was reset while moving and lost its position", "`umbra stage home`"),
    4: ("the probe was not in its expected state", "Umbra does not probe: check who else sends"),
    5: ("the probe touched nothing", "Umbra does not probe: check who else sends"),
    6: ("homing was stopped by a reset", "`umbra stage home`"),
    7: ("the safety door was opened while homing", "close the door, " + HOME_AGAIN),
    8: (
        "a limit switch stayed closed while pulling off after homing",
        "check the switch's wiring, raise the pull-off distance ($27), " + HOME_AGAIN,
    ),
    9: (
        "a limit switch was not found while homing",
        "check the wiring of the X and Y switches, the homing direction ($23), the travel ($130, "
        "$131), and that the firmware homes no axis which the stage lacks (Z), " + HOME_AGAIN,
    ),
    10: (
        "the second switch of a dual-motor axis was not found",
        "check its wiring, " + HOME_AGAIN,
    ),
}
"""Code -> what happened, and what to do."""

ERRORS: dict[int, tuple[str, str]] = {
    1: ("a G-code word had no letter", ""),
    2: ("a number was missing or not a number", ""),
    3: ("a $ command was not recognised", ""),
    4: ("a value was negative", ""),
    5: ("homing is switched off", 'wire limit switches and set $22=1, or use homing = "here"'),
    6: ("the step pulse is too short", "set $0 to 3 µs or more"),
    7: ("its EEPROM could not be read and was restored to defaults", "set its $ settings again"),
    8: ("it takes that command only when idle", "`umbra stage stop`, then again"),
    9: ("it is locked after an alarm or a reset", "`umbra stage home`"),
    10: ("soft limits need homing", "set $22=1 before $20=1"),
    11: ("a line was too long", ""),
    12: ("the step rate would be too high", "lower $100/$101 or $110/$111"),
    13: ("the safety door is open", "close it, then `umbra stage unlock`"),
    14: ("a stored line was too long", ""),
    15: ("a jog would leave the travel", "aim within the travel"),
    16: ("a jog command was malformed", ""),
    17: ("laser mode needs a PWM output", "set $32=0"),
    20: ("a G-code command is unsupported", "is it Grbl 1.1?"),
    21: ("two G-code commands of one group in a line", ""),
    22: ("no feed rate was set", ""),
    23: ("a G-code command needs an integer", ""),
    24: ("two commands that use the axis words in a line", ""),
    25: ("a G-code word was repeated", ""),
    26: ("axis words are missing", ""),
    27: ("a line number is out of range", ""),
    28: ("a P or L word is missing", ""),
    29: ("a work coordinate system is not supported", ""),
    30: ("G53 needs G0 or G1", ""),
    31: ("axis words were not used by any command", ""),
    32: ("an arc has no axis words", ""),
    33: ("an arc's target is impossible", ""),
    34: ("an arc's radius is impossible", ""),
    35: ("an arc's centre is missing", ""),
    36: ("value words were not used by any command", ""),
    37: ("a tool length offset is on another axis", ""),
    38: ("a tool number is too large", ""),
}
"""Code -> what it objects to, and what to do. "": the line was damaged on its way."""

DAMAGED = "the line was damaged on its way: check cable, baud and interference"


def alarm(code: int) -> tuple[str, str]:
    """What ALARM:code means and what to do; 0 is an alarm whose code was not seen."""
    words, remedy = ALARMS.get(
        code, ("it is in alarm", "see the controller's manual, " + HOME_AGAIN)
    )
    return (f"{words} (ALARM:{code})" if code else words), remedy


def refusal(code: int) -> tuple[str, str]:
    """What error:code means and what to do."""
    words, remedy = ERRORS.get(code, ("it refused", "see the controller's manual"))
    return f"{words} (error:{code})", remedy or DAMAGED


_BANNER = re.compile(r"(GrblHAL|Grbl)\s+(\d+)\.(\d+)\S*.*'\$'", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Banner:
    """The welcome after a reset."""

    name: str
    version: tuple[int, int]
    text: str


def parse_banner(line: str) -> Banner | None:
    """``Grbl 1.1h ['$' for help]``, grblHAL's and FluidNC's alike."""
    match = None if line.startswith("[") else _BANNER.search(line)
    if not match:
        return None
    name = "FluidNC" if "FluidNC" in line else "grblHAL" if "HAL" in match[1].upper() else "Grbl"
    return Banner(name, (int(match[2]), int(match[3])), line)


@dataclass(frozen=True, slots=True)
class Build:
    """What ``$I`` says: version, the owner's own string, option letters, buffer sizes."""

    version: str = ""
    label: str = ""
    options: str = ""
    planner_blocks: int = 15
    rx_bytes: int = 128


def parse_build(lines: list[str]) -> Build:
    """From the lines before ``$I``'s ok; what is not told has Grbl 1.1's value."""
    version = label = options = ""
    blocks, rx = 15, 128
    for line in lines:
        if line.startswith("[VER:") and line.endswith("]"):
            version, _, label = line[5:-1].partition(":")
        elif line.startswith("[OPT:") and line.endswith("]"):
            options, *numbers = line[5:-1].split(",")
            sizes = [int(n) for n in numbers if n.isascii() and n.isdigit()]
            if len(sizes) >= 2 and sizes[0] > 1 and sizes[1] >= 64:
                blocks, rx = sizes[0], sizes[1]
    return Build(version, label, options, blocks, rx)


_SETTING = re.compile(r"^\$(\d{1,4})=(-?\d+(?:\.\d+)?)(?:\s|$|\()")


def parse_settings(lines: list[str]) -> dict[int, float]:
    """``$110=500.000`` ... as numbers; other lines are skipped."""
    return {int(m[1]): float(m[2]) for line in lines if (m := _SETTING.match(line))}


STATES = frozenset({"Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep"})


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
