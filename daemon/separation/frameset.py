"""Whether the frames of a scan can be the patterns that were declared: what each alone tells.

Patterns that are fine and of one lit fraction give a scene the same light on the whole, whatever
lies where; so that a frame which is black, white, or of another scan stands out by its mean, and a
room's light that was switched on by a step. One frame in two places is told by its bits, one
pattern exposed twice by frames that hardly differ. None of this is in a pixel's own samples, of
which an extreme or a fit makes light in any case.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.compression import COMPRESSED, in_blocks
from daemon.separation.creep import Creep, marked
from daemon.separation.estimator import Components, Estimator, Lighting, Observation, Result
from daemon.separation.mosaic import orders_of
from daemon.separation.radiometry import Plane, Response

_SAMPLES = 20_000  # of a frame
_ODD = 0.2  # of the usual light: a frame of few so far from it is none of the set
_ODD_PAIR = 0.08  # of two, whose usual light is in the middle
_ODD_AT_LEAST = 0.05  # where many frames say how much it differs from pattern to pattern ...
_ODD_SPREADS = 8.0  # ... by so many deviations
_MANY = 6  # frames
_STEP = 0.04  # of the light: less is a lamp's own unrest
_STEP_ERRORS = 5.0  # standard errors of a step
_UNEQUAL = 0.05  # of a pair's light, from pair to pair
_SAME = 0.35  # of the usual difference of two frames in a row: below it they are one pattern
_MOST_NAMED = 5  # frames in a line of advice
_PRINTS = 4096  # frames whose bits are remembered: of longer scans, the last
_BRIGHT = {Lighting.WHITE, Lighting.PATTERN}
_LOOK = 1024  # pixels a side that are looked at for a mosaic
_DEPTHS = (10, 12, 14)  # bits that files of 16 hold
_PILED = 1e-3  # of all samples, at the largest count of any: light is not so often the same


UNCHECKED = (
    "no black, white or ambient frame came with the patterns: light of the room, if any, counts as "
    "global, and black level, leakage and tone curve are taken as told (of photographs: "
    "--black-frame, --white-frame, --ambient-frame; of a scan: --references)"
)
"""Advice where patterns are all that there is."""


class Ceiling:
    """The largest count of all samples, and how many have it."""

    def __init__(self) -> None:
        self._largest = -1
        self._there = 0
        self._samples = 0

    def add(self, sample: NDArray[Any]) -> None:
        """Take in samples of a frame, as the camera gave them."""
        largest = int(sample.max())
        if largest > self._largest:
            self._largest, self._there = largest, 0
        self._samples += sample.size
        self._there += int(np.count_nonzero(sample == self._largest))

    def told(self, response: Response) -> list[str]:
        """A line where a camera's scale seems to end below the one that is assumed."""
        if response.full_scale < 65535 or self._largest >= response.saturated_from:
            return []
        if self._there > _PILED * self._samples:
            part = self._there / self._samples
            return [
                f"{part:.1%} of the samples have the largest count of all, {self._largest}, as "
                "where a camera's scale ends: say so "
                f"({_depth(self._largest) or f'--saturation {self._largest}'}), for there light is "
                "beyond it, and what follows is wrong"
            ]
        depth = _depth(self._largest, ends=False)
        if depth and response.saturation is None:
            return [
                f"no sample is above {self._largest} of {response.full_scale}: if the camera has "
                f"fewer bits than its files say so ({depth}), for saturation and tone curves are "
                "taken to be those of 16; else expose longer"
            ]
        return []


def _depth(largest: int, *, ends: bool = True) -> str:
    """The option for a camera whose scale ends at this count, or (not `ends`) above it."""
    bits = next((n for n in _DEPTHS if largest < 1 << n), 16)
    return f"--depth {bits}" if bits < 16 and (not ends or largest == (1 << bits) - 1) else ""


@dataclass(slots=True)
class _Mean:
    """Of numbers that are not kept."""

    total: float = 0.0
    count: int = 0

    def add(self, value: float) -> None:
        self.total += value
        self.count += 1

    @property
    def value(self) -> float:
        return self.total / self.count


class FrameSet:
    """Facts of frames as they come; memory: one sample of a frame, a few numbers a pattern, and
    one for each of the last `_PRINTS` frames."""

    def __init__(self, response: Response, *, even: bool, distinct: bool = True) -> None:
        """`even`: the patterns are fine, and of one lit fraction; `distinct`: no two are alike."""
        self._response = response
        self._even = even
        self._distinct = distinct
        self._levels: defaultdict[int, _Mean] = defaultdict(_Mean)  # of a pattern's frames
        self._references: defaultdict[Lighting, _Mean] = defaultdict(_Mean)
        self._prints: dict[int, int] = {}  # of a frame's bits: its pattern; -1: a reference
        self._copies: dict[tuple[int, int], None] = {}  # in the order in which they came
        self._last: tuple[int, Plane] | None = None
        self._steps: dict[tuple[int, int], float] = {}  # differences of frames in a row
        self._ceiling = Ceiling()
        self._mosaic: tuple[str, ...] | None = None  # that the first frame looks like
        self._compressed: bool | None = None  # what it looks like

    def add(self, pixels: NDArray[Any], observation: Observation) -> None:
        """Take in a frame that is used."""
        step = max(1, int(np.sqrt(pixels.shape[0] * pixels.shape[1] / _SAMPLES)) | 1)
        sample = np.ascontiguousarray(pixels[::step, ::step])
        self._ceiling.add(sample)
        if self._mosaic is None and observation.lighting in _BRIGHT:
            self._mosaic = orders_of(pixels[:_LOOK, :_LOOK]) if pixels.ndim == 2 else ()
            self._compressed = in_blocks(pixels)
        light = self._response.linear(sample)
        level = float(light.mean(dtype=np.float64))
        if observation.lighting is not Lighting.PATTERN:
            self._references[observation.lighting].add(level)
            self._printed(sample, -1)
            return
        pattern = observation.pattern
        self._printed(sample, pattern)
        self._levels[pattern].add(level)
        if self._last is not None and self._last[0] != pattern:
            apart = float(np.mean(np.abs(light - self._last[1]), dtype=np.float64))
            self._steps[self._last[0], pattern] = apart
        self._last = pattern, light

    def _printed(self, sample: NDArray[Any], pattern: int) -> None:
        if sample.min() == sample.max():  # black, or wholly saturated: told by its light
            return
        mark = zlib.crc32(sample.tobytes()) << 32 | zlib.adler32(sample.tobytes())
        first = self._prints.setdefault(mark, pattern)
        if first != pattern:
            self._copies[first, pattern] = None
        if len(self._prints) > _PRINTS:
            del self._prints[next(iter(self._prints))]

    def told(self) -> tuple[dict[str, Any], list[str], list[str]]:
        """Facts, lines of advice, and what is to be said after all other advice."""
        lines = [*self._copied(), *self._swapped(), *self._ceiling.told(self._response)]
        if self._mosaic and self._response.bayer not in self._mosaic:
            other = f", and not {self._response.bayer}" if self._response.bayer else ""
            lines.append(
                f"the frames look like a colour mosaic's that begins {' or '.join(self._mosaic)}"
                f"{other}: say so (--bayer)"
            )
        last = [] if self._references else [UNCHECKED]
        if self._compressed:
            lines.append(COMPRESSED)
        facts: dict[str, Any] = {"compressed": bool(self._compressed)}
        if self._even and len(self._levels) >= 2:
            order = sorted(self._levels)
            levels = np.array([self._levels[n].value for n in order])
            usual = float(np.median(levels))
            if usual > 0:
                off = levels / usual - 1.0
                facts["frame_levels"] = {
                    "lowest": round(float(off.min()), 4),
                    "highest": round(float(off.max()), 4),
                }
                lines += _odd(order, off) or _stepped(order, off)
        return facts, lines, last

    def _copied(self) -> list[str]:
        if not self._distinct:
            return []
        lines = []
        for first, second in islice(self._copies, _MOST_NAMED):
            what = "a reference frame" if first < 0 else f"pattern {first + 1}'s frame"
            lines.append(
                f"pattern {second + 1}'s frame is {what} over again, bit by bit: see that each "
                "image is its own pattern's, and scan again if one is missing"
                if second >= 0
                else f"a reference frame is {what} over again, bit by bit: name the right files"
            )
        usual = float(np.median(list(self._steps.values()))) if len(self._steps) > 3 else 0.0
        again = [
            pair
            for pair, apart in self._steps.items()
            if apart < _SAME * usual and pair not in self._copies
        ]
        lines += [
            f"the frames of patterns {first + 1} and {second + 1} hardly differ: one pattern was "
            "exposed twice and one is missing: scan again, and give the projector more time"
            for first, second in again[:_MOST_NAMED]
        ]
        return lines

    def _swapped(self) -> list[str]:
        black, white = (self._references.get(kind) for kind in (Lighting.BLACK, Lighting.WHITE))
        if black and white and black.value >= white.value:
            return [
                "the black frame is brighter than the white one: are the two exchanged "
                "(--black-frame, --white-frame)?"
            ]
        if not self._levels or not self._even:
            return []
        typical = float(np.median([level.value for level in self._levels.values()]))
        if white and typical > white.value:
            return [
                "the patterns' frames are brighter than the white frame: it is of another "
                "exposure or scene, and what follows from it is wrong"
            ]
        if black and typical < black.value:
            return [
                "the patterns' frames are darker than the black frame: it is of another "
                "exposure or scene, and what follows from it is wrong"
            ]
        return []


def _odd(order: list[int], off: NDArray[np.float64]) -> list[str]:
    """Frames whose light is far from the others'."""
    limit = _ODD_PAIR if len(order) == 2 else _ODD
    if len(order) >= _MANY:
        spread = 1.4826 * float(np.median(np.abs(off)))
        limit = min(_ODD, max(_ODD_AT_LEAST, _ODD_SPREADS * spread))
    odd = [(n, by) for n, by in zip(order, off.tolist(), strict=True) if abs(by) > limit]
    if not odd:
        return []
    if len(order) == 2:
        return [
            "the two images differ in their light as a whole by "
            f"{abs(off[1] - off[0]):.0%}: they are not a pattern and its complement of one "
            "exposure and lit fraction"
        ]
    named = ", ".join(f"{n + 1} ({1 + by:.2f})" for n, by in odd[:_MOST_NAMED])
    return [
        f"of {len(order)} patterns' frames {len(odd)} stand out by their light as a whole: pattern "
        f"{named} of the usual light; such a frame is black, white or of something else, or the "
        "source flickers: see to it and scan again, for it is taken for light or shadow"
    ]


def _stepped(order: list[int], off: NDArray[np.float64]) -> list[str]:
    """Light that was one thing up to a frame and another after it."""
    count = len(order)
    if count < _MANY:
        return []
    best, where = 0.0, 0
    for cut in range(2, count - 1):
        before, after = off[:cut], off[cut:]
        within = np.sqrt((before.var() * cut + after.var() * (count - cut)) / (count - 2))
        error = within * np.sqrt(1.0 / cut + 1.0 / (count - cut))
        apart = abs(float(after.mean() - before.mean()))
        if apart > max(_STEP, _STEP_ERRORS * float(error)) and apart > best:
            best, where = apart, cut
    if not where:
        return []
    return [
        f"from pattern {order[where] + 1} on the scene as a whole has {best:.0%} more or less "
        "light than before: a light of the room, or the source, changed during the scan: scan again"
    ]


class Watched:
    """An estimator, and what sees the same frames and adds what it knows."""

    def __init__(self, inner: Estimator, frames: FrameSet, creep: Creep) -> None:
        self._inner = inner
        self._frames = frames
        self._creep = creep

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        self._inner.update(pixels, observation)
        if observation.used:
            self._frames.add(pixels, observation)
            self._creep.add(pixels, observation)

    def result(self) -> Result:
        """See `Estimator`. Raises NotYet as the estimator does that it watches."""
        result = self._inner.result()
        if not isinstance(result, Components):
            return result
        facts, lines, last = self._frames.told()
        result, moved = marked(result, self._creep.told())
        advice = [*lines, *moved, *result.facts.get("advice", ()), *last]
        return replace(result, facts={**result.facts, **facts, "advice": advice})

    def summary(self) -> dict[str, float]:
        """See `Estimator`."""
        return self._inner.summary()


class PairSums:
    """Pairs of a pattern and its inverse: each pair's light adds up to the same picture."""

    def __init__(self) -> None:
        self._sum: NDArray[np.float64] | None = None
        self._squares: NDArray[np.float64] | None = None
        self._pairs = 0
        self._levels: list[float] = []

    def add(self, whole: Plane) -> None:
        """Take in the sum of a pair's two pictures."""
        step = max(1, int(np.sqrt(whole.shape[0] * whole.shape[1] / _SAMPLES)) | 1)
        values = whole[::step, ::step].astype(np.float64)
        if self._sum is None or self._squares is None:
            self._sum, self._squares = np.zeros_like(values), np.zeros_like(values)
        self._levels.append(float(values.mean()))
        self._sum += values
        self._squares += np.square(values)
        self._pairs += 1

    def told(self, deviation: float) -> tuple[dict[str, Any], list[str]]:
        """Facts and advice; `deviation` is that of one picture's noise."""
        if self._sum is None or self._squares is None or self._pairs < 2:
            return {}, []
        mean = self._sum / self._pairs
        spread = np.sqrt(np.maximum(self._squares / self._pairs - np.square(mean), 0.0))
        bright = mean >= np.median(mean)  # all of them where there is one level
        # a frame that is wrong may leave half of the pixels as they are
        part = float(np.quantile(spread[bright] / np.maximum(mean[bright], 1e-6), 0.75))
        noise = float(np.sqrt(2.0)) * deviation / max(float(np.median(mean[bright])), 1e-6)
        facts = {"pair_spread": round(part, 4)}
        levels = np.asarray(self._levels)
        off = float(np.max(np.abs(levels / max(float(np.median(levels)), 1e-6) - 1.0)))
        if off < _UNEQUAL and part < max(_UNEQUAL, 3.0 * noise):
            return facts, []
        return facts, [
            f"a pattern and the one after it add up to light that differs by {max(part, off):.0%} "
            "from pair to pair, not to the same: the frames are not a Gray code's patterns, each "
            "followed by its inverse, the coarsest bit first (--bits, --axes), or the light changed"
        ]
