"""The step loop: asks the method for the next step, and has it exposed, in step, with no fixed
sleeps.

How pattern steps are exposed is chosen once a run (`daemon.exposing.modes`): the projector times
whole sequences, or each step is shown and triggered, or the camera runs free. A video step is
exposed in one way only. Between two steps a run can be paused; after the last one it is dark, the
camera is stopped, and its exposure is as it was before.
"""

from __future__ import annotations

import math

from daemon.exposing.apparatus import Apparatus
from daemon.exposing.exposer import Exposer
from daemon.exposing.modes import Choice, Mode
from daemon.exposing.ring import Ring
from daemon.exposing.sequences import Sequences
from daemon.exposing.stepped import Stepped
from daemon.exposing.streamed import Streamed
from daemon.exposing.video import Video
from daemon.scans.method import Bench, Digest, Expose, Watch
from drivers.base.errors import DeviceError

_SEQUENCE_BYTES = 256 << 20
"""Memory for the frames of hardware-timed sequences, where fewer are asked for."""


def exposer_for(choice: Choice, apparatus: Apparatus) -> Exposer:
    """The way of exposing that a choice names."""
    triggers = apparatus.info.triggers
    if choice.mode is Mode.FREE:
        return Streamed(apparatus)
    if choice.mode is not Mode.HARDWARE:
        return Stepped(apparatus)
    single: Exposer | None = None
    if "software" in triggers:
        single = Stepped(apparatus)
    elif "none" in triggers:
        single = Streamed(apparatus)
    return Sequences(apparatus, single, strict=choice.strict)


def ring_for(choice: Choice, bench: Bench, planned: int | None, least: int) -> Ring:
    """The ring of a run that exposes in this way, of `least` frames or more: of a sequence all
    frames are kept until it is known to be in step, while the one before is being recorded."""
    info, limits = bench.camera, bench.projector.sequence if bench.projector else None
    count = least
    if choice.mode is Mode.HARDWARE and limits is not None:
        frame_bytes = math.prod(info.shape) * info.pixel_format.dtype.itemsize
        wanted = 2 * min(limits.images, planned or limits.images)
        count = max(count, min(wanted, _SEQUENCE_BYTES // frame_bytes))
    return Ring(count, info.shape, info.pixel_format.dtype)


class Sequencer:
    """One scan in its course, in the thread that calls `run`."""

    def __init__(self, apparatus: Apparatus, exposer: Exposer) -> None:
        self._apparatus = apparatus
        self._exposer = exposer
        self._video = Video(apparatus)
        self.reason = "all steps were exposed"

    def run(self, index: int, sub: int) -> None:
        """All steps from `index`/`sub` on.

        Raises Revoked (abort), DeviceError, Behind, or what the recorder raises.
        """
        apparatus = self._apparatus
        try:
            while (step := apparatus.method.step(index, apparatus.recorder.summary)) is not None:
                apparatus.may_go_on()
                if apparatus.control.paused:
                    self._exposer.settle()
                apparatus.checkpoint()
                if isinstance(step, Expose):
                    index, sub = self._exposer.expose(index, step, sub)
                    continue
                self._exposer.settle()
                if isinstance(step, Digest):
                    self._digest()
                else:
                    self._watch(index, step, sub)
                index, sub = index + 1, 0
            self._exposer.settle()
        except DeviceError:
            raise  # the device that failed is named, not the stop that must fail after it
        except BaseException:
            self._stop()
            raise
        self._stop()

    def _watch(self, index: int, step: Watch, sub: int) -> None:
        if reason := self._video.watch(index, step, sub):
            self.reason = reason

    def _digest(self) -> None:
        """Wait until the estimator knows every frame so far."""
        recorder = self._apparatus.recorder
        self._apparatus.when_recorded(lambda seconds: recorder.digested(seconds) or None)

    def _stop(self) -> None:
        """Nothing more is exposed, and the recorder may wait long for room: not in this light."""
        if not self._apparatus.session.ended.is_set():
            self._apparatus.rest()
            self._apparatus.set_exposure(None)
