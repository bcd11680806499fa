"""Alarms and errors by name, with the remedy: Grbl 1.1, grblHAL and FluidNC.

The three agree on alarms 1 to 9 and errors 1 to 38, and number on from there each in its own way:
10 is an e-stop for one and a dual-motor switch for another. What a firmware does not tell apart
from Grbl is looked up in Grbl's own table.
"""

from __future__ import annotations

import enum


class Firmware(enum.StrEnum):
    """What answers; told by the banner."""

    GRBL = "Grbl"
    GRBLHAL = "grblHAL"
    FLUIDNC = "FluidNC"


HOME_AGAIN = "then `umbra stage home`"
Words = dict[int, tuple[str, str]]

_ALARMS: Words = {
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

_ALARMS_OF: dict[str, Words] = {
    Firmware.GRBLHAL: {
        10: ("its emergency stop is pressed", "release it, " + HOME_AGAIN),
        11: ("it has to be homed before anything else", "`umbra stage home`"),
        12: ("a limit switch is closed", "move the stage off it by hand, " + HOME_AGAIN),
        13: ("its probe protection tripped", "Umbra does not probe: check who else sends"),
        14: ("a spindle did not come to speed", "switch the spindle off in its settings"),
        15: _ALARMS[10],
        16: ("its self-test at power-up failed", "see the controller's manual"),
        17: ("a motor driver reports a fault", "check motor wiring and driver, " + HOME_AGAIN),
        18: ("its homing is not configured", "set $22 and $44 ..., " + HOME_AGAIN),
        19: ("its Modbus device does not answer", "switch it off in the settings"),
        20: ("its I/O expander does not answer", "check the board's wiring"),
        21: ("its settings could not be kept", "check the board's EEPROM or flash"),
        22: ("a buffer overflowed", HOME_AGAIN.removeprefix("then ")),
    },
    Firmware.FLUIDNC: {
        10: ("a spindle did not come to speed", "take the spindle out of config.yaml"),
        11: (
            "an input was active at power-up",
            "release limit and control inputs, or mend their pin's :low in config.yaml, "
            + HOME_AGAIN,
        ),
        12: (
            "both limit switches of an axis are closed",
            "move the stage off them by hand, " + HOME_AGAIN,
        ),
        13: ("it was stopped hard", "clear the cause, " + HOME_AGAIN),
        14: ("it has to be homed before anything else", "`umbra stage home`"),
        15: ("it has just started", "`umbra stage home`"),
        16: ("its I/O expander was reset", "check the expander's supply, " + HOME_AGAIN),
        17: ("a line of G-code failed", HOME_AGAIN.removeprefix("then ")),
        18: ("a limit switch was hit while probing", "Umbra does not probe: check who else sends"),
    },
}

_CRITICAL: dict[str, frozenset[int]] = {
    Firmware.GRBL: frozenset({1, 2}),
    Firmware.GRBLHAL: frozenset({1, 2, 10, 17, 20}),
    Firmware.FLUIDNC: frozenset({1, 2, 12, 13, 16}),
}

_ERRORS: Words = {
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

_ERRORS_OF: dict[str, Words] = {
    Firmware.GRBLHAL: {
        18: ("it was reset while the command ran", "connect and home it again"),
        39: ("a value is out of range", ""),
        40: ("a tool change is pending", "acknowledge it, " + HOME_AGAIN),
        43: ("the feed is more than an axis can do", "lower the feed, or raise $110, $111"),
        45: ("a limit switch is closed", "move the stage off it by hand, " + HOME_AGAIN),
        46: ("it has to be homed first", "`umbra stage home`"),
        49: ("its self-test failed", "see the controller's manual"),
        50: ("its emergency stop is pressed", "release it, " + HOME_AGAIN),
        51: ("a motor driver reports a fault", "check motor wiring and driver, " + HOME_AGAIN),
        53: ("that setting is switched off", "see the controller's manual"),
        55: ("its homing settings contradict each other", "check $22, $44 to $46"),
        77: ("it asks for a password", "switch its $ password off"),
        78: ("it denies access", "switch its $ password off"),
        79: ("it allows nothing in this alarm", "clear the cause, `umbra stage home`"),
    },
    Firmware.FLUIDNC: {
        18: (
            "no homing cycle is configured",
            'give the axes a homing: section, or homing = "here"',
        ),
        19: ("an axis cannot be homed alone", "give the axes one homing cycle each"),
        40: ("an input was active at power-up", "release limit and control inputs"),
        110: ("it asks for a password", "switch its authentication off"),
        113: ("it was reset while the command ran", "connect and home it again"),
        120: ("another interface is sending", "close the web page or the other program"),
        130: ("the jog was cancelled", "`umbra stage status`"),
        150: ("a pin is wrong in config.yaml", "mend config.yaml"),
        152: ("its config.yaml is invalid", "read its boot messages, mend config.yaml"),
    },
}

DAMAGED = "the line was damaged on its way: check cable, baud and interference"


def alarm(code: int, firmware: str = Firmware.GRBL) -> tuple[str, str]:
    """What ALARM:code means and what to do; 0 is an alarm whose code was not seen."""
    unknown = ("it is in alarm", "see the controller's manual, " + HOME_AGAIN)
    words, remedy = _look_up(code, firmware, _ALARMS_OF, _ALARMS, unknown)
    return (f"{words} (ALARM:{code})" if code else words), remedy


def refusal(code: int, firmware: str = Firmware.GRBL) -> tuple[str, str]:
    """What error:code means and what to do."""
    unknown = ("it refused", "see the controller's manual")
    words, remedy = _look_up(code, firmware, _ERRORS_OF, _ERRORS, unknown)
    return f"{words} (error:{code})", remedy or DAMAGED


def is_critical(code: int | None, firmware: str) -> bool:
    """Whether the controller hears nothing but a reset after this alarm."""
    return code in _CRITICAL.get(firmware, _CRITICAL[Firmware.GRBL])


def _look_up(
    code: int, firmware: str, own: dict[str, Words], common: Words, unknown: tuple[str, str]
) -> tuple[str, str]:
    of_its_own = own.get(firmware)
    if of_its_own is None:
        return common.get(code, unknown)
    shared = common.get(code, unknown) if code < 10 or common is _ERRORS else unknown
    return of_its_own.get(code, shared)
