"""The DLPC350 in pattern mode: woken, programmed, played and stopped, each until it is so."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from drivers import dlpc350_protocol as p
from drivers.base.errors import DeviceRefused, DeviceTimeout
from drivers.clock import NS, Clock
from drivers.dlpc350_protocol import Command, Entry
from drivers.dlpc_hid import DlpcHid

POLL_S = 0.02
SETTLE_S = 5.0  # a change of mode takes a moment, waking from standby about two seconds


@dataclass(frozen=True, slots=True)
class Pulse:
    """What TRIG_OUT_1 does while a pattern is lit."""

    delay_us: float  # against the light
    active_low: bool


class Board:
    """One board over an open `hid`. Every call raises what USB does, and DeviceTimeout when the
    board takes too long or `halted` is set meanwhile."""

    def __init__(
        self, name: str, hid: DlpcHid, clock: Clock, halted: threading.Event, pulse: Pulse
    ) -> None:
        self.name = name
        self.hid = hid
        self._clock = clock
        self._halted = halted
        self._pulse = pulse

    def wake(self, phase: str) -> None:
        """From standby."""
        self.write(Command.POWER, b"\x00", phase)
        self._until(phase, "wake from standby", Command.POWER, 0x03, 0)
        self._until(phase, "finish its start", Command.HARDWARE_STATUS, 1 << p.HARDWARE_READY, 1)

    def in_standby(self, phase: str) -> bool:
        """Where it is dark, and takes few commands."""
        return self.hid.read(Command.POWER, phase)[0] & 0x03 != 0

    def play(self, phase: str) -> None:
        """Begin the patterns that it was programmed with, lit by the LEDs that they name."""
        self.write(Command.LEDS, p.LEDS_BY_SEQUENCE, phase)
        self.write(Command.PLAY, bytes((p.Play.START,)), phase)

    def stop(self, phase: str) -> None:
        """Stop patterns."""
        self.write(Command.PLAY, bytes((p.Play.STOP,)), phase)
        self._until(phase, "stop", Command.PLAY, 0x03, p.Play.STOP)

    def program(
        self,
        phase: str,
        entries: list[Entry],
        images: list[int],
        exposure_us: int,
        period_us: int,
        *,
        video: bool,
        repeat: bool,
    ) -> list[str]:
        """Stop, and fill the tables; nothing is lit yet. Gives the board's warnings.

        `images` of the flash in the order in which they are fetched; none of them over HDMI
        (`video`). Raises DeviceRefused for what the board finds invalid.
        """
        if self.in_standby(phase):
            self.wake(phase)
        self.stop(phase)
        if self.hid.read(Command.MODE, phase)[0] != p.Mode.PATTERN:
            self.write(Command.MODE, bytes((p.Mode.PATTERN,)), phase)
            self._until(phase, "change its mode", Command.MODE, 0xFF, p.Mode.PATTERN)
        source = p.Source.VIDEO_PORT if video else p.Source.FLASH
        trigger = p.TriggerMode.VSYNC if video else p.TriggerMode.INTERNAL
        edge = p.trigger_edge(self._pulse.delay_us)
        low = int(self._pulse.active_low)
        data = b"".join(entry.packed() for entry in entries)
        for command, value in (
            (Command.PATTERN_SOURCE, bytes((source,))),
            (Command.TABLE, p.table(len(entries), max(len(images), 1), repeat=repeat)),
            (Command.TIMING, p.timing(exposure_us, period_us)),
            (Command.TRIGGER_MODE, bytes((trigger,))),
            (Command.TRIGGER_OUT_1, bytes((low, edge, p.TRIGGER_ZERO))),
            (Command.TRIGGER_OUT_2, bytes((low, edge))),
            *_mailbox(p.Mailbox.PATTERNS, data),
            *(_mailbox(p.Mailbox.IMAGES, p.image_table(images)) if images else ()),
            (Command.VALIDATE, b"\x00"),
        ):
            self.write(command, value, phase)
        status = self._until(phase, "check the patterns", Command.VALIDATE, p.VALIDATING, 0)
        invalid = p.words(status & ~p.WARNINGS, p.INVALID)
        if invalid:
            raise DeviceRefused(
                self.name,
                phase,
                "the board says that " + ", and ".join(invalid),
                "choose other times",
            )
        return p.words(status & p.WARNINGS, p.INVALID)

    def write(self, command: Command, data: bytes, phase: str) -> None:
        """One command. Safe to send again."""
        self.hid.write(command, phase, data)

    def _until(self, phase: str, what: str, command: Command, mask: int, wanted: int) -> int:
        """Ask until a register's bits are as wanted; gives the register."""
        deadline = self._clock.now_ns() + round(SETTLE_S * NS)
        while True:
            status = self.hid.read(command, phase)[0]
            if status & mask == wanted:
                return status
            halted = self._clock.wait(POLL_S, self._halted)
            if halted or self._clock.now_ns() > deadline:
                raise DeviceTimeout(
                    self.name,
                    phase,
                    f"halted before it could {what}" if halted
                    else f"it did not {what} within {SETTLE_S:g} s",
                    "try again; switch it off and on if that does not help",
                )  # fmt: skip


def _mailbox(which: p.Mailbox, data: bytes) -> list[tuple[Command, bytes]]:
    return [
        (Command.MAILBOX, bytes((which,))),
        (Command.MAILBOX_ADDRESS, b"\x00"),
        (Command.MAILBOX_DATA, data),
        (Command.MAILBOX, bytes((p.Mailbox.CLOSED,))),
    ]
