"""Free-running mode: the camera streams at its own rate, and nothing triggers it.

    projector   |flip k      ...            |flip k+1
    camera      ==|===|===|===|  |===|===|===|===|===|
                 ^ saw k-1, too   ^ wholly k: taken

Of the frames that come, one is a pattern's if its exposure, to the end of its last row, began after
the light was wholly the pattern's (the flip's time stamp, and the latency with its spread as
calibrated). The light changes only when all frames of the pattern are here, so its end needs no
proof. Frames that began before, that came before and frames that the camera lost cost time only.
A frame that does not look like its pattern, and a stream that gives no wholly lit frame in time,
begin anew with the flip, `attempts` times in all; then there is a missing record.
"""

from __future__ import annotations

import structlog

from daemon.devices.devicethread import Stuck
from daemon.exposing.apparatus import CALL_S, Apparatus, Lit
from daemon.exposing.exposer import Exposer
from daemon.exposing.ring import Buffer
from daemon.scans.method import Expose
from drivers.base.camera import Acquisition, Frame
from drivers.base.errors import DeviceGarbled, DeviceTimeout
from drivers.clock import NS

WAY = "free"
_FRAMES = 4
"""Frames' times, beyond `frame_timeout_s`, within which one must be wholly lit."""

log = structlog.get_logger(__name__)


class Streamed(Exposer):
    """See the module."""

    def __init__(self, apparatus: Apparatus) -> None:
        self._apparatus = apparatus
        self._seen: int | None = None  # number of the last frame since the stream began
        self._after_ns = 0  # end of the last frame that was taken

    def expose(self, index: int, step: Expose, first: int) -> tuple[int, int]:
        """See Exposer."""
        apparatus = self._apparatus
        if first >= step.frames:
            return index + 1, 0
        apparatus.set_exposure(step.exposure_us)
        lit = self._light(step)
        apparatus.draw_ahead(index + 1)
        for sub in range(first, step.frames):
            for attempt in range(1, apparatus.patience.attempts + 1):
                apparatus.may_go_on()
                apparatus.checkpoint()  # the frames of a long step would fill the ring and the disk
                buffer = apparatus.buffer()
                if apparatus.lit is not lit:
                    lit = self._light(step)
                frame, problem = self._take(buffer, step, lit)
                if frame is not None and not problem:
                    apparatus.put(index, step, sub, frame, buffer, way=WAY, lit_ns=lit.from_ns)
                    break
                apparatus.ring.give(buffer)
                if frame is None:
                    apparatus.stop()  # a stream that gave nothing begins anew
                if attempt == apparatus.patience.attempts:
                    apparatus.miss(index, step, sub, problem)
                    break
                apparatus.count("repeated")
                log.warning(
                    "frame exposed again", step=index, sub=sub, attempt=attempt, problem=problem
                )
                lit = self._light(step)
        return index + 1, 0

    def _light(self, step: Expose) -> Lit:
        """Make the light this step's, before a camera that streams."""
        apparatus = self._apparatus
        if apparatus.acquire(Acquisition.FREE):
            self._seen = None
        return apparatus.light(step)

    def _take(self, buffer: Buffer, step: Expose, lit: Lit) -> tuple[Frame | None, str]:
        """The next frame that is wholly of this light, and what is wrong with how it looks; None,
        and why there was none."""
        apparatus = self._apparatus
        from_ns = max(lit.from_ns + round(step.delay_s * NS), self._after_ns)
        deadline = max(apparatus.clock.now_ns(), from_ns) + round(self._patience_s() * NS)
        passed = 0
        while apparatus.clock.now_ns() < deadline:
            apparatus.may_go_on()
            apparatus.session.check()
            try:
                frame = self._grab(buffer)
            except Stuck:
                raise
            except (DeviceTimeout, DeviceGarbled) as error:
                return None, str(error)
            stale = self._seen is not None and frame.sequence <= self._seen
            if not stale:
                self._seen = frame.sequence
            if stale or frame.incomplete or apparatus.out_of_light(frame, from_ns, 0):
                passed += 1
                continue
            self._after_ns = frame.end_ns
            if passed:
                apparatus.count("passed", passed)
            if apparatus.looks is None or apparatus.projector is None:
                return frame, ""
            return frame, apparatus.looks.problem(frame.pixels, step, lit.look)
        return None, (
            f"none of {passed} frames in {self._patience_s():.2f} s was wholly lit by its pattern: "
            "are the camera's time stamps those of its exposures, and is no frame incomplete? "
            "`umbra doctor`, `umbra calibrate latency`"
        )

    def _patience_s(self) -> float:
        """Within which a wholly lit frame must have come."""
        apparatus = self._apparatus
        settings, info = apparatus.camera.device.settings(), apparatus.info
        rates = (info.max_rate_hz, settings.frame_rate_hz or 0.0)
        slowest_s = max([1 / rate for rate in rates if rate], default=0.0)
        frame_s = max(slowest_s, apparatus.exposure_us * 1e-6 + info.rolling_s)
        return _FRAMES * frame_s + info.readout_s + apparatus.patience.frame_timeout_s

    def _grab(self, buffer: Buffer) -> Frame:
        apparatus = self._apparatus
        timeout_s = self._patience_s()
        return apparatus.camera.call(
            lambda c: c.grab(buffer, timeout_s), timeout_s + CALL_S, apparatus.session
        )
