"""The contract between frames and results: observations go in, components come out, or figures.

An estimator is pure: no I/O, no threads, no clock; its memory does not grow with the frames; and
the same observations in the same order give the same bits, so that a resumed or reprocessed run
equals an uninterrupted one.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray


class Lighting(enum.StrEnum):
    """What the source did in a frame."""

    PATTERN = "pattern"  # one of the method's set, or an occluder's shadow
    AMBIENT = "ambient"  # off
    BLACK = "black"  # showing black: b of it leaks
    WHITE = "white"  # showing white
    OPEN = "open"  # in full, with no occluder before it


class Observation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A recorded decision about one frame; durable in frames.jsonl, replayed by a resume."""

    lighting: Lighting = Lighting.PATTERN
    pattern: int = 0  # which of the set; frames of one pattern are averaged
    last: bool = True  # the last frame of its pattern: what was averaged is complete
    used: bool = True
    reason: str = ""  # why not used, or why with less weight
    weight: float = 1.0
    strength: float = 1.0  # of the source in this frame, relative to the run's reference
    warp: tuple[float, ...] | None = None  # 2x3 affine, row by row: frame -> reference
    fresh: bool = False  # the collection begins anew with this frame: none before it is used
    delay_us: float = 0.0  # of the exposure's start, after the light was said to be the pattern's
    exposure_us: float = 0.0  # as the device gave it; 0: unknown
    exposure: float = 1.0  # of a bracket: as it was asked for, of the run's own


class Quality(enum.IntFlag):
    """What is wrong with a pixel's components; 0 is a good one. Bits of quality planes (uint16)."""

    SATURATED = 1 << 0  # a sample at the end of the camera's scale: components are too small
    DARK = 1 << 1  # not told from no light at all
    LOW_MODULATION = 1 << 2  # direct not told from noise
    NEVER_LIT = 1 << 3  # no frame with the source in full: direct is not known (NaN)
    NEVER_UNLIT = 1 << 4  # no frame in shadow: direct and global cannot be told apart (NaN)
    NEGATIVE = 1 << 5  # a component below zero by more than noise
    RESIDUE = 1 << 6  # the pattern shows in a component: light was not smooth, as of a mirror
    DISAGREE = 1 << 7  # patterns give different components
    MOVED = 1 << 8  # the scene, the camera or the source changed between frames
    SINGLE = 1 << 9  # one extreme rests on a single frame: noise, or a fleck, passes for light
    EDGE = 1 << 10  # at an edge of the pattern: its light is split as its neighbours' is


@dataclass(frozen=True, slots=True)
class Components:
    """The separation of a scene, at any time of a scan.

    `direct`, `global_`: float32 (H, W) or (H, W, 3) RGB, linear counts in the input's full scale,
    black and ambient removed; NaN where a component was not measured. `quality`: uint16 (H, W) of
    `Quality`. `planes`: further products of the method (coverage, phase, deviation ...), float32
    or uint16, by name. `facts`: figures for quality.json.
    """

    direct: NDArray[np.float32]
    global_: NDArray[np.float32]
    quality: NDArray[np.uint16]
    planes: dict[str, NDArray[Any]] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Curve:
    """A series of figures: `y` and its standard deviation `sd` (None: not known) against `x`, all
    float64 of one length. `line`: y = line[0] + line[1] x was fitted to it."""

    name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    sd: NDArray[np.float64] | None = None
    line: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves over common axes; the labels name the quantity and its unit."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    from_zero: bool = True  # the y axis begins at 0
    log_x: bool = False


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a run found out where it does not end in a separation: a calibration, a verification.

    `facts`: figures, JSON-able; `plots` by name; `planes`: (H, W) float32 or uint16 by name.
    `name` is the name of the figures' file. Of the facts, `figures` are [name, value] pairs of text
    for a person's first look, `criteria` are {"criterion", "measured", "met"}, and `advice` lines.
    """

    facts: dict[str, Any]
    plots: dict[str, Plot] = field(default_factory=dict)
    planes: dict[str, NDArray[Any]] = field(default_factory=dict)
    name: str = "measurement"


Result = Components | Measurement
"""What an estimator comes to."""


class NotYet(Exception):
    """There are too few observations for any result; says what is missing."""


class Estimator(Protocol):
    """Frames in, components (or a measurement) out."""

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """Take in one frame, (H, W) or (H, W, 3), uint8 or uint16 (float32 light where the response
        is a `bracket.Radiance`); `pixels` is only read, and not kept. Unused observations are
        counted, not more."""
        ...

    def result(self) -> Result:
        """The result from what has come so far; does not change the estimator. Raises NotYet."""
        ...

    def summary(self) -> dict[str, float]:
        """Figures cheap enough for every step: counts, noise, coverage, convergence."""
        ...
