"""A stepper module that speaks TMCL, byte by byte, on a pseudo-terminal: for the driver's tests.

Written from the documented frame (nine bytes, sum at the end), not from the driver.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import threading
import time
import tty
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

TICK_S = 0.001


@dataclass
class Faults:
    mute: bool = False
    drop: int = 0  # the next so many answers
    damage: int = 0  # the next so many answers have a wrong sum
    before: list[bytes] = field(default_factory=list)  # goes out before the next answers
    statuses: dict[int, int] = field(default_factory=dict)  # command -> status to answer with
    no_reference: bool = False
    blocked: bool = False  # told to turn, it stands
    late: list[float] = field(default_factory=list)  # s, by which the next answers are late


class TmclPeer:
    """Use as a context manager; `position` is the truth in microsteps."""

    def __init__(self, folder: Path, *, module: int = 1140, resolution: int = 8) -> None:
        self.link = folder / "usb-tmcl"
        self.faults = Faults()
        self.frames: list[tuple[int, int, int]] = []  # command, type, value
        self.module = module
        self.address = 1
        self.axis = {140: resolution, 4: 20_000, 154: 5}
        self.position = 1234.0
        self.acceleration = 2_000_000.0  # microsteps a second squared
        self._speed = 0.0
        self._wanted = 0.0
        self._target: int | None = None
        self._search_until: float | None = None
        self._stop = threading.Event()
        self._buffer = b""
        self._out: deque[tuple[float, bytes]] = deque()  # answers, and when they go; in order
        self._plug()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _plug(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        os.close(slave)
        os.set_blocking(self._master, False)

    def unplug(self) -> None:
        self.link.unlink(missing_ok=True)  # its tty's name may soon be that of another test's
        master, self._master = self._master, -1
        os.close(master)
        self._out.clear()
        self._buffer = b""

    def __enter__(self) -> TmclPeer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        if self._master >= 0:
            self.unplug()

    def _run(self) -> None:
        last = time.monotonic()
        while not self._stop.is_set():
            if self._master < 0:
                time.sleep(TICK_S)
                continue
            with contextlib.suppress(OSError, ValueError):  # pulled in between
                if select.select([self._master], [], [], TICK_S)[0]:
                    self._buffer += os.read(self._master, 512)
            while len(self._buffer) >= 9:
                frame, self._buffer = self._buffer[:9], self._buffer[9:]
                self._answer(frame)
            now = time.monotonic()
            while self._out and self._out[0][0] <= now and self._master >= 0:
                with contextlib.suppress(OSError):
                    os.write(self._master, self._out.popleft()[1])
            self._advance(now - last)
            last = now
            time.sleep(TICK_S)

    def _advance(self, dt: float) -> None:
        if self._search_until is not None and time.monotonic() > self._search_until:
            self._search_until, self.position, self._wanted, self._target = None, 0.0, 0.0, None
        wanted = self._wanted
        if self._target is not None:
            left = self._target - self.position
            stoppable = (2 * self.acceleration * abs(left)) ** 0.5
            wanted = min(self.axis[4], stoppable) * (1 if left > 0 else -1)
            if abs(left) < 2:
                self.position, self._speed, self._wanted, self._target = self._target, 0, 0, None
                return
        if self.faults.blocked:
            wanted = self._speed = 0.0
        step = self.acceleration * dt
        self._speed += max(-step, min(step, wanted - self._speed))
        way = self._speed * dt
        if self._target is not None and abs(way) > abs(self._target - self.position):
            way = self._target - self.position
        self.position += way

    def _answer(self, frame: bytes) -> None:
        if sum(frame[:8]) & 0xFF != frame[8]:
            self._send(frame[1], 1, 0)
            return
        command, kind = frame[1], frame[2]
        value = int.from_bytes(frame[4:8], "big", signed=True)
        self.frames.append((command, kind, value))
        status = self.faults.statuses.get(command, 100)
        self._send(command, status, self._act(command, kind, value) if status == 100 else 0)

    def _act(self, command: int, kind: int, value: int) -> int:
        if command in {1, 2}:
            self._target, self._wanted = None, value if command == 1 else -value
        elif command == 3:
            self._target, self._wanted = None, 0.0
        elif command == 4:
            self._target = self._nearest(value)
        elif command == 5:
            self.axis[kind] = value
            if kind == 1:
                self.position, self._target = value, None
        elif command == 6:
            value = {1: _wrapped(round(self.position)), 3: round(self._speed)}.get(
                kind, self.axis.get(kind, 0)
            )
        elif command == 13:
            return self._search(kind)
        elif command == 136:
            return self.module << 16 | 1 << 8 | 42
        return value

    def _nearest(self, value: int) -> int:
        """The counter has 32 bits: the way is the shorter one."""
        return round(self.position) + _wrapped(value - round(self.position))

    def _search(self, kind: int) -> int:
        if kind == 0:
            self._search_until = time.monotonic() + (1e9 if self.faults.no_reference else 0.05)
        elif kind == 1:
            self._search_until = None
        return int(self._search_until is not None)

    def _send(self, command: int, status: int, value: int) -> None:
        body = bytes([2, self.address, status, command]) + value.to_bytes(4, "big", signed=True)
        check = sum(body) & 0xFF
        if self.faults.damage > 0:
            self.faults.damage -= 1
            check ^= 0x55
        data = body + bytes([check])
        if self.faults.before:
            data = self.faults.before.pop(0) + data
        if self.faults.drop > 0:
            self.faults.drop -= 1
            return
        if not self.faults.mute:
            late = self.faults.late.pop(0) if self.faults.late else 0.0
            self._out.append((time.monotonic() + late, data))


def _wrapped(value: int) -> int:
    return (value + 2**31) % 2**32 - 2**31
