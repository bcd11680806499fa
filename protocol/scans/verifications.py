"""The experiments of §3.5: how well the rig separates."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from protocol.scans.measuring import Measuring, PatchSizes
from protocol.scans.projected import Patch, Seed
from protocol.scans.spec import LEAKAGE, Leak


class Point(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A point of interest in camera pixels; without a name it gets a letter."""

    x: Annotated[float, Meta(ge=0)]
    y: Annotated[float, Meta(ge=0)]
    name: str = ""


class Verification(Measuring, frozen=True, kw_only=True):
    """An experiment of §3.5: the global component at points that are kept unlit."""

    points: Annotated[
        tuple[Point, ...],
        Meta(max_length=26, description="a point of interest in camera pixels; several times"),
    ] = ()
    average: Annotated[
        int, Meta(ge=2, le=1000, description="frames averaged a pattern (the paper: 32)")
    ] = 16
    leakage: Annotated[Leak, Meta(description=LEAKAGE)] | None = None  # None: as calibrated


class VerifyPatchSize(Verification, frozen=True, kw_only=True, tag="verify-patch-size"):
    """Figure 4(b): the scene lit but for p x p patches at the points, p swept."""

    sizes: PatchSizes = (3, 5, 7, 9, 11, 13, 15, 17, 19, 21)


class VerifyRandomPatterns(Verification, frozen=True, kw_only=True, tag="verify-random-patterns"):
    """Figure 4(c): many random half-lit patterns; mean and deviation of the global component."""

    patterns: Annotated[int, Meta(ge=4, le=1000, description="how many")] = 100
    patch: Patch = 6
    seed: Seed = 1


class VerifyLitFraction(Verification, frozen=True, kw_only=True, tag="verify-lit-fraction"):
    """Figure 4(d): random patterns with a fraction α of their patches lit, α swept."""

    fractions: Annotated[
        tuple[Annotated[float, Meta(gt=0, lt=1)], ...],
        Meta(min_length=3, max_length=64, description="lit fractions α"),
    ] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    draws: Annotated[int, Meta(ge=1, le=100, description="random patterns at each fraction")] = 8
    patch: Patch = 6
    seed: Seed = 1


class VerifyCheckerSize(Verification, frozen=True, kw_only=True, tag="verify-checker-size"):
    """Figure 4(e): checkers of q pixels, q swept, with the same patch at the points unlit."""

    sizes: PatchSizes = (2, 3, 4, 6, 8, 12, 16, 20, 24, 32)
    patch: Patch = 6
