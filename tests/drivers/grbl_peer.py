"""A controller that speaks Grbl 1.1, byte by byte, on a pseudo-terminal: for the driver's tests.

Written from Grbl's documented interface, not from the driver. What is real: the 128-byte receive
buffer that loses what overflows, real-time bytes that bypass it, one ok or error a line, a planner
of 15 blocks into which arcs are cut, motion that accelerates and plans no further ahead than its
queue, feed hold, resume, jog cancel, resets with and without loss of position, homing that is
silent, alarms that block until a reset, and the port that hangs up and returns under another name.
`speed` runs it faster than life.
"""

from __future__ import annotations

import contextlib
import math
import os
import pty
import re
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

TICK_S = 0.001
ARC_STEP = 2 * math.sqrt(0.002 * (3.0 - 0.002))  # mm: Grbl's chords at $12=.002 and r = 1.5
REALTIME = frozenset(b"?!~\x18")


@dataclass
class Settings:
    travel: tuple[float, float] = (40.0, 40.0)
    rate: float = 3000.0  # mm/min
    acceleration: float = 500.0
    homing: bool = True
    soft_limits: bool = True
    inches: bool = False
    work_positions: bool = False  # $10=0: WPos, with WCO now and then
    offset: tuple[float, float] = (5.0, -3.0)  # of the work coordinates
    pulloff: float = 1.0
    label: str = ""
    banner: str = "Grbl 1.1h ['$' for help]"
    dialect: str = "Grbl"  # grblHAL, FluidNC: as their sources say it
    chatter: list[bytes] = field(default_factory=list)  # before the banner


@dataclass
class Faults:
    """Set from a test at any time."""

    drop_reports: int = 0  # the next so many queries are not answered
    drop_every: int = 0  # every so many-th query is not answered
    mute: bool = False  # says nothing at all, and hears nothing
    swallow_acks: int = 0  # the next so many oks are lost on the line
    deaf_to: str = ""  # this line is lost on its way
    noise: list[bytes] = field(default_factory=list)  # goes out between answers
    switch_missing: bool = False  # homing finds no switch: ALARM:9
    homing_s: float = 0.1
    hard_limit_at: float | None = None  # x below which a limit switch closes: ALARM:1
    stalled: bool = False  # it says Run, and does not move
    spoil: Callable[[bytes], bytes] | None = None  # what the line makes of what it says
    refuse: dict[str, int] = field(default_factory=dict)  # part of a line -> error code


@dataclass
class Block:
    x: float
    y: float
    feed: float  # mm/s
    jog: bool = False


GONE = "/dev/pts/gone"


class GrblPeer:
    """Use as a context manager. `link` is the stable name; the tty behind it may change."""

    def __init__(
        self,
        folder: Path,
        *,
        settings: Settings | None = None,
        speed: float = 1.0,
        resets_on_open: bool = True,
        boot_s: float = 0.1,
        rx_bytes: int = 128,
    ) -> None:
        self.settings = settings or Settings()
        self.faults = Faults()
        self.link = folder / "usb-peer"
        self.speed = speed
        self.resets_on_open = resets_on_open
        self.boot_s = boot_s
        self.rx_size = rx_bytes
        self.lines: list[str] = []  # every line that was executed or refused
        self.realtime: list[bytes] = []
        self.overflowed = 0  # bytes lost in the receive buffer
        self.most_buffered = 0
        self.starved = 0  # times that it stopped for want of a block while arcs were coming
        self.path: list[tuple[float, float, float]] = []  # (monotonic s, x, y) of the truth
        self.name = ""
        self._master = -1
        self._spare: tuple[int, str] | None = None
        self._open = False
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._power_up()
        self.plug()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> GrblPeer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.unplug()
        if self._spare is not None:
            os.close(self._spare[0])

    # ------------------------------------------------------------ the cable

    def plug(self) -> None:
        """Appear under a new name; the link follows."""
        master, self.name = self._spare or _new_pty()
        self._spare = None
        with self._lock:
            self._master, self._open = master, False
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(self.name)

    def unplug(self) -> None:
        """Vanish; the link stays behind, dangling: at no name that another test's tty may get."""
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(GONE)
        if self._spare is None and not self._stop.is_set():
            self._spare = _new_pty()  # taken while the old name is in use: it will be another
        with self._lock:
            if self._master >= 0:
                os.close(self._master)
            self._master = -1

    def power_cycle(self) -> None:
        """Lose the supply for a moment, the port staying: position gone, locked again."""
        with self._lock:
            self._power_up()
            self._boot()

    # ------------------------------------------------------------ state

    def _power_up(self) -> None:
        self.x = self.y = 0.0
        self.state = "Alarm" if self.settings.homing else "Idle"
        self._clear()

    def _clear(self) -> None:
        self._rx = bytearray()
        self._blocks: deque[Block] = deque()
        self._running: Iterator[None] | None = None
        self._v = 0.0
        self._holding = False
        self._jog_cancel = False
        self._deaf = self._then_hold = False
        self._critical = False
        self._asked = False
        self._parsed = (self.x, self.y)  # where the parser believes to be
        self._feed = 0.0
        self._absolute = True
        self._boot_at = 0.0
        self._wco_in = 0

    def _boot(self, delay: float = 0.0) -> None:
        self._clear()
        self._boot_at = time.monotonic() + delay / self.speed
        self._booting = True

    _booting = False

    def _reset(self) -> None:
        """The real-time reset, 0x18."""
        moving = self.state in {"Run", "Jog", "Home"} or (self.state == "Hold" and self._v > 0)
        if moving:
            self._say(f"ALARM:{6 if self.state == 'Home' else 3}")
            self.state = "Alarm"
            self._boot(0.5)
        else:
            self.state = "Alarm" if self.state in {"Alarm", "Sleep"} else "Idle"
            self._boot()

    def _welcome(self) -> None:
        self._booting = False
        for data in self.settings.chatter:
            self._put(data)
        self._say("")
        self._say(self.settings.banner)
        if self.state == "Alarm":
            self._say("[MSG:'$H'|'$X' to unlock]")

    # ------------------------------------------------------------ bytes

    def _say(self, text: str) -> None:
        self._put(text.encode() + b"\r\n")

    def _put(self, data: bytes) -> None:
        if self.faults.spoil is not None:
            data = self.faults.spoil(data)
        if self._master >= 0 and not self.faults.mute:
            with contextlib.suppress(OSError):
                os.write(self._master, data)

    def _hear(self) -> None:
        if self._master < 0:
            return
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        events = poll.poll(0)
        hung_up = bool(events and events[0][1] & select.POLLHUP)
        if hung_up and not (events[0][1] & select.POLLIN):
            self._open = False
            return
        if not self._open and not hung_up:
            self._open = True
            if self.resets_on_open:  # DTR is wired to the reset pin
                self._power_up()
                self._boot(self.boot_s)
        try:
            data = os.read(self._master, 4096)
        except OSError:
            return
        if not self.faults.mute:
            for byte in data:
                self._byte(byte)

    def _byte(self, byte: int) -> None:
        if byte in REALTIME or byte >= 0x80:
            self.realtime.append(bytes([byte]))
            if self._booting:
                return
            if byte == 0x18:
                self._reset()
            elif byte == ord("?"):
                self._asked = True
            elif byte == ord("!") and not self._critical:
                self._hold()
            elif byte == ord("~") and self._deaf:
                self._deaf = False
            elif byte == ord("~") and self.state == "Hold" and self._v == 0:
                self._holding = False
                self.state = "Run" if self._blocks else "Idle"
            elif byte == 0x85 and self.state == "Jog":
                # one that comes while the jog ends leaves Grbl idle and suspended, until ~
                self._deaf = self._holding
                self._holding = self._jog_cancel = True
        elif self._booting:
            return
        elif len(self._rx) < self.rx_size:
            self._rx.append(byte)
            self.most_buffered = max(self.most_buffered, len(self._rx))
        else:
            self.overflowed += 1

    def _hold(self) -> None:
        if self.state == "Jog":
            self._then_hold = self._holding  # a second one holds what has stopped
            self._holding = self._jog_cancel = True
        elif self.state in {"Run", "Idle"}:
            self._holding = True
            self.state = "Hold"

    # ------------------------------------------------------------ the main loop

    def _run(self) -> None:
        last = time.monotonic()
        while not self._stop.is_set():
            time.sleep(TICK_S)
            with self._lock:
                now = time.monotonic()
                self._hear()
                if self._booting:
                    if now >= self._boot_at:
                        self._welcome()
                    last = now
                    continue
                self._answer()
                while last < now:
                    step = min(TICK_S / self.speed, now - last)
                    last += step
                    self._advance(step * self.speed)
                    self._work()
                if self.state in {"Run", "Jog", "Hold"}:
                    self.path.append((now, self.x, self.y))

    def _work(self) -> None:
        """The protocol loop: one line at a time; a full planner blocks it, a hold suspends it."""
        for _ in range(40):
            if self._critical or self.state == "Hold" or self._booting:
                return
            if self._deaf and self.state == "Idle":
                return
            if self._running is None:
                end = self._rx.find(b"\n")
                if end < 0:
                    return
                line = self._rx[:end].decode("ascii", "replace").strip()
                del self._rx[: end + 1]
                if line and line == self.faults.deaf_to:
                    continue
                self.lines.append(line)
                self._running = self._execute(line)
            if next(self._running, True) is None:
                return  # it waits for the planner
            self._running = None

    def _answer(self) -> None:
        if self.faults.noise:
            self._put(self.faults.noise.pop(0))
        silent = self.settings.dialect == "Grbl" and (self._critical or self.state == "Home")
        if not self._asked or silent:
            return
        self._asked = False
        self._queries += 1
        if self.faults.drop_reports > 0:
            self.faults.drop_reports -= 1
            return
        if self.faults.drop_every and self._queries % self.faults.drop_every == 0:
            return
        unit = 25.4 if self.settings.inches else 1.0
        offset = self.settings.offset if self.settings.work_positions else (0.0, 0.0)
        sub = "" if self.state != "Hold" else (":1" if self._v > 0 else ":0")
        if self.settings.dialect == "grblHAL" and self.state == "Alarm":
            sub = f":{self._alarm_code}"
        kind = "WPos" if self.settings.work_positions else "MPos"
        x, y = (self.x - offset[0]) / unit, (self.y - offset[1]) / unit
        text = f"<{self.state}{sub}|{kind}:{x:.4f},{y:.4f},0.000|FS:{self._v * 60 / unit:.0f},0"
        if self._wco_in == 0:
            text += f"|WCO:{offset[0] / unit:.4f},{offset[1] / unit:.4f},0.000"
            self._wco_in = 10
        self._wco_in -= 1
        if self.settings.dialect == "grblHAL":
            text += "|Ov:100,100,100|A:|H:1,3|TLR:0"
        elif self.settings.dialect == "FluidNC":
            text += "|Ln:12|SD:12.34,a:b.nc"
        self._say(text + ">")

    _queries = 0

    def _ok(self) -> None:
        if self.faults.swallow_acks > 0:
            self.faults.swallow_acks -= 1
        else:
            self._say("ok")

    def _execute(self, line: str) -> Iterator[None]:
        for part, code in self.faults.refuse.items():
            if part in line:
                self._say(f"error:{code}")
                return
        if line.startswith("$J="):
            if self.state not in {"Idle", "Jog"}:
                self._say("error:8")
                return
            yield from self._gcode(line[3:], jog=True)
        elif line.startswith("$"):
            yield from self._dollar(line)
        elif not line:
            self._ok()
        elif self.state in {"Alarm", "Jog"}:
            self._say("error:9")
        else:
            yield from self._gcode(line, jog=False)

    def _dollar(self, line: str) -> Iterator[None]:
        s = self.settings
        if line == "$I":
            self._identify()
            self._ok()
        elif line.startswith("$/"):
            item = self._items().get(line[2:])
            if item is None:
                self._say("error:3")
                return
            self._say(f"{line}={item}")
            self._ok()
        elif line == "$$":
            values = {
                10: int(not s.work_positions), 13: int(s.inches), 20: int(s.soft_limits), 21: 0,
                22: int(s.homing), 23: 0, 110: s.rate, 111: s.rate, 112: 500, 120: s.acceleration,
                121: s.acceleration, 122: 10, 130: s.travel[0], 131: s.travel[1], 132: 200,
            }  # fmt: skip
            if s.dialect == "FluidNC":
                values = {13: int(s.inches), 30: 1000, 32: 0}
            for key, number in values.items():
                self._say(f"${key}={number:.3f}" if key > 99 else f"${key}={number}")
            self._ok()
        elif line == "$X":
            if self.state == "Alarm":
                self.state = "Idle"
                self._say("[MSG:Caution: Unlocked]")
            self._ok()
        elif line == "$H":
            yield from self._home()
        else:
            self._say("error:3")

    def _identify(self) -> None:
        s = self.settings
        if s.dialect == "FluidNC":
            self._say(f"[VER:3.9 FluidNC v3.9.1 (esp32-wifi) :{s.label}]")
            self._say("[OPT:PHSW]")
            self._say("[MSG:INFO: Machine: umbra]")
        elif s.dialect == "grblHAL":
            self._say(f"[VER:1.1f.20260817:{s.label}]")
            self._say("[OPT:VNML+,100,1024,3,0]")
            for line in ("AXS:3:XYZ", "NEWOPT:ENUMS,RT+,TC,SED", "FIRMWARE:grblHAL", "SIGNALS:D"):
                self._say(f"[{line}]")
        else:
            self._say(f"[VER:1.1h.20190830:{s.label}]")
            self._say(f"[OPT:V,15,{self.rx_size}]")

    def _items(self) -> dict[str, str]:
        """FluidNC's config.yaml, as far as it is asked for."""
        s = self.settings
        values: dict[str, str] = {}
        for name, travel in zip("xy", s.travel, strict=True):
            axis = f"axes/{name}/"
            values[axis + "max_rate_mm_per_min"] = f"{s.rate:.3f}"
            values[axis + "acceleration_mm_per_sec2"] = f"{s.acceleration:.3f}"
            values[axis + "max_travel_mm"] = f"{travel:.3f}"
            values[axis + "soft_limits"] = str(s.soft_limits).lower()
            if s.homing:
                values[axis + "homing/cycle"] = "1"
                values[axis + "homing/mpos_mm"] = "0.000"
                values[axis + "homing/positive_direction"] = "true"
        return values

    def _home(self) -> Iterator[None]:
        if not self.settings.homing:
            self._say("error:5")
            return
        if self.state not in {"Idle", "Alarm"}:
            self._say("error:8")
            return
        self.state = "Home"
        began = time.monotonic()
        while time.monotonic() < began + self.faults.homing_s / self.speed:  # it may be changed
            yield
        if self.faults.switch_missing:
            self._say("ALARM:9")
            self._alarm_code = 9
            self._ok()
            self.state = "Alarm"
            self._boot(0.5)
            return
        self.x = self.y = -self.settings.pulloff
        self._parsed = (self.x, self.y)
        self.state = "Idle"
        self._ok()

    def _gcode(self, line: str, *, jog: bool) -> Iterator[None]:
        words = [(w[0], float(w[1:])) for w in re.findall(r"[A-Z]-?[0-9.]+", line)]
        codes = {int(v) for c, v in words if c == "G"}
        axes = {c: v for c, v in words if c in "XYIJF"}
        self._absolute = True if 90 in codes else False if 91 in codes else self._absolute
        feed = axes.get("F", 0.0) / 60 or self._feed
        if (error := self._objection(line, codes, axes, feed)) or not {"X", "Y"} & axes.keys():
            self._say(f"error:{error}") if error else self._ok()
            return
        if not jog:
            self._feed = feed
        x, y = self._parsed
        if 53 in codes or self._absolute:
            work = (
                self.settings.offset if 53 not in codes and self.settings.work_positions else None
            )
            ox, oy = work or (0.0, 0.0)
            target = (axes.get("X", x - ox) + ox, axes.get("Y", y - oy) + oy)
        else:
            target = (x + axes.get("X", 0.0), y + axes.get("Y", 0.0))
        points = [target]
        if {2, 3} & codes:
            points = _arc((x, y), target, (axes.get("I", 0.0), axes.get("J", 0.0)), 2 in codes)
        for point in points:
            if self.settings.soft_limits and not self._within(point):
                yield from self._soft_limit(jog)
                return
            while len(self._blocks) >= 15:
                yield
            self._blocks.append(Block(*point, min(feed, self.settings.rate / 60), jog))
            self._parsed = point
            if self.state == "Idle" and (jog or len(self._blocks) >= 15):
                self.state = "Jog" if jog else "Run"
        self._ok()

    @staticmethod
    def _objection(line: str, codes: set[int], axes: dict[str, float], feed: float) -> int:
        if "".join(re.findall(r"[A-Z]-?[0-9.]+", line)) != line:
            return 2
        if codes - {0, 1, 2, 3, 17, 20, 21, 53, 90, 91, 94}:
            return 20
        if 53 in codes and {2, 3} & codes:
            return 30
        return 22 if {"X", "Y"} & axes.keys() and not feed else 0

    def _within(self, point: tuple[float, float]) -> bool:
        return all(-t - 1e-6 <= p <= 1e-6 for p, t in zip(point, self.settings.travel, strict=True))

    def _soft_limit(self, jog: bool) -> Iterator[None]:
        if jog:
            self._say("error:15")
            return
        while self._blocks and self.state == "Run":
            yield
        self._alarm(2)

    def _alarm(self, code: int) -> None:
        self.state = "Alarm"
        self._critical = True
        self._blocks.clear()
        self._v = 0.0
        self._alarm_code = code
        self._say(f"ALARM:{code}")
        self._say("[MSG:Reset to continue]")

    _alarm_code = 0

    # ------------------------------------------------------------ motion

    def _advance(self, dt: float) -> None:
        """Go on along the queued blocks, never faster than allows a stop at the queue's end."""
        if self.state == "Idle" and self._blocks and self._running is None and not self._rx:
            self.state = "Run"  # auto-start when no more lines come
        if self.state not in {"Run", "Jog", "Hold"} or self._critical:
            return
        if self.faults.stalled and not self._holding:
            return
        a = self.settings.acceleration
        left = self._left()
        if self._holding:
            self._v = max(0.0, self._v - a * dt)
        elif not self._blocks:
            self._v = 0.0
        else:
            stoppable = math.sqrt(2 * a * left)
            self._v = min(self._v + a * dt, self._blocks[0].feed, stoppable)
            self._v = max(self._v, 0.05 * math.sqrt(a * 0.001))
        self._travel(self._v * dt)
        if self.faults.hard_limit_at is not None and self.x < self.faults.hard_limit_at:
            self._alarm(1)
            return
        if self._holding and self._v == 0.0 and self._jog_cancel:
            self._blocks.clear()
            self._parsed = (self.x, self.y)
            self._holding = self._jog_cancel = False
            self.state = "Hold" if self._then_hold else "Idle"
            self._holding, self._then_hold = self._then_hold, False
        elif not self._blocks and self.state in {"Run", "Jog"}:
            if self._running is not None or self._rx:
                self.starved += 1
            self.state = "Idle"
            self._v = 0.0

    def _left(self) -> float:
        x, y, total = self.x, self.y, 0.0
        for block in self._blocks:
            total += math.hypot(block.x - x, block.y - y)
            x, y = block.x, block.y
        return total

    def _travel(self, way: float) -> None:
        while way > 0 and self._blocks:
            block = self._blocks[0]
            length = math.hypot(block.x - self.x, block.y - self.y)
            if length <= way:
                self.x, self.y = block.x, block.y
                self._blocks.popleft()
                way -= length
            else:
                self.x += (block.x - self.x) * way / length
                self.y += (block.y - self.y) * way / length
                way = 0.0


def _new_pty() -> tuple[int, str]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    os.close(slave)
    os.set_blocking(master, False)
    return master, name


def _arc(
    start: tuple[float, float],
    end: tuple[float, float],
    to_centre: tuple[float, float],
    clockwise: bool,
) -> list[tuple[float, float]]:
    cx, cy = start[0] + to_centre[0], start[1] + to_centre[1]
    r = math.hypot(*to_centre)
    begin = math.atan2(start[1] - cy, start[0] - cx)
    turn = (math.atan2(end[1] - cy, end[0] - cx) - begin) % math.tau
    if clockwise:
        turn -= math.tau
    if abs(turn) < 1e-6:
        turn = -math.tau if clockwise else math.tau
    count = max(1, int(abs(turn) * r / ARC_STEP))
    angles = [begin + turn * k / count for k in range(1, count)]
    return [(cx + r * math.cos(t), cy + r * math.sin(t)) for t in angles] + [end]
