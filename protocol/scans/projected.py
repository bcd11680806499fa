"""Scans of patterns that a projector shows (§3.3, §4.1, §4.3, §4.4)."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from protocol.patterns import Axis
from protocol.scans.spec import ESTIMATOR, Count, LitFraction, Positive, Scan

Checker = Annotated[int, Meta(ge=1, le=1024, description="side of a checker in projector pixels")]
Period = Annotated[float, Meta(ge=2.0, le=65_536.0)]  # projector pixels
Phases = Annotated[int, Meta(ge=3, le=1000, description="phases of each period, a whole turn")]
Patch = Annotated[int, Meta(ge=1, le=1024, description="side of a patch in projector pixels")]
Seed = Annotated[int, Meta(ge=0, le=2**53, description="of the random numbers")]
AXIS = "axis along which the pattern varies: x makes vertical stripes"
MODE = "how frames are kept in step with patterns: see docs/projectors.md"


class PatternScan(Scan, frozen=True, kw_only=True):
    """A scan of a fixed set of patterns."""

    average: Annotated[Count, Meta(description="frames averaged a pattern (the paper: 32)")] = 1
    #: Components are in counts of the run's own exposure, which need not be one of these. On a
    #: recording each pattern's images follow one another in this order, references too.
    bracket: (
        Annotated[
            tuple[Positive, ...],
            Meta(
                min_length=2,
                max_length=16,
                description="exposures of each pattern, as parts or multiples of the run's own, "
                "merged: 0.25,1,4",
            ),
        ]
        | None
    ) = None
    lit_fraction: LitFraction | None = None  # None: the pattern's own
    #: None: as rig.toml says
    mode: (
        Annotated[Literal["auto", "hardware", "software", "free"], Meta(description=MODE)] | None
    ) = None
    estimator: Annotated[
        Literal["auto", "maxmin", "maxmin-unbiased", "topk", "lsq"], Meta(description=ESTIMATOR)
    ] = "auto"


class Checkerboard(PatternScan, frozen=True, kw_only=True, tag="checkerboard"):
    """Checkerboard shifts (§4.1): the paper's 25 images are 8 px checkers, 5 x 5 shifts of 3 px."""

    checker: Checker = 8
    shift: Annotated[int, Meta(ge=1, le=1024, description="step from one to the next, px")] = 3
    shifts: Annotated[int, Meta(ge=2, le=64, description="shifts in each direction")] = 5


class TwoImage(PatternScan, frozen=True, kw_only=True, tag="two-image"):
    """A checkerboard and its complement (§3.3, Eq. 8)."""

    checker: Checker = 8


class Sinusoid(PatternScan, frozen=True, kw_only=True, tag="sinusoid"):
    """sin(x + sin y) shifted along x (§4.3): N >= 3 phases of each period.

    Several periods give as many independent separations, which are averaged and compared, and
    (with no weave) an absolute projector coordinate. Frames come period by period.
    """

    periods: Annotated[
        tuple[Period, ...],
        Meta(min_length=1, max_length=16, description="periods in projector pixels"),
    ] = (16.0,)
    phases: Phases = 3
    axis: Annotated[Axis, Meta(description=AXIS)] = Axis.X
    weave: Annotated[
        float, Meta(description="phase swing along the other axis, radians; 0: plain stripes")
    ] = 1.0


class RandomPhase(PatternScan, frozen=True, kw_only=True, tag="random-phase"):
    """Each patch of projector pixels a sinusoid in time with a phase of its own (§4.3)."""

    patch: Patch = 4
    phases: Phases = 3
    seed: Seed = 1


class GrayCode(PatternScan, frozen=True, kw_only=True, tag="gray-code"):
    """Gray code and its inverses (§4.3): direct and global from the finest stripes that each pixel
    resolves, and the projector coordinate of each pixel. The coarsest bit comes first."""

    axes: Annotated[
        tuple[Axis, ...], Meta(min_length=1, max_length=2, description="coded axes: x, y or x,y")
    ] = (Axis.X,)
    bits: (
        Annotated[int, Meta(ge=1, le=16, description="bits an axis (a recording's must be told)")]
        | None
    ) = None  # None: as many as the projector's size takes


class RandomBinary(PatternScan, frozen=True, kw_only=True, tag="random-binary"):
    """Random binary patterns in which each patch is lit equally often (§3.5)."""

    patch: Patch = 6
    patterns: Annotated[int, Meta(ge=2, le=1000, description="images")] = 20
    seed: Seed = 1


class SingleImage(PatternScan, frozen=True, kw_only=True, tag="single-image"):
    """One image under fine stripes (§4.4): the peaks and valleys in a window across the stripes are
    interpolated, and averaged over squares: components at 1/reduce of the camera's resolution."""

    stripe: Annotated[int, Meta(ge=1, le=1024, description="width of a stripe, px")] = 4
    axis: Annotated[Axis, Meta(description=AXIS)] = Axis.X
    window: Annotated[int, Meta(ge=3, le=1001, description="n, camera px across stripes")] = 11
    along: Annotated[int, Meta(ge=1, le=1001, description="m, camera px along stripes")] = 1
    reduce: Annotated[int, Meta(ge=1, le=64, description="k, camera px averaged each way")] = 4
    repeat: Annotated[Count, Meta(description="images, one after the other; live: many")] = 1
