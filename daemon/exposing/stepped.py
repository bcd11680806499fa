"""Software mode: show, trigger, and the next pattern while the last frame is read out.

For a pattern step the light is first this pattern's (`show` returns at that moment), then the
camera is triggered; the next pattern is drawn while the exposure lasts and flipped as soon as it
ends, so that readout and flip go on side by side:

    projector   |flip k|..........|flip k+1|..........
    camera             |expose k| readout k |expose k+1|
    here               | draw k+1 |          | look at k, draw k+2 |

What takes time here is done while a frame is exposed, never between two. For the exposures of a
bracket the light stays.

A frame counts only if its exposure lies wholly within the time in which its pattern was lit, by
the device's own time stamps, and if it looks like its pattern (`daemon.exposing.proof`). Repeating
is safe because a frame that is not recorded has no effect. Photographs are taken in the same way,
by a camera that needs no light.
"""

from __future__ import annotations

import contextlib
from concurrent.futures import Future
from dataclasses import dataclass, replace

import structlog

from daemon.devices.devicethread import Stuck
from daemon.exposing.apparatus import CALL_S, Apparatus, Lit
from daemon.exposing.exposer import Exposer
from daemon.exposing.ring import Buffer
from daemon.scans.method import Expose
from drivers.base.camera import Acquisition, Frame
from drivers.base.errors import DeviceGarbled, DeviceTimeout
from drivers.clock import NS

WAY = "software"

log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Exposure:
    """A frame that has been triggered, and from when it is read out the frame."""

    index: int
    step: Expose
    sub: int
    lit: Lit
    dark_ns: int  # until when the light was the pattern's; 0: it still is
    end_ns: int  # when the camera said that the exposure would end
    buffer: Buffer
    grab: Future[Frame]
    attempt: int
    frame: Frame | None = None


class Stepped(Exposer):
    """See the module."""

    def __init__(self, apparatus: Apparatus) -> None:
        self._apparatus = apparatus
        self._pending: _Exposure | None = None  # exposed or being read out
        self._read: _Exposure | None = None  # read out, and not yet looked at

    def expose(self, index: int, step: Expose, first: int) -> tuple[int, int]:
        """See Exposer."""
        apparatus = self._apparatus
        if first < step.frames:
            if apparatus.needs_exposure(step.exposure_us):
                self.settle()  # what is being read out was exposed as before
                apparatus.set_exposure(step.exposure_us)
            if apparatus.lit is not None and _next_of_bracket(apparatus.lit.step, step):
                # The light is this step's already.
                apparatus.lit = replace(apparatus.lit, step=step)
            else:
                apparatus.acquire(Acquisition.SOFTWARE)
                self._light(step)
        for sub in range(first, step.frames):
            self._read_out()
            if apparatus.control.paused:
                self._hand_on()
            # The frames of a long step would fill the ring while the disk is full.
            apparatus.checkpoint()
            self._pending = self._trigger(index, step, sub, attempt=1)
            self._hand_on()
            if sub + 1 == step.frames:
                apparatus.draw_ahead(index + 1)
            self._await_exposure(self._pending)
        return index + 1, 0

    def settle(self) -> None:
        """See what is under way to its end: recorded, repeated, or missing."""
        self._read_out()
        self._hand_on()

    def _light(self, step: Expose) -> Lit:
        if self._pending is not None:
            self._pending.dark_ns = self._apparatus.clock.now_ns()
        return self._apparatus.light(step)

    def _trigger(self, index: int, step: Expose, sub: int, attempt: int) -> _Exposure:
        apparatus = self._apparatus
        buffer = apparatus.buffer()
        apparatus.acquire(Acquisition.SOFTWARE)
        lit = apparatus.lit
        if lit is None or lit.step is not step:  # an earlier pattern was shown again, or a pause
            lit = self._light(step)
        if apparatus.projector is not None:
            apparatus.clock.wait_until(
                lit.from_ns + round(step.delay_s * NS), apparatus.session.ended
            )
            apparatus.session.check()
        _, end_ns = apparatus.camera.call(lambda c: c.trigger(), CALL_S, apparatus.session)
        timeout_s = apparatus.frame_deadline()
        grab = apparatus.camera.submit(
            lambda c: c.grab(buffer, timeout_s), timeout_s + CALL_S, apparatus.session
        )
        return _Exposure(
            index, step, sub, lit, 0, end_ns + apparatus.rolling_ns, buffer, grab, attempt
        )

    def _await_exposure(self, exposure: _Exposure) -> None:
        """Wait for the end of the exposure, not of the readout: then the light may change."""
        if self._apparatus.projector is not None:
            self._apparatus.clock.wait_until(exposure.end_ns, self._apparatus.session.ended)
        self._apparatus.session.check()

    def _read_out(self) -> None:
        """Wait for the frame that was triggered; it is exposed again where it is late or partial.

        By the device's word and time stamps only: how it looks is `_hand_on`'s question.
        """
        apparatus = self._apparatus
        while (exposure := self._pending) is not None:
            apparatus.may_go_on()
            try:
                exposure.frame = apparatus.camera.wait(
                    exposure.grab, apparatus.frame_deadline() + CALL_S
                )
                problem = self._out_of_light(exposure, exposure.frame)
            except Stuck:
                raise
            except (DeviceTimeout, DeviceGarbled) as error:
                problem = str(error)
            self._pending = None
            if problem:
                self._again(exposure, problem)
            else:
                self._read = exposure

    def _hand_on(self) -> None:
        """Hand on what was read out, exposed again until it looks like its pattern.

        The next frame may have been triggered meanwhile. After a doubtful one it is not trusted,
        and triggered anew.
        """
        apparatus = self._apparatus
        later: _Exposure | None = None
        while (exposure := self._read) is not None:
            self._read = None
            assert exposure.frame is not None
            problem = self._look(exposure, exposure.frame)
            if not problem:
                index, step, sub = exposure.index, exposure.step, exposure.sub
                lit_ns = exposure.lit.from_ns
                apparatus.put(
                    index, step, sub, exposure.frame, exposure.buffer, way=WAY, lit_ns=lit_ns
                )
                break
            later = self._called_off() or later
            self._again(exposure, problem)
            self._read_out()
        if later is not None:
            self._pending = self._trigger(later.index, later.step, later.sub, later.attempt)

    def _called_off(self) -> _Exposure | None:
        """The exposure under way, if there is one; nothing becomes of it."""
        exposure, self._pending = self._pending, None
        if exposure is not None:
            with contextlib.suppress(DeviceTimeout, DeviceGarbled):  # it would not have counted
                self._apparatus.camera.wait(
                    exposure.grab, self._apparatus.frame_deadline() + CALL_S
                )
            self._apparatus.ring.give(exposure.buffer)
        return exposure

    def _again(self, exposure: _Exposure, problem: str) -> None:
        """Expose a step once more, or record its frame as missing."""
        apparatus = self._apparatus
        index, step, sub = exposure.index, exposure.step, exposure.sub
        apparatus.ring.give(exposure.buffer)
        # After a doubtful frame nothing in the camera's queue can be trusted: empty it.
        apparatus.stop()
        apparatus.acquire(Acquisition.SOFTWARE)
        if exposure.attempt < apparatus.patience.attempts:
            apparatus.count("repeated")
            log.warning(
                "frame exposed again",
                step=index,
                sub=sub,
                attempt=exposure.attempt,
                problem=problem,
            )
            self._light(step)
            self._pending = self._trigger(index, step, sub, exposure.attempt + 1)
            self._await_exposure(self._pending)
        else:
            apparatus.miss(index, step, sub, problem)

    def _out_of_light(self, exposure: _Exposure, frame: Frame) -> str:
        """Why the frame may show more or less than its pattern, by its time stamps; or ""."""
        if frame.incomplete:
            return "the frame is incomplete"
        if self._apparatus.projector is None:
            return ""
        return self._apparatus.out_of_light(frame, exposure.lit.from_ns, exposure.dark_ns)

    def _look(self, exposure: _Exposure, frame: Frame) -> str:
        """Why the frame does not look like its pattern; "" if it does, or has none."""
        looks = self._apparatus.looks
        if looks is None or self._apparatus.projector is None:
            return ""
        return looks.problem(frame.pixels, exposure.step, exposure.lit.look)


def _next_of_bracket(lit: Expose, step: Expose) -> bool:
    """Whether a step shows what the one before it shows, for another exposure of one bracket."""
    same = (lit.pattern, lit.lighting, lit.index) == (step.pattern, step.lighting, step.index)
    return same and lit.exposure != step.exposure
