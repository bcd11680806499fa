"""Where the devices of a virtual rig meet: sources send light, a camera integrates it.

Whoever changes the light notes it here with the moment from which it is so, before that moment
comes; a camera asks for an interval only after its end. One lock orders the two, so what a frame
holds is a matter of clock times alone, however late a thread runs and however fast the clock.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.base.device import Context
from drivers.virtual.geometry import F32, Pinhole
from drivers.virtual.occluder import Occluder
from drivers.virtual.transport import transport

RENDERED = 24  # planes kept: black, white and the patterns of a short set


@dataclass(frozen=True)
class Emission:
    """What a source emitted in a part of an interval: equal keys mean equal images, so `draw` is
    called only for an unknown one. `weight` is that part, 0..1, times the source's strength."""

    weight: float
    key: Hashable
    draw: Callable[[], F32]  # (h, w) float32, 0..1


class Source(Protocol):
    """Something that lights the scene."""

    name: str
    main: bool  # the rig's projector

    @property
    def pinhole(self) -> Pinhole:
        """Where it stands, and how its emission image spreads from there."""
        ...

    @property
    def strength(self) -> float:
        """Of its full light, 1 being a projector's; clouds are not in it."""
        ...

    def emitted(self, start_ns: int, end_ns: int) -> Sequence[Emission]:
        """What it emitted in an interval that is over. Raises Forgotten."""
        ...


class TriggerLine:
    """A wire from a projector's trigger output to the cameras of the bench.

    Pulses are noted before their moment comes, as changes of light are. Use it under the bench's
    lock.
    """

    def __init__(self) -> None:
        self._pulses: deque[int] = deque(maxlen=4096)
        self.listeners: set[threading.Event] = set()  # set whenever the pulses change

    def fire(self, moments: Sequence[int]) -> None:
        """Plan pulses, in order, later than all before."""
        self._pulses.extend(moments)
        self._tell()

    def cut(self, at_ns: int) -> None:
        """What was planned for then or later does not happen."""
        while self._pulses and self._pulses[-1] >= at_ns:
            self._pulses.pop()
        self._tell()

    def after(self, at_ns: int) -> int | None:
        """The first pulse later than a moment, as planned now."""
        return next((pulse for pulse in self._pulses if pulse > at_ns), None)

    def _tell(self) -> None:
        for event in self.listeners:
            event.set()


class Carrier(Protocol):
    """What moves an occluder through the light."""

    occluder: Occluder
    shades: str  # the light that it stands under; "": all
    before_scene_mm: float  # from the middle of the scene to the occluder's plane

    def offset_at(self, at_ns: int) -> tuple[float, float]:
        """Where the occluder really was, in mm from the middle of its travel."""
        ...


class Bench:
    """The sources of one rig, and the light that they send into a camera."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.sources: dict[str, Source] = {}
        self.carrier: Carrier | None = None
        self.line: TriggerLine | None = None  # there is one where a projector sends pulses
        self._planes: OrderedDict[Hashable, F32] = OrderedDict()

    @classmethod
    def of(cls, context: Context) -> Bench:
        """The bench that the devices of a context share."""
        bench = context.shared.setdefault("bench", cls())
        assert isinstance(bench, Bench)
        return bench

    def add(self, source: Source) -> None:
        """Put a source on the bench."""
        with self.lock:
            self.sources[source.name] = source

    def radiance(
        self, start_ns: int, end_ns: int, size: tuple[int, int], layouts: Sequence[str]
    ) -> list[F32]:
        """Mean radiance (H, W) over an interval that is over, one plane a layout (see
        `Transport.render`). Raises Forgotten."""
        with self.lock:
            sent = [(s, s.emitted(start_ns, end_ns)) for s in self.sources.values()]
        planes = [np.zeros((size[1], size[0]), np.float32) for _ in layouts]
        for source, emissions in sent:
            for emission in emissions:
                rendered = self._render(source, emission, size, layouts)
                for k, part in enumerate(rendered):
                    planes[k] += np.float32(emission.weight) * part
        return planes

    def _render(
        self, source: Source, emission: Emission, size: tuple[int, int], layouts: Sequence[str]
    ) -> list[F32]:
        pinhole = source.pinhole
        keys = [(pinhole, emission.key, size, layout) for layout in layouts]
        known = [self._planes.get(key) for key in keys]
        found = [plane for plane in known if plane is not None]
        if len(found) < len(keys):
            operator = transport(*size, pinhole)
            lit = operator.light(emission.draw())
            found = [np.add(*operator.render(lit, layout)) for layout in layouts]
        for key, plane in zip(keys, found, strict=True):
            self._planes[key] = plane
            self._planes.move_to_end(key)
        while len(self._planes) > RENDERED:
            self._planes.popitem(last=False)
        return found

    def components(
        self, names: Sequence[str], size: tuple[int, int], layouts: Sequence[str]
    ) -> tuple[list[F32], list[F32]]:
        """Direct and global radiance under the full light of some sources: T's two parts."""
        direct = [np.zeros((size[1], size[0]), np.float32) for _ in layouts]
        others = [np.zeros((size[1], size[0]), np.float32) for _ in layouts]
        for name in names:
            source = self.sources[name]
            pinhole, strength = source.pinhole, np.float32(source.strength)
            operator = transport(*size, pinhole)
            lit = operator.light(np.ones((pinhole.height, pinhole.width), np.float32))
            for k, layout in enumerate(layouts):
                parts = operator.render(lit, layout)
                direct[k] += strength * parts[0]
                others[k] += strength * parts[1]
        return direct, others

    def prepare(self, width: int, height: int) -> None:
        """Build the main sources' light transport to a view of a size: a second, once."""
        for name in self.main_sources():
            transport(width, height, self.sources[name].pinhole)

    def main_sources(self) -> tuple[str, ...]:
        """The projector, or without one the lights that an occluder shades, or all."""
        first = [name for name, source in self.sources.items() if source.main]
        return tuple(first) or self.shaded(tuple(self.sources))

    def shaded(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Of some sources those that the occluder stands under; all, if it stands under none."""
        shades = "" if self.carrier is None else self.carrier.shades
        return (shades,) if shades in names else names
