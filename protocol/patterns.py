"""What can be shown by a projector, as data; `daemon.patterns` draws it.

All lengths are projector pixels. ``x`` grows to the right, ``y`` downwards.
"""

from __future__ import annotations

import enum
from typing import Annotated

import msgspec
from msgspec import Meta

Length = Annotated[int, Meta(ge=1, le=4096)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]


class Pattern(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="pattern"
):
    """Something a projector can show."""


class Solid(Pattern, frozen=True, kw_only=True, tag="solid"):
    """Every pixel at one level: 0 is black (the source off), 1 is white."""

    level: Fraction


class Checker(Pattern, frozen=True, kw_only=True, tag="checker"):
    """A checkerboard of square checkers, half of them lit; `inverted` lights the other half."""

    size: Length = 8
    shift_x: int = 0
    shift_y: int = 0
    inverted: bool = False


class Axis(enum.StrEnum):
    """Along which axis a pattern varies: x makes vertical stripes, y horizontal ones."""

    X = "x"
    Y = "y"


class Sinusoid(Pattern, frozen=True, kw_only=True, tag="sinusoid"):
    """sin(x + sin y) (§4.3): ½ + ½ sin(2π x/period + weave sin(2π y/period) + phase).

    `weave` (radians) gives the pattern high frequencies along the other axis too; 0: plain stripes.
    """

    period: Annotated[float, Meta(ge=2.0, le=65_536.0)] = 16.0
    phase: float = 0.0  # radians
    axis: Axis = Axis.X
    weave: float = 1.0


class RandomPhase(Pattern, frozen=True, kw_only=True, tag="random-phase"):
    """½ + ½ sin(φ + phase) with φ drawn for each patch of pixels (§4.3).

    The brightness at phase 0 is uniform in 0 to 1 (the paper's), and half of the source at any.
    """

    patch: Length = 4
    phase: float = 0.0  # radians
    seed: Annotated[int, Meta(ge=0)] = 1


class GrayCode(Pattern, frozen=True, kw_only=True, tag="gray-code"):
    """One bit of each pixel's coordinate in Gray code (§4.3): bit 0 has the finest stripes, 2 px
    wide; bit j's are 2^(j+1) wide. `inverted` lights the other stripes."""

    bit: Annotated[int, Meta(ge=0, le=15)] = 0
    axis: Axis = Axis.X
    inverted: bool = False


class RandomBinary(Pattern, frozen=True, kw_only=True, tag="random-binary"):
    """Image `index` of `count` in which square patches are lit at random (§3.5, 4(c)).

    Each patch is lit in the same number of the images, the nearest to `lit_fraction` of them.
    """

    patch: Length = 6
    index: Annotated[int, Meta(ge=0)] = 0
    count: Annotated[int, Meta(ge=1, le=1000)] = 20
    lit_fraction: Fraction = 0.5
    seed: Annotated[int, Meta(ge=0)] = 1


class Stripes(Pattern, frozen=True, kw_only=True, tag="stripes"):
    """Bright and dark stripes of one width (§4.4)."""

    width: Length = 2
    axis: Axis = Axis.X
    shift: int = 0


AnyBinary = Solid | Checker | RandomBinary


class Unlit(Pattern, frozen=True, kw_only=True, tag="unlit"):
    """Another pattern with a square of pixels kept unlit around each of some points (§3.5).

    A square of an odd size has its middle on its point; of an even one, half a pixel before it.
    """

    base: AnyBinary = Solid(level=1.0)
    points: tuple[tuple[int, int], ...] = ()  # x, y
    size: Length = 6


AnyPattern = Solid | Checker | Sinusoid | RandomPhase | GrayCode | RandomBinary | Stripes | Unlit
BLACK = Solid(level=0.0)
WHITE = Solid(level=1.0)
