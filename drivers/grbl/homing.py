"""The way to a known position, and out of an alarm.

    unknown | alarm ──$H──> homing ──> homed;   homing ──no switch, a halt, its deadline──> alarm
    alarm ──$X──> unknown

Homing is not repeated by itself: a switch that was not found stays so.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.base.errors import DeviceError, DeviceGarbled, DeviceRefused, DeviceTimeout
from drivers.grbl import faults
from drivers.grbl import protocol as grbl
from drivers.grbl.condition import Condition, no_machine_position
from drivers.grbl.link import REPLY_S


class Homing:
    """See the module. `stop` ends what moves."""

    def __init__(self, condition: Condition, stop: Callable[[str], None]) -> None:
        self._condition = condition
        self._stop = stop
        self._under_way = False
        self._halted_by_reset = False

    def halt_byte(self) -> bytes:
        """From any thread: what ends a motion now. Homing ignores a feed hold."""
        self._halted_by_reset = self._under_way
        return grbl.RESET if self._under_way else grbl.HOLD

    def by_switches(self, timeout_s: float) -> None:
        """The controller's own cycle. It is silent meanwhile; after `timeout_s` it is reset."""
        condition, link = self._condition, self._condition.link
        self._clear_for("home")
        condition.lost()
        link.alarm = None
        self._halted_by_reset = False
        self._under_way = True
        try:
            link.command("$H", timeout_s, "home", watched=True)
            if link.alarm is not None:
                link.settle_alarm("home")
        except DeviceTimeout:
            self._under_way = False
            link.reset("home")
            raise DeviceTimeout(
                condition.device,
                "home",
                f"homing did not end within {timeout_s:g} s, and was stopped",
                "check that both axes turn; raise the time, or $25 (seek rate)",
            ) from None
        except DeviceGarbled:
            self._under_way = False
            link.reset("home")  # the count of its answers is wrong
            raise
        except DeviceError:
            if link.interrupted and not self._halted_by_reset:
                link.urge(grbl.RESET)  # the halt came before the `$H`: it has only held
            raise
        finally:
            self._under_way = False
        self._raise_alarm()
        report = condition.ask("home")
        if report.state != "Idle" or link.was_reset:
            raise DeviceRefused(
                condition.device, "home", f"it says {report.state} after homing", "home it again"
            )
        condition.settle("home")

    def here(self) -> None:
        """The place where it stands becomes the origin: for stages without switches."""
        condition, link = self._condition, self._condition.link
        self._clear_for("home")
        if condition.ask("home").state == "Alarm":  # the lock of a power-up or an alarm
            link.command("$X", REPLY_S, "home")
        link.alarm = None
        report = condition.ask("home")
        if report.position is None:
            raise no_machine_position(condition.device, "home")
        condition.offset = report.position
        condition.settle("home")

    def unlock(self) -> None:
        """Leave an alarm; the position stays unknown. Without one nothing is done, so that a
        motion goes on. Safe to send again."""
        condition, link = self._condition, self._condition.link
        link.await_banner("unlock")
        if link.alarm is None and condition.ask("unlock").state != "Alarm":
            return
        self._clear_for("unlock")
        link.command("$X", REPLY_S, "unlock")
        link.alarm = None
        condition.lost()

    def _clear_for(self, phase: str) -> None:
        """Bring it to where `$H` and `$X` are heard: nothing queued, no critical alarm."""
        condition, link = self._condition, self._condition.link
        condition.abandon()
        link.await_banner(phase)
        if faults.is_critical(link.alarm, link.firmware):
            condition.lost()
            link.reset(phase)  # it hears nothing else
            return
        if link.in_flight or condition.ask(phase).state not in {"Idle", "Alarm"}:
            self._stop(phase)

    def _raise_alarm(self) -> None:
        condition, link = self._condition, self._condition.link
        if link.alarm is None:
            return
        condition.lost()
        words, remedy = faults.alarm(link.alarm, link.firmware)
        try:
            pins = link.ask("home").pins
        except DeviceError:
            pins = ""
        closed = "".join(axis for axis in "XYZ" if axis in pins)
        seen = f"; closed now: {', '.join(closed)}" if closed else "; no switch is closed now"
        raise DeviceRefused(condition.device, "home", words + seen, remedy)
