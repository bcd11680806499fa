"""Hold, resume, stop: every way to a stand, and which of them keeps the position.

Safe to send again, all of them: a hold at a stand holds, a reset at a stand loses no step.
"""

from __future__ import annotations

import math

from drivers.base.errors import DeviceRefused, DeviceTimeout
from drivers.clock import NS
from drivers.grbl import protocol as grbl
from drivers.grbl.condition import Condition, stands

KEPT_MM = 0.002  # a position is reported to .001 mm: this near is the same
SETTLE_S = 1.0  # a hold, beyond the time of its deceleration
AGAIN_S = 0.25  # a hold that shows no effect for so long may have been lost on the line


def stand(condition: Condition, phase: str, deceleration_s: float) -> grbl.Report:
    """Decelerate to a stand; the report that proves it. A jog ends in Idle, others in Hold.

    A hold cancels a jog as well. Grbl's own jog cancel (0x85) is not sent: one that comes while the
    jog ends leaves Grbl 1.1 idle, and deaf to every line until it is resumed or reset. A second
    hold at that moment is harmless, for it shows as Hold.

    Raises DeviceTimeout after the deceleration's time and `SETTLE_S` more.
    """
    link, clock = condition.link, condition.clock
    sent = condition.travelling or link.in_flight > 0
    again_ns = began_ns = clock.now_ns()
    if sent:
        link.realtime(grbl.HOLD)
        again_ns += round(AGAIN_S * NS)
    idle = 0
    while True:
        report = condition.ask(phase)
        if link.alarm is not None or stands(report):
            return report
        # a report can overtake the hold that was sent before it: one Idle proves nothing
        idle += report.state == "Idle"
        if report.state == "Idle" and (not sent or idle > 1):
            return report
        now_ns = clock.now_ns()
        if now_ns - began_ns > (SETTLE_S + deceleration_s) * NS:
            raise DeviceTimeout(
                condition.device, phase, "it does not come to a stand", "switch its power off"
            )
        if report.state in {"Run", "Jog"} and now_ns >= again_ns:
            link.realtime(grbl.HOLD)
            sent, again_ns = True, now_ns + round(AGAIN_S * NS)


def resume(condition: Condition, phase: str) -> None:
    """Go on after a hold. DeviceRefused where a door or a button keeps holding it."""
    report = condition.ask(phase)
    for _ in range(3):
        if report.state not in {"Hold", "Door"}:
            return
        condition.depart()
        condition.link.realtime(grbl.RESUME)
        report = condition.ask(phase)
    if report.state in {"Hold", "Door"}:
        raise DeviceRefused(
            condition.device,
            phase,
            "it stays held" + (" by the safety door" if report.state == "Door" else ""),
            "close the door, release the hold button",
        )


def stop(condition: Condition, phase: str, deceleration_s: float) -> None:
    """End every motion: decelerate, drop what is queued, hold by the motors.

    A feed hold is waited for and the buffers are then emptied by a reset. The position stays known
    if the controller says so: held before, no alarm and the same position after. In any other case
    it is unknown.
    """
    link = condition.link
    condition.stream.clear()
    if link.alarm is not None:
        return
    before = stand(condition, phase, deceleration_s)
    if link.alarm is not None:
        return
    if before.state == "Idle" and not link.in_flight:
        condition.abandon()
        return
    known = condition.homed and before.state == "Hold" and before.substate == 0
    condition.homed = False
    link.reset(phase)
    after = condition.ask(phase)
    condition.abandon()
    if link.alarm is not None or not known or after.state != "Idle":
        condition.lost()
        return
    assert before.position is not None
    if after.position is None or math.dist(before.position, after.position) > KEPT_MM:
        condition.lost()
        return
    condition.settle(phase)
