"""Proof of step: whether a frame shows its own pattern, wholly, judged by what it looks like.

Time stamps prove when a frame was exposed, not what the projector really showed meanwhile: it may
flip a refresh later than it says, show the image before, or nothing; and rows of a frame may have
been exposed at another time than the stamps say. What can be known without a map from camera to
projector:

- a white frame is brighter than a black one, and nowhere darker;
- under a pattern that is fine enough to be even over the scene, the scene as a whole, and each
  band of rows, is as bright as the pattern's mean level says, between black and white: a black
  frame and a pattern that never came are far from it;
- two frames of a family of patterns differ by as much as their images do, as other pairs of the
  family have shown: one that is as good as equal to the frame before shows the pattern before, and
  one of which only the upper or the lower rows are so is *torn*: it holds two patterns.

Frames are compared with others of their exposure time; one of which much is saturated shows too
little of its pattern to be judged (of a bracket, shorter exposures of the same light are).

Pure: no I/O, no threads. Only a sample of each frame is kept, so that it costs little.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.scans.method import Expose
from daemon.separation.estimator import Lighting

_SAMPLES = 20_000  # of a frame
_BLIND = 0.4  # of the samples saturated: from here a frame is not judged
_BRIGHTER = 5.0  # standard errors: by how much white must be brighter than black, at least
_OFF_LEVEL = 0.4  # of the way from black to white: how far a pattern's brightness may be off
_SAME = 0.35  # of the difference that two patterns should make: below it they are one
_CHANGED = 0.65  # of it: above it they are two
_PAIRS = 3  # pairs of a family of patterns before what they "should" make means anything
_EVEN = 0.15  # how far a block's mean may be from the pattern's own for it to be called even
_BLOCKS = 6  # along each side
_STRIPS = 48  # rows of an image are looked at in so many strips, each over its whole width
_PLACES = 64  # in each block, where two images are compared
_EVENLY = 0.4  # of the mean change of two images: what each block must have of it
_BANDS = 8  # of a frame's rows
_CELLS = 16  # of a band, along its width: the light of a few tells nothing of a pattern's level
_MANY_CELLS = 6  # that light must come from, for a band to be judged by its level
#: what tells the patterns of a family apart
_PLACE = {"shift_x", "shift_y", "shift", "phase", "seed", "index", "inverted"}

Sample = NDArray[np.float32]
"""Of a frame: (bands, rows of each, samples along a row)."""
Bands = NDArray[np.float64]
"""One figure a band."""


@dataclass(frozen=True, slots=True)
class Look:
    """What is kept of an image to judge frames by.

    `level`: the share of white's light that the scene as a whole gets under it; None where it is
    too coarse to say: parts of the scene would get more of it than others. `places`: its values,
    0 to 1, at fixed places in each block, (blocks, places) float32.
    """

    level: float | None
    places: NDArray[np.float32]
    even_rows: bool  # each narrow strip of its rows has that level, too


def look_of(image: NDArray[np.uint8]) -> Look:
    """The look of an image (h, w) uint8, 6 x 6 pixels at least."""
    height, width = (side // _BLOCKS * _BLOCKS for side in image.shape)
    along = image[:height, :width].reshape(height, _BLOCKS, width // _BLOCKS)
    rows = along.sum(axis=2, dtype=np.uint32) / (255.0 * (width // _BLOCKS))  # of each block
    means = rows.reshape(_BLOCKS, height // _BLOCKS, _BLOCKS).mean(axis=1)
    level = float(means.mean())
    even = float(np.abs(means - level).max()) <= _EVEN
    edges = np.unique(np.arange(_STRIPS) * height // _STRIPS)
    strips = np.add.reduceat(rows.mean(axis=1), edges) / np.diff(edges, append=height)
    even_rows = float(np.abs(strips - level).max()) <= _EVEN
    row, column = _where(image.shape[0], image.shape[1])
    places = image[row, column].astype(np.float32) / np.float32(255)
    return Look(level if even else None, places, even and even_rows)


@lru_cache(maxsize=4)
def _where(height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the places, (blocks, places) each."""
    rng = np.random.default_rng(0)
    part = rng.random((2, _BLOCKS, _BLOCKS, _PLACES))
    row = (np.arange(_BLOCKS)[:, None, None] + part[0]) / _BLOCKS * height
    column = (np.arange(_BLOCKS)[None, :, None] + part[1]) / _BLOCKS * width
    shape = (_BLOCKS * _BLOCKS, _PLACES)
    return row.astype(np.intp).reshape(shape), column.astype(np.intp).reshape(shape)


@dataclass(frozen=True, slots=True)
class _Scale:
    """Between what black and what white a scan is: means of each band, and whether it has light all
    along, so that its level is that of many of a pattern's elements."""

    black: Bands
    white: Bands
    spread: tuple[bool, ...]

    @classmethod
    def of(cls, black: Sample, white: Sample) -> _Scale:
        lit = white - black
        cells = np.array_split(lit, _CELLS, axis=2)
        sums = np.clip([cell.sum(axis=(1, 2), dtype=np.float64) for cell in cells], 0.0, None)
        many = sums.sum(axis=0) ** 2 >= _MANY_CELLS * np.square(sums).sum(axis=0)
        spread = many & (_brightness(lit) >= _BRIGHTER)
        return cls(_means(black), _means(white), tuple(spread.tolist()))


class Proof:
    """Judges frame after frame of one scan; a frame that failed is forgotten, not compared with.

    `full_scale` is the count of a saturated sample.
    """

    def __init__(self, full_scale: float = math.inf) -> None:
        self._full_scale = full_scale
        self._exposures: dict[float | None, _Looks] = {}

    def fork(self) -> Proof:
        """A copy that goes its own way: for frames of which it is not yet known whether they
        count."""
        forked = Proof(self._full_scale)
        forked._exposures = {key: looks.fork() for key, looks in self._exposures.items()}
        return forked

    def problem(self, pixels: NDArray[Any], step: Expose, look: Look | None) -> str:
        """Why the frame (H, W) or (H, W, 3) cannot be of this step; "" if it can.

        `look` is the `look_of` what the projector was given.
        """
        sample = _sample(pixels)
        if _blind(sample, self._full_scale):
            return ""
        return self._exposures.setdefault(step.exposure_us, _Looks()).problem(sample, step, look)


class _Looks:
    """The frames of one exposure time."""

    def __init__(self) -> None:
        self._black: Sample | None = None
        self._white: Sample | None = None
        self._scale: _Scale | None = None  # once there are both
        self._last: tuple[Expose, Sample, Look] | None = None
        self._family: object = None
        #: of the pairs so far: what each band's difference was of the images' own
        self._gains: deque[Bands] = deque(maxlen=16)

    def fork(self) -> _Looks:
        """See `Proof`."""
        forked = copy.copy(self)
        forked._gains = self._gains.copy()
        return forked

    def problem(self, sample: Sample, step: Expose, look: Look | None) -> str:
        """See `Proof`."""
        found = self._problem(sample, step, look)
        if not found:
            self._remember(sample, step, look)
        return found

    def _problem(self, sample: Sample, step: Expose, look: Look | None) -> str:
        if step.lighting is Lighting.WHITE:
            return "" if self._black is None else _of_white(sample, self._black)
        if step.lighting is not Lighting.PATTERN or look is None:
            return ""
        return self._of_level(sample, look) or self._of_repetition(sample, step, look)

    def _of_level(self, sample: Sample, look: Look) -> str:
        """Compare with the levels of black and white, where the scan has taken both."""
        scale = self._scale
        if scale is None or self._white is None or look.level is None:
            return ""
        means = _means(sample)
        if bool((means > scale.white).any()):
            brighter = _brightness(sample - self._white) > _BRIGHTER
            if torn := _torn(brighter.tolist(), "is brighter than in the white frame"):
                return torn
        lit = scale.white - scale.black
        share = float((means - scale.black).sum()) / float(lit.sum())
        if abs(share - look.level) > _OFF_LEVEL:
            return (
                f"the frame has {share:.0%} of the light of white, its pattern {look.level:.0%}: "
                "another image was shown"
            )
        if not look.even_rows:
            return ""
        off = [
            abs((its - black) / more - look.level) > _OFF_LEVEL if spread else None
            for its, black, more, spread in zip(means, scale.black, lit, scale.spread, strict=True)
        ]
        return _torn(off, "has not the light of its pattern")

    def _of_repetition(self, sample: Sample, step: Expose, look: Look) -> str:
        """Compare with the frame before, where it was of another pattern."""
        if self._last is None or self._last[0].pattern == step.pattern:
            return ""
        if _family(step) != self._family or len(self._gains) < _PAIRS:
            return ""
        change = _change(look, self._last[2])
        if change is None:
            return ""
        expected, evenly = change
        usual = np.median(np.stack(self._gains), axis=0)
        gains = _difference(sample, self._last[1]) / expected
        if _whole(gains) < _SAME * _whole(usual):
            return "the frame shows the pattern before its own: the projector is late"
        if not evenly:
            return ""
        parts: list[bool | None] = [
            True if gain < _SAME * its else False if gain > _CHANGED * its else None
            for gain, its in zip(gains, usual, strict=True)
        ]
        return _torn(parts, "shows the pattern before its own")

    def _remember(self, sample: Sample, step: Expose, look: Look | None) -> None:
        if step.lighting is Lighting.BLACK:
            self._black, self._scale = sample, None
        elif step.lighting is Lighting.WHITE:
            self._white, self._scale = sample, None
        if self._scale is None and self._black is not None and self._white is not None:
            self._scale = _Scale.of(self._black, self._white)
        if step.lighting is not Lighting.PATTERN or look is None:
            return
        if (family := _family(step)) != self._family:
            self._family = family
            self._gains.clear()
        elif self._last is not None and self._last[0].pattern != step.pattern:
            change = _change(look, self._last[2])
            if change is not None:
                self._gains.append(_difference(sample, self._last[1]) / change[0])
        self._last = (step, sample, look)


def head_problem(white: NDArray[Any], black: NDArray[Any], full_scale: float = math.inf) -> str:
    """Why two frames cannot be the white and the black image at the head of a sequence, or ""."""
    first, second = _sample(white), _sample(black)
    if _blind(second, full_scale):
        return ""
    if found := _of_white(first, second):
        return f"the light is not in step with the triggers: {found}"
    return ""


def _blind(sample: Sample, full_scale: float) -> bool:
    return float(np.mean(sample >= full_scale)) > _BLIND


def _of_white(white: Sample, black: Sample) -> str:
    more = white - black
    if float(_brightness(more.reshape(1, 1, -1))[0]) < _BRIGHTER:
        return "the white frame is not brighter than the black one: the projector is late"
    # A part of the scene that the projector does not reach is as dark as before, never darker.
    darker = _brightness(more) < -_BRIGHTER
    return _torn(darker.tolist(), "is darker than in the black frame")


def _torn(parts: Sequence[bool | None], how: str) -> str:
    """What is wrong with the bands, if a run of them from the top or from the bottom is unlike the
    rest. True: unlike; False: as it should be; None: it cannot be said."""
    if True not in parts or False not in parts:
        return ""
    for name, ordered in (("upper", parts), ("lower", parts[::-1])):
        first_good = ordered.index(False)
        if True in ordered[:first_good] and True not in ordered[first_good:]:
            return f"a frame is torn: its {name} part {how}"
    return ""


def _sample(pixels: NDArray[Any]) -> Sample:
    """Some pixels of a frame, spread evenly; of a mosaic whole cells, so that colours mix alike."""
    stride = max(1, round((pixels.shape[0] * pixels.shape[1] / _SAMPLES) ** 0.5)) | 1
    some = pixels[::stride, ::stride]
    bands = min(_BANDS, some.shape[0])
    rows = some.shape[0] // bands
    return some[: bands * rows].reshape(bands, rows, -1).astype(np.float32)


def _means(sample: Sample) -> Bands:
    return np.asarray(sample.mean(axis=(1, 2), dtype=np.float64))


def _brightness(more: Sample) -> Bands:
    """The mean of each band in standard errors; 0 where all is 0."""
    flat = more.reshape(len(more), -1)
    mean = flat.mean(axis=1, dtype=np.float64)
    error = flat.std(axis=1, dtype=np.float64) / math.sqrt(flat.shape[1])
    error = np.maximum(error, 1e-12)  # of an even difference: endlessly sure
    return np.asarray(mean / error)


def _family(step: Expose) -> object:
    """What the patterns of a set have in common: their kind and size, not their place."""
    pattern = step.pattern
    if pattern is None:
        return None
    fields = msgspec.structs.asdict(pattern).items()
    return type(pattern), tuple((name, value) for name, value in fields if name not in _PLACE)


def _change(one: Look, other: Look) -> tuple[float, bool] | None:
    """The difference of two images (rms), and whether it is everywhere about the same. None: they
    are as good as equal."""
    blocks = np.square(one.places - other.places).mean(axis=1)
    mean = float(blocks.mean())
    if mean < 1e-4:
        return None
    return mean**0.5, bool(float(blocks.min()) >= _EVENLY * mean)


def _difference(one: Sample, other: Sample) -> Bands:
    """Of two frames (rms), band by band."""
    flat = (one - other).reshape(len(one), -1)
    squares = np.einsum("bn,bn->b", flat, flat, dtype=np.float64)
    return np.asarray(np.sqrt(squares / flat.shape[1]))


def _whole(bands: Bands) -> float:
    return float(np.sqrt(np.mean(np.square(bands))))
