"""What is known of the stage: alarms, resets behind its back, where it is and whether it moves.

What comes unasked has its consequences here, at the beginning of each call and after each answer:
an alarm, a reset, a lost acknowledgement and a lost line make the position unknown, and nothing
moves before it was homed again.
"""

from __future__ import annotations

import math
from collections import deque

from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.stage import StageState, StageStatus
from drivers.clock import NS, Clock
from drivers.grbl import faults
from drivers.grbl.link import REPLY_S, GrblLink
from drivers.grbl.motion import MODES, Stream
from drivers.grbl.protocol import Report
from drivers.track import Arc, Point, Track

STALL_S = 2.0  # it says that it runs, and its position has not changed
LATE_S = 0.1  # a report may have waited for so long on its way
NEAR_MM = 0.5


def stands(report: Report) -> bool:
    """Whether it says by itself that nothing moves (Idle aside: a motion may be about to begin)."""
    if report.state == "Hold":
        return report.substate == 0
    if report.state == "Door":
        return report.substate in {0, 1}
    return report.state in {"Alarm", "Sleep", "Check", "Tool"}


class Condition:
    """See the module. `offset` is the machine position of the stage's origin, mm."""

    def __init__(self, link: GrblLink, stream: Stream, clock: Clock, offset: Point) -> None:
        self.link = link
        self.stream = stream
        self.clock = clock
        self.device = link.port.device
        self.offset = offset
        self.homed = False
        self.travelling = False  # from the first line of a motion until it is known to rest
        self.fastest_mm_s = math.inf
        self.arcs: deque[Arc] = deque(maxlen=4)  # those of lines that may be under way
        self.track = Track()
        self._believed: Report | None = None
        self._doubted: Report | None = None
        self._last_position: Point | None = None
        self._still_since_ns: int | None = None
        link.on_report = self._on_report
        link.on_lost = self.lost
        link.believes = self._believes

    # ------------------------------------------------------------ what came unasked

    def begin(self, phase: str) -> None:
        """What every call begins with."""
        self.link.begin(phase)
        self.notice(phase)

    def notice(self, phase: str) -> None:
        """Draw the consequences of what came unasked."""
        if self.link.alarm is not None:
            self.lost()
        if self.link.was_reset:
            self.lost()
            raise DeviceLost(
                self.device,
                phase,
                "the controller was reset (a power dip, its button, or another program)",
                "it has to be connected and homed again",
            )
        if self.link.lost_acknowledgement:
            self.lost()
            self.link.reset(phase)
            raise DeviceGarbled(
                self.device,
                phase,
                "an acknowledgement was lost on the line: which motions were made is not known",
                "check cable and interference, then `umbra stage home`",
            )

    def lost(self) -> None:
        """The position is unknown from now on."""
        self.homed = False
        self._believed = self._doubted = None
        self.track.forget()
        self.arcs.clear()
        self.abandon()

    def abandon(self) -> None:
        """Forget motions that are not sent yet."""
        self.stream.clear()
        self.travelling = False
        self._still_since_ns = None

    def raise_alarm(self, phase: str) -> None:
        """DeviceRefused while there is an alarm."""
        if self.link.alarm is not None:
            problem, remedy = faults.alarm(self.link.alarm, self.link.firmware)
            raise DeviceRefused(self.device, phase, problem, remedy)

    def raise_stall(self, phase: str) -> None:
        """DeviceTimeout when it has said for `STALL_S` that it runs, and stood."""
        since, report = self._still_since_ns, self.link.report
        if since is not None and report is not None and report.at_ns - since > STALL_S * NS:
            raise DeviceTimeout(
                self.device,
                phase,
                f"it says {report.state} and has not moved for {STALL_S:g} s",
                "reset the controller, then `umbra stage home`",
            )

    def ask(self, phase: str) -> Report:
        """A fresh report, and what follows from it; the last one where an alarm silences it."""
        try:
            report = self.link.ask(phase)
        except DeviceTimeout:
            self.notice(phase)
            if self.link.alarm is None:
                raise
            assert self.link.report is not None
            return self.link.report
        self.notice(phase)
        return report

    # ------------------------------------------------------------ where it is

    def settle(self, phase: str) -> None:
        """Homed: modes set, and the position known from a fresh report on."""
        self.link.command(MODES, REPLY_S, phase)
        self._believed = self._doubted = None
        self.homed = True
        for _ in range(40):  # WCO, where it is needed, comes with every 30th report at least
            if self.ask(phase).position is not None:
                return
        self.homed = False
        raise no_machine_position(self.device, phase)

    def depart(self) -> None:
        """A motion begins now."""
        self.track.depart(self.clock.now_ns())
        self._still_since_ns = None
        self.travelling = True

    def machine(self, point: Point) -> Point:
        """A point of the stage in the controller's coordinates."""
        return point[0] + self.offset[0], point[1] + self.offset[1]

    def _ours(self, machine: Point) -> Point:
        return machine[0] - self.offset[0], machine[1] - self.offset[1]

    @property
    def at_rest(self) -> bool:
        """Whether everything was sent and made."""
        return self.stream.empty and (self.link.quiet or not self.travelling)

    def status(self) -> StageStatus:
        """From the last report; no I/O."""
        report, link = self.link.report, self.link
        at_ns = report.at_ns if report else self.clock.now_ns()
        if link.alarm is not None:
            words, remedy = faults.alarm(link.alarm, link.firmware)
            return StageStatus(StageState.ALARM, None, at_ns, f"{words}; {remedy}")
        if report is None or not self.homed:
            return StageStatus(
                StageState.UNKNOWN, None, at_ns, "its position is not known: home it"
            )
        detail = ""
        if stands(report):
            state = StageState.HELD
            if report.state == "Door":
                detail = "the safety door is open" if report.substate else "the door was opened"
            elif report.state == "Tool":
                detail = "it waits for a tool change"
        elif report.state == "Idle" and self.at_rest:
            state = StageState.IDLE
        else:
            state = StageState.MOVING
        position = None if report.position is None else self._ours(report.position)
        return StageStatus(state, position, at_ns, detail)

    def _believes(self, report: Report) -> bool:
        """Whether it can be there: reports carry no checksum, and a wrong digit is a wrong place.

        Doubted is a position which the fastest feed could not have reached since the last, on
        both axes and late; a second report that bears a doubted one out is believed.
        """
        if not self.homed or report.position is None or self._near(self._believed, report):
            believed = True
        else:
            believed = self._doubted is not None and self._near(self._doubted, report)
        self._doubted = None if believed else report
        if believed and report.position is not None:
            self._believed = report
        return believed

    def _near(self, before: Report | None, report: Report) -> bool:
        if before is None or before.position is None or report.position is None:
            return True
        seconds = (report.at_ns - before.at_ns) / NS + LATE_S
        way = math.dist(before.position, report.position)
        return way <= NEAR_MM + 2 * self.fastest_mm_s * seconds

    def _on_report(self, report: Report) -> None:
        if report.position is None or not self.homed:
            return
        if report.state in {"Alarm", "Sleep"}:
            self.link.alarm = self.link.alarm or report.substate or 0
            self.lost()
            return
        self._watch(report)
        point = self._ours(report.position)
        at_rest = self.at_rest or stands(report)
        arc = next((a for a in self.arcs if a.holds(point)), None)
        self.track.add(report.at_ns, point, speed=report.speed or 0.0, arc=arc, at_rest=at_rest)
        if at_rest and report.state == "Idle":
            self.travelling = False
            self.arcs.clear()

    def _watch(self, report: Report) -> None:
        """Since when it has said that it runs, and stood."""
        last, self._last_position = self._last_position, report.position
        if report.state not in {"Run", "Jog"} or report.position != last:
            self._still_since_ns = None
        elif self._still_since_ns is None:
            self._still_since_ns = report.at_ns


def no_machine_position(device: str, phase: str) -> DeviceRefused:
    """What a controller that reports work coordinates without their offset is told."""
    return DeviceRefused(
        device, phase, "it reports work coordinates only", "set $10=1 (machine position)"
    )
