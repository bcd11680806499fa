"""Proof of step: whether a frame shows its own pattern, judged by what it looks like.

Time stamps prove when a frame was exposed, not what the projector really showed meanwhile: it may
flip a refresh later than it says, show the image before, or nothing. What can be known without a
map from camera to projector:

- a white frame is brighter than a black one;
- under a pattern that is fine enough to be even over the scene, the scene as a whole is as bright
  as the pattern's mean level says, between black and white: a black frame and a pattern that never
  came are far from it;
- a frame that is as good as equal to the one before, while other pairs of the same family of
  patterns differ, shows the pattern before.

Only frames of one exposure time are compared, and of these what was not saturated.

Pure: no I/O, no threads. Only a sample of each frame is kept, so that it costs little.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.scans.method import Expose
from daemon.separation.estimator import Lighting

_SAMPLES = 20_000
_FEW = 500  # samples that were not saturated: fewer say nothing
_BRIGHTER = 5.0  # standard errors: by how much white must be brighter than black, at least
_OFF_LEVEL = 0.4  # of the way from black to white: how far a pattern's brightness may be off
_SAME = 0.35  # of the usual difference between two patterns: below it they are one
_PAIRS = 3  # pairs of a family of patterns before "usual" means anything
_EVEN = 0.15  # how far a block's mean may be from the pattern's own for it to be called even
_BLOCKS = 6  # along each side
#: what tells the patterns of a family apart
_PLACE = {"shift_x", "shift_y", "shift", "phase", "seed", "index", "inverted"}

Sample = NDArray[np.float32]


def expected_level(image: NDArray[np.uint8]) -> float | None:
    """The share of white's light that the scene as a whole gets under an image (h, w) uint8; None
    where it is too coarse to say: parts of the scene would get more of it than others."""
    height, width = (side // _BLOCKS * _BLOCKS for side in image.shape)
    blocks = image[:height, :width].reshape(_BLOCKS, height // _BLOCKS, _BLOCKS, width // _BLOCKS)
    means = blocks.mean(axis=(1, 3)) / 255
    level = float(means.mean())
    return level if float(np.abs(means - level).max()) <= _EVEN else None


class Proof:
    """Judges frame after frame of one scan; a frame that failed is forgotten, not compared with.

    `full_scale` is the count of a saturated sample.
    """

    def __init__(self, full_scale: float = np.inf) -> None:
        self._full_scale = full_scale
        self._exposures: dict[float | None, _Looks] = {}

    def problem(self, pixels: NDArray[Any], step: Expose, expected: float | None) -> str:
        """Why the frame (H, W) or (H, W, 3) cannot be of this step; "" if it can.

        `expected` is the `expected_level` of what the projector was given.
        """
        looks = self._exposures.setdefault(step.exposure_us, _Looks(self._full_scale))
        return looks.problem(pixels, step, expected)


class _Looks:
    """The frames of one exposure time."""

    def __init__(self, full_scale: float) -> None:
        self._full_scale = full_scale
        self._black: Sample | None = None
        self._white: Sample | None = None
        self._last: tuple[Expose, Sample] | None = None
        self._family: object = None
        self._differences: deque[float] = deque(maxlen=16)

    def problem(self, pixels: NDArray[Any], step: Expose, expected: float | None) -> str:
        """See `Proof`."""
        sample = _sample(pixels)
        found = self._problem(sample, step, expected)
        if not found:
            self._remember(sample, step)
        return found

    def _problem(self, sample: Sample, step: Expose, expected: float | None) -> str:
        if step.lighting is Lighting.WHITE:
            if self._black is None:
                return ""
            good = self._black < self._full_scale
            enough = good.sum() >= min(_FEW, good.size)
            if enough and not _brighter(sample[good], self._black[good]):
                return "the white frame is not brighter than the black one: the projector is late"
            return ""
        if step.lighting is not Lighting.PATTERN:
            return ""
        return self._of_level(sample, expected) or self._of_repetition(sample, step)

    def _of_level(self, sample: Sample, expected: float | None) -> str:
        """Compare with the levels of black and white, where the scan has taken both."""
        if self._black is None or self._white is None or expected is None:
            return ""
        good = self._white < self._full_scale
        if good.sum() < min(_FEW, good.size):
            return ""
        black, white = float(self._black[good].mean()), float(self._white[good].mean())
        share = (float(sample[good].mean()) - black) / (white - black)
        if abs(share - expected) <= _OFF_LEVEL:
            return ""
        return (
            f"the frame has {share:.0%} of the light of white, its pattern {expected:.0%}: "
            "another image was shown"
        )

    def _of_repetition(self, sample: Sample, step: Expose) -> str:
        """Compare with the frame before, where it was of another pattern."""
        if self._last is None or self._last[0].pattern == step.pattern:
            return ""
        if _family(step) != self._family:
            return ""
        difference = _difference(sample, self._last[1])
        if len(self._differences) >= _PAIRS:
            usual = float(np.median(self._differences))
            if difference < _SAME * usual:
                return "the frame shows the pattern before its own: the projector is late"
        return ""

    def _remember(self, sample: Sample, step: Expose) -> None:
        if step.lighting is Lighting.BLACK:
            self._black = sample
        elif step.lighting is Lighting.WHITE:
            self._white = sample
        if step.lighting is not Lighting.PATTERN:
            return
        if (family := _family(step)) != self._family:
            self._family = family
            self._differences.clear()
        elif self._last is not None and self._last[0].pattern != step.pattern:
            self._differences.append(_difference(sample, self._last[1]))
        self._last = (step, sample)


def _sample(pixels: NDArray[Any]) -> Sample:
    """Some pixels of a frame, spread evenly; of a mosaic whole cells, so that colours mix alike."""
    stride = max(1, round((pixels.shape[0] * pixels.shape[1] / _SAMPLES) ** 0.5)) | 1
    return pixels[::stride, ::stride].astype(np.float32)


def _brighter(white: Sample, black: Sample) -> bool:
    more = white - black
    standard_error = float(more.std()) / float(more.size) ** 0.5
    return bool(float(more.mean()) > _BRIGHTER * standard_error)


def _family(step: Expose) -> object:
    """What the patterns of a set have in common: their kind and size, not their place."""
    pattern = step.pattern
    if pattern is None:
        return None
    fields = msgspec.structs.asdict(pattern).items()
    return type(pattern), tuple((name, value) for name, value in fields if name not in _PLACE)


def _difference(one: Sample, other: Sample) -> float:
    return float(np.sqrt(np.mean((one - other) ** 2)))
