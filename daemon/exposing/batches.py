"""Which frames one sequence of the projector holds: consecutive ones of the plan, as many as the
projector, the ring and the pace allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import structlog
from numpy.typing import NDArray

from daemon.exposing.apparatus import Apparatus, Drawing
from daemon.exposing.modes import GUARDS, Pace, pace
from daemon.scans.method import Expose, Unsuitable
from daemon.separation.estimator import Lighting
from drivers.base.projector import SequenceLimits
from protocol.patterns import BLACK, WHITE

IMAGES_BYTES = 256 << 20
"""Memory that the images of a sequence may take."""
_SLOWEST = 8  # times the shortest period: slower than that, nobody loses frames for want of time

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame that is wanted, with what to show for it."""

    index: int
    step: Expose
    sub: int
    drawing: Drawing


class Batches:
    """The sequences of a plan, one after the other; learns from those that went wrong."""

    def __init__(self, apparatus: Apparatus, limits: SequenceLimits, *, strict: bool) -> None:
        """`strict`: what no sequence can hold raises Unsuitable, where it is a matter of
        settings."""
        assert apparatus.projector is not None
        self._apparatus = apparatus
        self._projector = apparatus.projector.device
        self._limits = limits
        self._strict = strict
        self._most = limits.images  # fewer once the projector has refused so many
        self._ahead: tuple[tuple[int, int], list[Shot]] | None = None
        self._slower = 1  # periods are so many times as long as they need be
        self._told: set[str] = set()  # why steps are exposed by themselves

    def take(self, at: tuple[int, int]) -> list[Shot]:
        """The frames of the sequence that begins at a place of the plan; []: it can be none."""
        shots = self._ahead[1] if self._ahead and self._ahead[0] == at else self._gather(*at)
        self._ahead = None
        return shots

    def prepare(self, at: tuple[int, int]) -> None:
        """Draw the sequence of a place now; `take` has it then."""
        if self._ahead is None or self._ahead[0] != at:
            self._ahead = (at, self._gather(*at))

    def guards(self) -> list[Shot]:
        """White, then black. Light that is a period late makes them dark and white; early, black
        and the first pattern: never the first brighter than the second."""
        return [
            Shot(-1, Expose(pattern, lighting), 0, self._apparatus.draw(pattern))
            for pattern, lighting in ((WHITE, Lighting.WHITE), (BLACK, Lighting.BLACK))
        ]

    def shorten(self, frames: int, problem: str) -> None:
        """The projector has refused a sequence: from now on no more than so many frames."""
        self._most = GUARDS + frames
        log.info("shorter sequences", images=self._most, problem=problem)

    def slow_down(self) -> None:
        """Frames were lost: from now on at half the pace."""
        self._slower = min(2 * self._slower, _SLOWEST)

    def tell(self, why: str) -> None:
        """Say, once, why steps are exposed by themselves."""
        if why not in self._told:
            self._told.add(why)
            log.info("exposed one by one", reason=why)

    def _gather(self, index: int, first: int) -> list[Shot]:
        """The frames from a place of the plan on that one sequence can hold."""
        shots: list[Shot] = []
        drawing: Drawing | None = None
        most, head = 0, index
        while isinstance(
            step := self._apparatus.method.step(index, self._apparatus.recorder.summary), Expose
        ):
            if shots and step.exposure_us != shots[0].step.exposure_us:
                break
            if index == head:
                most = self._room(step)
            if not most or step.pattern is None or step.delay_s or len(shots) >= most:
                break
            if drawing is None or drawing.pattern != step.pattern:
                drawing = self._apparatus.draw(step.pattern)
            if not self._has_levels(drawing.image):
                break
            room = most - len(shots)
            subs = range(first, step.frames)[:room]
            shots += [Shot(index, step, sub, drawing) for sub in subs]
            index, first = index + 1, 0
        return shots

    def _room(self, step: Expose) -> int:
        """How many frames a sequence can hold at a step's exposure; 0: it can be none."""
        try:
            found = self.pace(step)
        except Unsuitable as error:
            if self._strict:
                raise
            self.tell(str(error))
            return 0
        info = self._projector.info()
        images = min(found.images, self._most, IMAGES_BYTES // (info.width * info.height))
        # Half of the ring: the other half is being recorded meanwhile.
        return max(0, min(images - GUARDS, (self._apparatus.ring.count + 1) // 2))

    def pace(self, step: Expose) -> Pace:
        """How fast a sequence may go at a step's exposure. Raises Unsuitable."""
        exposure_us = step.exposure_us or self._apparatus.first_exposure_us or 0.0
        info = self._apparatus.info
        wanted = pace(info, self._limits, exposure_us, self._apparatus.patience.period_us)
        if self._slower == 1:
            return wanted
        try:
            return pace(info, self._limits, exposure_us, self._slower * wanted.period_us)
        except Unsuitable:
            return wanted  # it is as slow as it can be

    def _has_levels(self, image: NDArray[np.uint8]) -> bool:
        """Whether sequences have the image's levels."""
        if self._limits.bits > 1 or bool(((image == 0) | (image == 255)).all()):
            return True
        why = "a pattern has grey levels, and the projector's sequences are black and white only"
        if self._strict:
            raise Unsuitable(f"mode hardware: {why}: take mode auto or software", "$.mode")
        self.tell(why)
        return False
