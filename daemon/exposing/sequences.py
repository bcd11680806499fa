"""Hardware mode: the projector times whole sequences and triggers the camera through them.

    projector   |white|black|   0|   1| ... | n-1|dark
    pulses      |     |     |    |    |     |
    camera       ===   ===   ===  ===   ...  ===     and one more grab, that must give nothing

Consecutive steps become one sequence, as long as projector and ring allow; the host only collects.
That frame k shows image k is proven three times: there are exactly as many frames as images, none
lost on its way, one period apart by the camera's own clock (drivers.sequence); the white and the
black image at its head look bright and dark, so that the light is not a period late or early; and
each frame looks like its pattern (daemon.exposing.proof). Frames are handed on only when all holds.
Otherwise the whole sequence is run again, `attempts` times in all, each at half the pace of the one
before, for a host that cannot take frames as fast as its camera gives them loses some; then each of
its frames is an explicit missing record. When no pulse ever gave a frame, the run fails: that is
wiring.

A pause calls a sequence off at once, and it is run again after it; so does a resumed run begin at
the first frame that was not recorded. A step that no sequence can hold (a dark projector, a delay,
grey levels where sequences are black and white) is exposed by itself, as in `single`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from dataclasses import replace

import numpy as np
import structlog

from daemon.devices.devicethread import Stuck
from daemon.exposing.apparatus import CALL_S, LOOK_S, SHOW_S, Apparatus
from daemon.exposing.batches import Batches, Shot
from daemon.exposing.exposer import Exposer
from daemon.exposing.modes import GUARDS
from daemon.exposing.proof import Proof, head_problem
from daemon.exposing.ring import Buffer
from daemon.scans.method import Expose, Unsuitable
from drivers.base.camera import Acquisition, Camera, Frame
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceRefused, DeviceTimeout
from drivers.base.projector import LoadedSequence
from drivers.sequence import mismatch

WAY = "hardware"
_LOAD_S = 30.0  # deadline of loading a sequence's images
_START_S = 1.0  # from `run` to the first pulse, beyond a frame's own deadline
_BEYOND = 1.5  # periods after the last frame in which none may come

log = structlog.get_logger(__name__)


class _CalledOff(Exception):
    """A pause was asked for in the middle of a sequence."""


class Sequences(Exposer):
    """See the module."""

    def __init__(self, apparatus: Apparatus, single: Exposer | None, *, strict: bool) -> None:
        """`single` exposes what no sequence can hold (None: the camera cannot); where hardware mode
        was asked for by name (`strict`), only what is not a matter of settings."""
        assert apparatus.projector is not None
        limits = apparatus.projector.device.info().sequence
        assert limits is not None
        self._apparatus = apparatus
        self._single = single
        self._strict = strict
        self._projector = apparatus.projector
        self._batches = Batches(apparatus, limits, strict=strict)

    def settle(self) -> None:
        """See Exposer."""
        if self._single is not None:
            self._single.settle()

    def expose(self, index: int, step: Expose, first: int) -> tuple[int, int]:
        """See Exposer."""
        if first >= step.frames:
            return index + 1, 0
        at = (index, first)
        shots = self._batches.take(at)
        if not shots or (len(shots) <= GUARDS and self._single is not None):
            return self._alone(index, step, first)  # a sequence would be more guards than frames
        self.settle()
        self._apparatus.set_exposure(step.exposure_us)
        try:
            return self._sequence(shots)
        except _CalledOff:
            return at
        except DeviceRefused as error:
            return self._refused(error, at, step, len(shots))

    def _refused(
        self, error: DeviceRefused, at: tuple[int, int], step: Expose, frames: int
    ) -> tuple[int, int]:
        """The projector will not have a sequence of so many frames: shorter, else one by one."""
        if error.device != self._projector.device.name or error.phase != "load":
            raise error
        if frames > 1:
            self._batches.shorten(frames // 2, error.problem)
            return at
        if self._strict:
            raise error
        self._batches.tell(str(error))
        return self._alone(at[0], step, at[1])

    def _alone(self, index: int, step: Expose, first: int) -> tuple[int, int]:
        if self._single is None:
            raise Unsuitable(
                "a step needs a frame by itself, and the camera can only be triggered by the "
                "projector's sequences"
            )
        return self._single.expose(index, step, first)

    # ------------------------------------------------------------ one sequence

    def _sequence(self, shots: list[Shot]) -> tuple[int, int]:
        apparatus = self._apparatus
        guards = self._batches.guards()
        shape, dtype = apparatus.info.shape, apparatus.info.pixel_format.dtype
        scratch = [np.empty(shape, dtype) for _ in guards]
        buffers: list[Buffer] = []
        try:
            while len(buffers) < len(shots):
                buffers.append(apparatus.buffer())
            apparatus.lit = None
            apparatus.acquire(Acquisition.HARDWARE)
            loaded = self._load([*guards, *shots])
            for attempt in range(1, apparatus.patience.attempts + 1):
                apparatus.may_go_on()
                found, problem = self._attempt(
                    loaded, [*guards, *shots], [*scratch, *buffers, scratch[0]]
                )
                if not problem:
                    for shot, frame in zip(shots, found[len(guards) :], strict=True):
                        buffer = buffers.pop(0)
                        apparatus.put(shot.index, shot.step, shot.sub, frame, buffer, way=WAY)
                    return _after(shots[-1])
                apparatus.count("repeated")
                log.warning(
                    "sequence exposed again"
                    if attempt < apparatus.patience.attempts
                    else "given up",
                    step=shots[0].index,
                    images=loaded.images,
                    attempt=attempt,
                    problem=problem,
                )
                if attempt < apparatus.patience.attempts:
                    self._batches.slow_down()
                    apparatus.acquire(Acquisition.HARDWARE)
                    loaded = self._load([*guards, *shots])
            if not found:
                raise self._nothing_came(loaded)
            for shot in shots:
                apparatus.miss(shot.index, shot.step, shot.sub, problem)
            return _after(shots[-1])
        finally:
            for buffer in buffers:
                apparatus.ring.give(buffer)

    def _load(self, shots: Sequence[Shot]) -> LoadedSequence:
        images = [shot.drawing.image for shot in shots]
        period_us = self._batches.pace(shots[-1].step).period_us
        return self._projector.call(
            lambda p: p.load(images, period_us, period_us), _LOAD_S, self._apparatus.session
        )

    def _attempt(
        self, loaded: LoadedSequence, shots: Sequence[Shot], buffers: Sequence[Buffer]
    ) -> tuple[list[Frame], str]:
        """Run the sequence once: the frames that came, and why they are not its images, or "".

        `buffers` are one more than images: into the last one nothing may come.
        Raises _CalledOff. Whatever happens, no pulse and no grab is left behind, and after a
        failure the camera is stopped.
        """
        apparatus = self._apparatus
        off = threading.Event()
        first_s = apparatus.frame_deadline() + _START_S
        waits = [first_s] + [apparatus.frame_deadline()] * (len(shots) - 1)
        waits.append(_BEYOND * loaded.period_us * 1e-6)
        grabs = [
            self._grab(buffer, wait_s, off) for buffer, wait_s in zip(buffers, waits, strict=True)
        ]
        frames: list[Frame] = []
        problem = "it was not run to its end"
        try:
            began_ns = self._projector.call(lambda p: p.run(), SHOW_S, apparatus.session)
            self._batches.prepare(_after(shots[-1]))  # while this one is exposed
            judges = apparatus.looks.fork() if apparatus.looks is not None else None
            *awaited, beyond = zip(grabs, waits, strict=True)
            problem = self._collect(awaited, shots, frames, judges, loaded, began_ns)
            if not problem:
                problem = self._one_more(*beyond, frames)
            if not problem:
                apparatus.looks = judges
        finally:
            if problem:
                self._call_off(grabs, off)
        return frames, problem

    def _grab(self, buffer: Buffer, wait_s: float, off: threading.Event) -> Future[Frame]:
        def grab(camera: Camera) -> Frame:
            if off.is_set():
                raise DeviceTimeout(camera.name, "grab", "the sequence was called off")
            return camera.grab(buffer, wait_s)

        return self._apparatus.camera.submit(grab, wait_s + CALL_S, self._apparatus.session)

    def _collect(
        self,
        grabs: Sequence[tuple[Future[Frame], float]],
        shots: Sequence[Shot],
        frames: list[Frame],
        judges: Proof | None,
        loaded: LoadedSequence,
        began_ns: int,
    ) -> str:
        """Take the frames in as they come, into `frames`; why they are not the images, or ""."""
        for shot, (grab, wait_s) in zip(shots, grabs, strict=True):
            try:
                frames.append(self._wait(grab, wait_s))
            except Stuck:
                raise
            except (DeviceTimeout, DeviceGarbled) as error:
                return mismatch(loaded, frames, began_ns) or str(error)
            so_far = replace(loaded, images=len(frames))
            if problem := mismatch(so_far, frames, began_ns):
                return problem
            if problem := self._of_looks(frames, shot, judges):
                return f"frame {len(frames) - 1} of the sequence: {problem}"
        return ""

    def _of_looks(self, frames: Sequence[Frame], shot: Shot, judges: Proof | None) -> str:
        """Why the last of the frames does not look like what was shown for it; "" if it does."""
        if len(frames) == GUARDS:
            white, black = (frame.pixels for frame in frames)
            return head_problem(white, black, self._apparatus.info.pixel_format.full_scale)
        if len(frames) < GUARDS or judges is None:
            return ""
        return judges.problem(frames[-1].pixels, shot.step, shot.drawing.look)

    def _one_more(self, grab: Future[Frame], wait_s: float, frames: list[Frame]) -> str:
        """After the last frame none may come."""
        try:
            frames.append(self._wait(grab, wait_s))
        except Stuck:
            raise
        except DeviceTimeout:
            return ""
        except DeviceGarbled as error:
            return str(error)
        return "a frame came after the last one: a false trigger"

    def _wait(self, grab: Future[Frame], wait_s: float) -> Frame:
        """Wait for a frame, and for a pause. Raises _CalledOff, and what the grab does."""
        apparatus = self._apparatus
        apparatus.may_go_on()
        due = time.monotonic() + wait_s + CALL_S
        while not grab.done() and time.monotonic() < due:
            if apparatus.control.paused:
                raise _CalledOff
            wait_for([grab], LOOK_S)
        return apparatus.camera.wait(grab, 0.0)

    def _call_off(self, grabs: Sequence[Future[Frame]], off: threading.Event) -> None:
        """No more pulses, no more grabs, the camera stopped, each whether the other could be ended
        or not. A device that is gone is met again, and raised, when the sequence is repeated."""
        apparatus = self._apparatus
        off.set()
        if apparatus.session.ended.is_set():
            return  # whoever revoked it has halted the devices and made them safe
        for end in (self._end_pulses, lambda: self._end_grabs(grabs)):
            try:
                end()
            except DeviceError as error:
                log.warning("the sequence did not end as it should", problem=str(error))

    def _end_pulses(self) -> None:
        self._projector.call(lambda p: p.stop(), SHOW_S, self._apparatus.session)

    def _end_grabs(self, grabs: Sequence[Future[Frame]]) -> None:
        apparatus = self._apparatus
        if not all(grab.done() for grab in grabs):
            apparatus.camera.device.halt()
        wait_for(grabs, CALL_S)
        apparatus.stop()

    def _nothing_came(self, loaded: LoadedSequence) -> DeviceError:
        return DeviceTimeout(
            self._apparatus.camera.device.name,
            "grab",
            f"no frame came for any of {loaded.images} trigger pulses",
            "check the cable from the projector's trigger output, and trigger_line and "
            "trigger_edge in rig.toml; or take mode software",
        )


def _after(shot: Shot) -> tuple[int, int]:
    """The place of the plan after a frame."""
    more = shot.sub + 1 < shot.step.frames
    return (shot.index, shot.sub + 1) if more else (shot.index + 1, 0)
