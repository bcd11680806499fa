"""TMCL as data: nine-byte frames, the instructions and axis parameters used, the statuses by name.

Request: address, command, type, motor, value (int32, big endian), the sum of the bytes before.
Answer: reply address, module address, status, command, value, sum. An answer does not say which
*type* it answers, so two reads of the same command are told apart by their order alone.
"""

from __future__ import annotations

import struct
from enum import IntEnum

FRAME = 9


class Command(IntEnum):
    """TMCL instructions that are used here."""

    ROTATE_RIGHT = 1
    ROTATE_LEFT = 2
    STOP = 3
    MOVE_TO = 4
    SET_AXIS = 5
    GET_AXIS = 6
    REFERENCE_SEARCH = 13
    GET_VERSION = 136


class Axis(IntEnum):
    """Axis parameters that are used here."""

    TARGET = 0
    POSITION = 1
    SPEED = 3
    MAX_SPEED = 4
    MICROSTEPS = 140
    PULSE_DIVISOR = 154


STATUS = {
    1: ("a frame reached it damaged (wrong checksum)", "check the cable"),
    2: ("it does not know the command", "is it a TMCL stepper module?"),
    3: ("it does not know the parameter", "set velocity_unit to match the module's firmware"),
    4: ("a value is out of its range", "check steps_per_turn, microsteps and feeds"),
    5: ("its EEPROM is locked", "unlock it with the maker's tool"),
    6: ("the command is not available", "check the module's firmware"),
}
OK = {100, 101}
DAMAGED = 1


def checksum(data: bytes) -> int:
    """The sum of the bytes, modulo 256."""
    return sum(data) & 0xFF


def encode(address: int, command: int, kind: int, motor: int, value: int) -> bytes:
    """A request frame."""
    body = struct.pack(">BBBBi", address, command, kind, motor, value)
    return body + bytes([checksum(body)])


def find_answer(data: bytes, address: int, command: int) -> tuple[int, int] | None:
    """The last valid answer (status, value) of a module to a command, wherever it begins."""
    for start in range(len(data) - FRAME, -1, -1):
        frame = data[start : start + FRAME]
        if frame[8] == checksum(frame[:8]) and frame[1] == address and frame[3] == command:
            return frame[2], struct.unpack(">i", frame[4:8])[0]
    return None


def signed(steps: int) -> int:
    """As the module's 32-bit counter shows it."""
    return (steps + 2**31) % 2**32 - 2**31


def other_module(data: bytes, address: int) -> int | None:
    """The address of a module that answered in the place of the one that was asked."""
    for start in range(len(data) - FRAME + 1):
        frame = data[start : start + FRAME]
        if frame[8] == checksum(frame[:8]) and frame[2] in {*STATUS, *OK} and frame[1] != address:
            return frame[1]
    return None
