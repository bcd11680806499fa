"""Scans whose steps are fixed before the first frame, and the steps that such plans are made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

from daemon.scans.method import Bench, Expose, Method, Step, Unsuitable
from daemon.separation.estimator import Lighting
from drivers.base.projector import ProjectorInfo
from protocol.patterns import BLACK, WHITE, AnyPattern
from protocol.scans.spec import Reference, Spec

S = TypeVar("S", bound=Spec)

_SHOWN: dict[Reference, tuple[AnyPattern | None, Lighting]] = {
    Reference.AMBIENT: (None, Lighting.AMBIENT),
    Reference.BLACK: (BLACK, Lighting.BLACK),
    Reference.WHITE: (WHITE, Lighting.WHITE),
    Reference.OPEN: (None, Lighting.OPEN),
}


def references(wanted: Iterable[Reference], frames: int = 1) -> list[Expose]:
    """The steps that take these references, `frames` of each."""
    return [Expose(*_SHOWN[reference], frames=frames) for reference in wanted]


def source_references(frames: int) -> list[Expose]:
    """The three that a measurement of the projector begins with: source off, black, white."""
    return references((Reference.AMBIENT, Reference.BLACK, Reference.WHITE), frames)


def exposures(pattern_set: Iterable[AnyPattern], frames: int) -> list[Expose]:
    """The steps that expose each pattern of a set in turn, `frames` of each."""
    return [
        Expose(pattern, Lighting.PATTERN, index, frames)
        for index, pattern in enumerate(pattern_set)
    ]


class PlannedMethod(Method[S]):
    """A method with a fixed plan, which a subclass puts into `_plan`."""

    def __init__(self, spec: S, bench: Bench) -> None:
        super().__init__(spec, bench)
        self._plan: Sequence[Step] = ()

    def projector(self) -> ProjectorInfo:
        """The projector. Raises Unsuitable where there is none."""
        if self.bench.projector is None:
            raise Unsuitable(
                f"{self.name} needs a projector, and this rig has none: name one under "
                "[projector] in rig.toml"
            )
        return self.bench.projector

    def planned(self) -> int:
        """Frames of the whole plan."""
        return sum(step.frames for step in self._plan if isinstance(step, Expose))

    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """See `Method`. A plan does not depend on what was measured so far."""
        del summary
        return self._plan[index] if index < len(self._plan) else None
