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
        self._its = apparatus
        self._seen: int | None = None  # number of the last frame since the stream began
        self._after_ns = 0  # end of the last frame that was taken

    def expose(self, index: int, step: Expose, first: int) -> tuple[int, int]:
        """See Exposer."""
        its = self._its
        if first >= step.frames:
            return index + 1, 0
        its.set_exposure(step.exposure_us)
        lit = self._light(step)
        its.draw_ahead(index + 1)
        for sub in range(first, step.frames):
            for attempt in range(1, its.patience.attempts + 1):
                its.may_go_on()
                its.checkpoint()  # the frames of a long step would fill the ring and the disk
                buffer = its.buffer()
                if its.lit is not lit:
                    lit = self._light(step)
                frame, problem = self._take(buffer, step, lit)
                if frame is not None and not problem:
                    its.put(index, step, sub, frame, buffer, way=WAY, lit_ns=lit.from_ns)
                    break
                its.ring.give(buffer)
                if frame is None:
                    its.stop()  # a stream that gave nothing begins anew
                if attempt == its.patience.attempts:
                    its.miss(index, step, sub, problem)
                    break
                its.count("repeated")
                log.warning(
                    "frame exposed again", step=index, sub=sub, attempt=attempt, problem=problem
                )
                lit = self._light(step)
        return index + 1, 0

    def _light(self, step: Expose) -> Lit:
        """Make the light this step's, before a camera that streams."""
        its = self._its
        if its.acquire(Acquisition.FREE):
            self._seen = None
        return its.light(step)

    def _take(self, buffer: Buffer, step: Expose, lit: Lit) -> tuple[Frame | None, str]:
        """The next frame that is wholly of this light, and what is wrong with how it looks; None,
        and why there was none."""
        its = self._its
        from_ns = max(lit.from_ns + round(step.delay_s * NS), self._after_ns)
        deadline = max(its.clock.now_ns(), from_ns) + round(self._patience_s() * NS)
        passed = 0
        while its.clock.now_ns() < deadline:
            its.may_go_on()
            its.session.check()
            try:
                frame = self._grab(buffer)
            except Stuck:
                raise
            except (DeviceTimeout, DeviceGarbled) as error:
                return None, str(error)
            stale = self._seen is not None and frame.sequence <= self._seen
            if not stale:
                self._seen = frame.sequence
            if stale or frame.incomplete or its.out_of_light(frame, from_ns, 0):
                passed += 1
                continue
            self._after_ns = frame.end_ns
            if passed:
                its.count("passed", passed)
            if its.looks is None or its.projector is None:
                return frame, ""
            return frame, its.looks.problem(frame.pixels, step, lit.look)
        return None, (
            f"none of {passed} frames in {self._patience_s():.2f} s was wholly lit by its pattern: "
            "are the camera's time stamps those of its exposures, and is no frame incomplete? "
            "`umbra doctor`, `umbra calibrate latency`"
        )

    def _patience_s(self) -> float:
        """Within which a wholly lit frame must have come."""
        its = self._its
        settings, info = its.camera.device.settings(), its.info
        rates = (info.max_rate_hz, settings.frame_rate_hz or 0.0)
        slowest_s = max([1 / rate for rate in rates if rate], default=0.0)
        frame_s = max(slowest_s, its.exposure_us * 1e-6 + info.rolling_s)
        return _FRAMES * frame_s + info.readout_s + its.patience.frame_timeout_s

    def _grab(self, buffer: Buffer) -> Frame:
        its = self._its
        timeout_s = self._patience_s()
        return its.camera.call(lambda c: c.grab(buffer, timeout_s), timeout_s + CALL_S, its.session)
