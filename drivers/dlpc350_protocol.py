"""What a DLPC350 understands: its commands, its pattern table, its status in words. No I/O.

Facts of TI's DLPC350 Programmer's Guide (DLPU010) and its public API.
"""

from __future__ import annotations

import enum
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.dlpc_hid import Product

LIGHTCRAFTER_4500 = Product("DLP LightCrafter 4500", 0x0451, 0x6401)

ENTRIES = 128  # of the pattern table
INDICES = 64  # of the table of flash images
SHORTEST_US = {1: 235, 8: 8333}  # exposure, by bits
DARK_US = 230  # least, where the exposure is not the whole period
LONGEST_US = 10_000_000
FILL = 24  # pattern number of white; inverted it is black


class Command(enum.IntEnum):
    """USB command words."""

    POWER = 0x0200
    VERSION = 0x0205
    INPUT = 0x1A00
    LEDS = 0x1A07
    HARDWARE_STATUS = 0x1A0A
    MAIN_STATUS = 0x1A0C
    VALIDATE = 0x1A1A
    MODE = 0x1A1B
    TRIGGER_OUT_1 = 0x1A1D
    TRIGGER_OUT_2 = 0x1A1E
    PATTERN_SOURCE = 0x1A22
    TRIGGER_MODE = 0x1A23
    PLAY = 0x1A24
    TIMING = 0x1A29
    TABLE = 0x1A31
    MAILBOX_ADDRESS = 0x1A32
    MAILBOX = 0x1A33
    MAILBOX_DATA = 0x1A34


class Mode(enum.IntEnum):
    """What it does with its input."""

    VIDEO = 0
    PATTERN = 1


class Source(enum.IntEnum):
    """Where patterns come from."""

    VIDEO_PORT = 0
    FLASH = 3


class TriggerMode(enum.IntEnum):
    """What starts a sequence."""

    VSYNC = 0
    INTERNAL = 1


class Play(enum.IntEnum):
    """Stop goes back to the first pattern, pause does not."""

    STOP = 0
    PAUSE = 1
    START = 2


class Mailbox(enum.IntEnum):
    """Which table is written."""

    CLOSED = 0
    IMAGES = 1
    PATTERNS = 2


class Led(enum.IntEnum):
    """What lights a pattern."""

    RED = 1
    GREEN = 2
    YELLOW = 3
    BLUE = 4
    MAGENTA = 5
    CYAN = 6
    WHITE = 7


LEDS_OFF = b"\x00"
LEDS_BY_SEQUENCE = b"\x08"

HARDWARE_FAULTS = {
    2: "the DMD controller has an error",
    3: "it swapped image buffers too late",
    6: "its sequencer has aborted",
    7: "its sequencer has an error",
}
HARDWARE_READY = 0
MAIN_STATUS = {
    0: "mirrors parked",
    1: "sequencer running",
    2: "frame buffer frozen",
    3: "gamma correction on",
}
INVALID = {
    0: "the exposure or the period is out of range",
    1: "a pattern number is out of range",
    2: "trigger outputs run into one another",
    3: "a black fill is missing before an externally triggered pattern",
    4: "the exposure is neither the period nor 230 us shorter",
}
WARNINGS = 1 << 3
VALIDATING = 1 << 7

TRIGGER_STEP_US = 0.1072
TRIGGER_ZERO = 0xBB
TRIGGER_LAST = 0xD5


def words(status: int, meanings: dict[int, str]) -> list[str]:
    """The set bits of a status byte that mean something, in words."""
    return [word for bit, word in meanings.items() if status >> bit & 1]


@dataclass(frozen=True, slots=True)
class Entry:
    """One pattern of the table."""

    number: int  # which bits of a 24-bit image: with `bits` = 1 plane 0 to 23, FILL; 8: 0 to 2
    bits: int = 1
    led: Led = Led.WHITE
    invert: bool = False
    swap: bool = False  # take the next image of the image table first
    external: bool = False  # wait for the trigger (VSYNC, in that mode); else go on by itself
    onward: bool = False  # within one trigger: right after the pattern before
    clear: bool = False  # black fill after it: takes 230 us before the next

    def packed(self) -> bytes:
        """Its three bytes."""
        trigger = 3 if self.onward else int(self.external)
        flags = self.invert | self.clear << 1 | self.swap << 2
        return bytes((trigger | self.number << 2, self.bits | self.led << 4, flags))


def table(entries: int, images: int, *, repeat: bool) -> bytes:
    """The TABLE command's data: how many of each, counted from 0."""
    return bytes((entries - 1, int(repeat), entries - 1, images - 1))


def image_table(images: Sequence[int]) -> bytes:
    """The flash images in order of their use. The firmware wants a table of two turned round."""
    return bytes(images[::-1] if len(images) == 2 else images)


def timing(exposure_us: int, period_us: int) -> bytes:
    """The TIMING command's data."""
    return struct.pack("<II", exposure_us, period_us)


def trigger_edge(delay_us: float) -> int:
    """The code of a trigger output's delay against the pattern, -20.05 to 2.787 us."""
    code = TRIGGER_ZERO + round(delay_us / TRIGGER_STEP_US)
    if not 0 <= code <= TRIGGER_LAST:
        raise ValueError(f"a trigger delay of {delay_us:g} us; it may be -20.05 to 2.787")
    return code


def version(answer: bytes) -> str:
    """The firmware's version out of what VERSION answers."""
    patch, minor, major = struct.unpack_from("<HBB", answer)
    return f"{major}.{minor}.{patch}"
