"""The camera and the light of one run, as every way of exposing uses them.

Of the rig's calibration two things are applied here: the light is this pattern's only `latency_s`
after the projector said so, and images are drawn through the inverse of its `tone`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import structlog
from numpy.typing import NDArray

from daemon.config import SequencerSection
from daemon.devices.devicethread import Session
from daemon.devices.rig import SAFE_S, Rig
from daemon.exposing.control import Control
from daemon.exposing.exposer import Behind
from daemon.exposing.proof import Look, Proof, look_of
from daemon.exposing.recorder import Exposed, Recorder
from daemon.exposing.ring import Buffer, Ring
from daemon.patterns import predistorted, render
from daemon.scans.method import Expose, Method, Step
from drivers.base.camera import Acquisition, Camera, CameraInfo, CameraSettings, Frame
from drivers.clock import NS
from protocol.patterns import AnyPattern

T = TypeVar("T")

SHOW_S = 5.0
"""Deadline of a flip: many refreshes, even of a slow projector."""
CALL_S = 5.0
"""Deadline of a camera call that does not wait for light."""
RING_S = 30.0
"""How long a stepped scan waits for the recorder before it says that the disk does not keep up."""
LOOK_S = 0.05
"""How often a wait looks whether the run was paused or ended, or the recorder has failed."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Lit:
    """What the light is now."""

    step: Expose
    from_ns: int  # from when it is the step's; 0: nobody knows, as of a recording
    look: Look | None  # what the projector was given


@dataclass(frozen=True, slots=True)
class Drawing:
    """A pattern as the projector is to be given it, and what it must look like."""

    pattern: AnyPattern
    image: NDArray[np.uint8]
    look: Look


class Apparatus:
    """The devices of one run, from the thread that executes it."""

    def __init__(
        self,
        *,
        rig: Rig,
        session: Session,
        control: Control,
        method: Method[Any],
        recorder: Recorder,
        ring: Ring,
        patience: SequencerSection,
        may_go_on: Callable[[], None],
        on_pause: Callable[[str], None],
        taken: int,
    ) -> None:
        """`may_go_on` is called as a sign of life, `on_pause` with the reason when a pause begins;
        `taken` frames were had before."""
        self.rig = rig
        self.session = session
        self.control = control
        self.method = method
        self.recorder = recorder
        self.ring = ring
        self.patience = patience
        self.may_go_on = may_go_on
        self._on_pause = on_pause
        self.clock = rig.clock
        self.camera = rig.camera
        self.projector = None if self.info.recorded else rig.projector
        self.lit: Lit | None = None
        full_scale = self.info.pixel_format.full_scale
        self.looks = Proof(full_scale) if method.looked_at else None
        self._exposing: dict[str, int] = {}  # since the last record, see `FrameRecord`
        calibration = method.bench.calibration or {}
        self._latency_ns = round(float(calibration.get("latency_s", 0.0)) * NS)
        self._tone: list[int] | None = calibration.get("tone")
        #: of a step that asks for none
        self.first_exposure_us = self.camera.device.settings().exposure_us
        self._acquisition: Acquisition | None = None
        self._taken = taken
        self._drawing: Drawing | None = None

    # ------------------------------------------------------------ pauses

    def checkpoint(self) -> bool:
        """Stay here while paused, dark and held; True if there was a pause: then nothing is lit and
        the camera is stopped. Nothing may be under way. Raises Revoked."""
        return self.control.checkpoint(self.session, self._paused, self.recorder.check)

    def _paused(self, reason: str) -> None:
        self.rest()
        self._on_pause(reason)

    def rest(self) -> None:
        """Camera stopped, dark, held, for as long as nothing is exposed: the session goes on."""
        self.stop()
        self.lit = None
        if self.projector is not None:
            self.projector.call(lambda p: p.safe(), SAFE_S, self.session)
        for light in self.rig.lights.values():
            light.call(lambda x: x.safe(), SAFE_S, self.session)
        if self.rig.stage is not None:
            self.rig.stage.call(lambda s: s.safe(), SAFE_S, self.session)

    # ------------------------------------------------------------ camera

    @property
    def info(self) -> CameraInfo:
        """What the camera delivers as it is set now."""
        return self.camera.device.info()

    @property
    def exposure_us(self) -> float:
        """Of a frame, as the camera is set now; 0: it does not say."""
        return self.camera.device.settings().exposure_us or 0.0

    @property
    def rolling_ns(self) -> int:
        """How much later than its first row a frame's last one is exposed."""
        return round(self.info.rolling_s * NS)

    def frame_deadline(self) -> float:
        """Seconds within which a triggered frame must be here."""
        info = self.info
        return (
            self.exposure_us * 1e-6
            + info.rolling_s
            + info.readout_s
            + self.patience.frame_timeout_s
        )

    def acquire(self, wanted: Acquisition) -> bool:
        """Have the camera acquire in this way from now on. True: it did not already."""
        if self._acquisition is wanted:
            return False
        at = self._taken

        def start(camera: Camera) -> None:
            camera.stop()
            camera.start(wanted, at)

        self.camera.call(start, CALL_S, self.session)
        self._acquisition = wanted
        return True

    def stop(self) -> None:
        """End acquisition: nothing in the camera's queue can be trusted any more."""
        self._acquisition = None
        self.camera.call(lambda c: c.stop(), CALL_S, self.session)

    def needs_exposure(self, wanted_us: float | None) -> bool:
        """Whether the camera must be set before it exposes for so long; None: as at the start."""
        wanted_us = wanted_us or self.first_exposure_us
        return wanted_us is not None and wanted_us != self.camera.device.settings().exposure_us

    def set_exposure(self, wanted_us: float | None) -> None:
        """Expose for so long from now on; None: as the run began. Nothing may be under way."""
        if not self.needs_exposure(wanted_us):
            return
        self.stop()
        wanted = CameraSettings(exposure_us=wanted_us or self.first_exposure_us)
        self.camera.call(lambda c: c.configure(wanted), CALL_S, self.session)

    def buffer(self) -> Buffer:
        """A free buffer; see `when_recorded`."""
        return self.when_recorded(self.ring.take)

    def when_recorded(self, ask: Callable[[float], T | None]) -> T:
        """Call `ask`, with the seconds that it may wait, until it has something to give: until the
        recorder has caught up.

        There may be a pause meanwhile, for a disk that is full, so nothing may be under way.
        Raises Behind, Revoked, or what went wrong in the recorder.
        """
        due = time.monotonic() + RING_S
        while (found := ask(LOOK_S)) is None:
            self.recorder.check()
            if self.checkpoint():
                due = time.monotonic() + RING_S
            elif time.monotonic() >= due:
                raise Behind
        return found

    # ------------------------------------------------------------ light

    def light(self, step: Expose) -> Lit:
        """Make the light this step's; returns when it has flipped."""
        if self.projector is None:
            self.lit = Lit(step, 0, None)
        elif step.pattern is None:
            self.projector.call(lambda p: p.safe(), SAFE_S, self.session)
            self.lit = Lit(step, self.clock.now_ns() + self._latency_ns, None)
        else:
            drawing = self.drawn(step.pattern)
            flipped = self.projector.call(lambda p: p.show(drawing.image), SHOW_S, self.session)
            self.lit = Lit(step, flipped + self._latency_ns, drawing.look)
        return self.lit

    def draw(self, pattern: AnyPattern) -> Drawing:
        """A pattern as this projector is to be given it."""
        assert self.projector is not None
        info = self.projector.device.info()
        image = render(pattern, info.width, info.height)
        sent = image if self._tone is None else predistorted(image, self._tone)
        return Drawing(pattern, sent, look_of(image))

    def drawn(self, pattern: AnyPattern) -> Drawing:
        """As `draw`; the last one is remembered."""
        if self._drawing is None or self._drawing.pattern != pattern:
            self._drawing = self.draw(pattern)
        return self._drawing

    def draw_ahead(self, index: int) -> None:
        """Draw the pattern of a step that comes, while an exposure lasts."""
        if self.projector is None:
            return
        step = self.method.step(index, self.recorder.summary)
        if isinstance(step, Expose) and step.pattern is not None:
            self.drawn(step.pattern)

    # ------------------------------------------------------------ frames

    def put(
        self,
        index: int,
        step: Step,
        sub: int,
        frame: Frame,
        buffer: Buffer,
        *,
        way: str,
        lit_ns: int = 0,
        stage_mm: tuple[float, float] | None = None,
    ) -> None:
        """Hand a frame on; `way`: how it was exposed."""
        self.count(way)
        self._record(Exposed(step, index, sub, frame, buffer, stage_mm=stage_mm, lit_ns=lit_ns))

    def miss(self, index: int, step: Step, sub: int, reason: str) -> None:
        """Record that a frame could not be had, and why."""
        log.error("frame missing", step=index, sub=sub, reason=reason)
        self._record(Exposed(step, index, sub, None, missing=reason))

    def count(self, name: str, more: int = 1) -> None:
        """Count what run.json tells about the exposing."""
        self._exposing[name] = self._exposing.get(name, 0) + more

    def _record(self, exposed: Exposed) -> None:
        """Hand it over, with what was counted since the one before."""
        self._taken += 1
        counted, self._exposing = self._exposing, {}
        self.recorder.put(replace(exposed, exposing=counted))

    def out_of_light(self, frame: Frame, from_ns: int, until_ns: int) -> str:
        """Why a frame was not exposed wholly within a time; "" if it was. 0: no end to it."""
        if frame.start_ns < from_ns:
            early = (from_ns - frame.start_ns) / NS * 1e3
            return f"the exposure began {early:.2f} ms before its pattern was lit"
        end_ns = frame.end_ns + self.rolling_ns
        if until_ns and end_ns > until_ns:
            late = (end_ns - until_ns) / NS * 1e3
            return f"the exposure ended {late:.2f} ms after its pattern was taken down"
        return ""
