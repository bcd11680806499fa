"""What can be shown by a projector, as data; `daemon.patterns` draws it.

All lengths are projector pixels. ``x`` grows to the right, ``y`` downwards.
"""

from __future__ import annotations

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


AnyPattern = Solid | Checker
BLACK = Solid(level=0.0)
WHITE = Solid(level=1.0)
