"""What a client may ask for: one frozen struct a method, pure validated data.

A spec says nothing of devices or time; the daemon's method of the same name turns it into
steps. Symbols are the paper's: α lit fraction, b leakage of an unlit source element.
"""

from __future__ import annotations

import enum
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from protocol.patterns import Axis

Count = Annotated[int, Meta(ge=1, le=100_000)]
Leak = Annotated[float, Meta(ge=0.0, lt=1.0)]
LitFraction = Annotated[float, Meta(gt=0.0, le=1.0, description="lit fraction α of the source")]
Positive = Annotated[float, Meta(gt=0.0)]
Checker = Annotated[int, Meta(ge=1, le=1024, description="side of a checker in projector pixels")]
ToneCurve = Annotated[
    str,
    Meta(
        pattern=r"^(linear|srgb|gamma:[0-9]+(\.[0-9]+)?)$",
        description="tone curve: linear, srgb, or gamma:2.2 (the exponent it was encoded with)",
    ),
]

Period = Annotated[float, Meta(ge=2.0, le=65_536.0)]  # projector pixels
Phases = Annotated[int, Meta(ge=3, le=1000, description="phases of each period, a whole turn")]
Patch = Annotated[int, Meta(ge=1, le=1024, description="side of a patch in projector pixels")]
Seed = Annotated[int, Meta(ge=0, le=2**53, description="of the random numbers")]

SUN_DEG = 0.53  # angular diameter
AXIS = "axis along which the pattern varies: x makes vertical stripes"
LEAKAGE = "brightness b of an unlit source element as a fraction of a lit one"
MODE = "how frames are kept in step with patterns: see docs/projectors.md"
ESTIMATOR = (
    "how frames become components; maxmin is the paper's, maxmin-unbiased the same less what noise "
    "and blur do to it, auto the best for the method"
)


class Reference(enum.StrEnum):
    """A frame that is not part of the pattern set."""

    AMBIENT = "ambient"  # the source off: nothing of the source, all of the room
    BLACK = "black"  # the source showing black: ambient and leakage
    WHITE = "white"  # the source showing white: everything
    OPEN = "open"  # no occluder before the source: everything


class Grid(enum.StrEnum):
    """How a mesh's holes lie."""

    SQUARE = "square"
    HEXAGONAL = "hexagonal"


class Radiometry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How camera counts become linear light. ``None`` means: as the rig is calibrated."""

    black: Annotated[float, Meta(ge=0.0, description="counts with no light at all")] | None = None
    tone: ToneCurve = "linear"  # undone before anything is computed
    leakage: Annotated[Leak, Meta(description=LEAKAGE)] | None = None
    saturation: (
        Annotated[Positive, Meta(description="counts from which a sample is called saturated")]
        | None
    ) = None


class Ready(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What must be so before a run's first frame, and for how long that is waited for.

    Room on the disk, healthy devices and a homed stage are needed by every run; light is looked at
    where a bound is given, in pictures that are no frames of the run. Levels are those of the
    brightest thousandth of the picture, as a share of the camera's full scale.
    """

    deadline_s: Annotated[
        float,
        Meta(
            ge=0,
            le=7 * 86_400,
            description="seconds to wait for all that a run needs before its first frame; "
            "0: it must be so at once",
        ),
    ] = 0.0
    light_min: (
        Annotated[
            float, Meta(gt=0, lt=1, description="least level of light to begin at, of full scale")
        ]
        | None
    ) = None
    light_max: (
        Annotated[float, Meta(gt=0, lt=1, description="most light to begin at, of full scale")]
        | None
    ) = None
    steady: (
        Annotated[
            float,
            Meta(gt=0, le=1, description="begin when the light of three looks differs by no more"),
        ]
        | None
    ) = None
    look_s: Annotated[
        float, Meta(ge=0.1, le=600, description="seconds from one look at the light to the next")
    ] = 10.0

    def __post_init__(self) -> None:
        """Raises ValueError for what can never be so."""
        if self.light_min and self.light_max and self.light_min >= self.light_max:
            raise ValueError("light_min must be below light_max")
        if self.steady and self.deadline_s < 2 * self.look_s:
            raise ValueError("steady takes three looks: deadline_s must be twice look_s at least")

    @property
    def looks(self) -> bool:
        """Whether the light matters."""
        return (self.light_min, self.light_max, self.steady) != (None, None, None)


class Spec(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="method"
):
    """What every run can be told, whatever it is for."""

    note: Annotated[str, Meta(description="what the run is for, kept with it")] = ""
    exposure_us: Annotated[Positive, Meta(description="exposure of a frame in µs")] | None = None
    gain: Annotated[float, Meta(description="of the camera, in its own unit")] | None = None
    auto_exposure: Annotated[
        bool,
        Meta(
            description="choose the exposure from pictures taken before the first frame, then keep "
            "it; an exposure that is given is the longest"
        ),
    ] = False
    ready: Ready = Ready()


class Scan(Spec, frozen=True, kw_only=True):
    """What every scan that separates can be told."""

    radiometry: Radiometry = Radiometry()
    #: None: black and white where the source can show them
    references: (
        Annotated[
            tuple[Reference, ...],
            Meta(description="frames to take before the patterns"),
        ]
        | None
    ) = None


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


class OccluderScan(Scan, frozen=True, kw_only=True):
    """A scan on video while an occluder moves between the scene and a source that has no pixels.

    It ends at the coverage wanted or at the time limit, whichever comes first.
    """

    frames: Annotated[Count, Meta(description="frames to take at most")] | None = None
    coverage: Annotated[
        float,
        Meta(gt=0.0, le=1.0, description="share of the lit pixels that ends the scan when covered"),
    ] = 0.995
    time_limit_s: Annotated[Positive, Meta(description="seconds after which it ends anyway")] = (
        600.0
    )
    sun: Annotated[
        bool, Meta(description="the source drifts and clouds pass: follow its strength")
    ] = False
    align: Annotated[
        bool, Meta(description="find the camera's shake, and align or reject what it moved")
    ] = True
    drift_deg: Annotated[
        Positive,
        Meta(description="how far the sun may have gone when an interrupted scan is resumed"),
    ] = 1.0
    #: None: all of the rig
    lights: Annotated[tuple[str, ...], Meta(description="sources to switch on, by name")] | None = (
        None
    )
    frame_rate_hz: Annotated[Positive, Meta(description="of the camera")] | None = None
    feed_mm_s: Annotated[Positive, Meta(description="speed of the stage")] | None = None


class Stick(OccluderScan, frozen=True, kw_only=True, tag="stick"):
    """A thin occluder swept over the scene on video (§4.2): α is close to 1, b = 0 in the umbra.

    Swept by the rig's stage if it has one, else by hand.
    """

    lit_fraction: LitFraction = 1.0
    estimator: Annotated[Literal["auto", "maxmin"], Meta(description=ESTIMATOR)] = "auto"
    axis: Annotated[Axis, Meta(description="axis of the stage along which the stick moves")] = (
        Axis.X
    )
    sweeps: Annotated[int, Meta(ge=1, le=1000, description="sweeps of the stage, to and fro")] = 2
    #: None: the stage's whole travel
    sweep_mm: (
        Annotated[tuple[float, float], Meta(description="from where to where on that axis, mm")]
        | None
    ) = None


class Mesh(OccluderScan, frozen=True, kw_only=True, tag="mesh"):
    """A grid of holes on a small circle, on video (§4.2): α is the hole fraction β, b = 0 in the
    umbra. β is told, or follows from the mesh, or is measured: places are lit for β of the time.
    """

    hole_fraction: (
        Annotated[float, Meta(gt=0.0, lt=1.0, description="β, the part of the mesh that is hole")]
        | None
    ) = None
    hole_mm: Annotated[Positive, Meta(description="diameter of a hole")] | None = None
    pitch_mm: Annotated[Positive, Meta(description="from hole to hole")] | None = None
    grid: Annotated[Grid, Meta(description="how the holes lie")] = Grid.SQUARE
    radius_mm: Annotated[Positive, Meta(description="of the circle")] | None = None  # None: best
    centre_mm: (
        Annotated[tuple[float, float], Meta(description="of the circle on the stage")] | None
    ) = None  # None: the middle of the travel
    scene_mm: (
        Annotated[float, Meta(ge=0.0, description="from the mesh to the scene, for the penumbra")]
        | None
    ) = None
    source_deg: Annotated[
        float, Meta(ge=0.0, lt=90.0, description="angular diameter of the source; sun 0.53")
    ] = SUN_DEG
    estimator: Annotated[Literal["auto", "maxmin"], Meta(description=ESTIMATOR)] = "auto"


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

    stripe: Annotated[int, Meta(ge=1, le=1024, description="width of a stripe, px")] = 2
    axis: Annotated[Axis, Meta(description=AXIS)] = Axis.X
    window: Annotated[int, Meta(ge=3, le=1001, description="n, camera px across stripes")] = 11
    along: Annotated[int, Meta(ge=1, le=1001, description="m, camera px along stripes")] = 1
    reduce: Annotated[int, Meta(ge=1, le=64, description="k, camera px averaged each way")] = 4
    repeat: Annotated[Count, Meta(description="images, one after the other; live: many")] = 1


class Measuring(Spec, frozen=True, kw_only=True):
    """A run that measures the rig, or how well it separates: it ends in figures and plots."""


class Calibration(Measuring, frozen=True, kw_only=True):
    """A measurement that later runs apply by themselves, for as long as it is valid."""

    @property
    def kind(self) -> str:
        """What it calibrates: dark, noise, leak, tone or latency."""
        return str(self.__struct_config__.tag).removeprefix("calibrate-")


Levels = Annotated[int, Meta(ge=3, le=256)]


class CalibrateDark(Calibration, frozen=True, kw_only=True, tag="calibrate-dark"):
    """Black level, read noise and hot pixels of the camera; put its lens cap on if it has one."""

    exposures: Annotated[int, Meta(ge=2, le=32, description="exposure times, doubled from one to "
                                   "the next up to the present one")] = 4  # fmt: skip
    frames: Annotated[int, Meta(ge=2, le=1000, description="frames at each exposure")] = 8


class CalibrateNoise(Calibration, frozen=True, kw_only=True, tag="calibrate-noise"):
    """The camera's gain and noise by photon transfer: pairs of frames at several exposures."""

    exposures: Annotated[int, Meta(ge=2, le=32, description="exposure times, evenly spread up to "
                                   "the present one")] = 6  # fmt: skip
    pairs: Annotated[int, Meta(ge=1, le=500, description="pairs of frames at each exposure")] = 4


class CalibrateLeak(Calibration, frozen=True, kw_only=True, tag="calibrate-leak"):
    """The projector's leakage b, and what lit and unlit patches of several sizes keep of it."""

    sizes: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=256)], ...],
        Meta(min_length=2, description="sides of the patches, projector px; largest: reference"),
    ] = (1, 2, 3, 4, 6, 8, 12, 16)
    average: Annotated[int, Meta(ge=2, le=1000, description="frames averaged a pattern")] = 2


class CalibrateTone(Calibration, frozen=True, kw_only=True, tag="calibrate-tone"):
    """The projector's response to its levels; patterns are then drawn so that light is linear."""

    levels: Annotated[Levels, Meta(description="levels, evenly spread from black to white")] = 33
    average: Annotated[Count, Meta(description="frames averaged a level")] = 2


class CalibrateLatency(Calibration, frozen=True, kw_only=True, tag="calibrate-latency"):
    """How much later than the driver says the projector's light changes, and its spread."""

    longest_ms: Annotated[Positive, Meta(le=2000, description="delays up to this are found")] = 100
    flashes: Annotated[int, Meta(ge=8, le=1000, description="flashes, their triggers spread")] = 48


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


PatchSizes = Annotated[
    tuple[Annotated[int, Meta(ge=1, le=256)], ...],
    Meta(min_length=2, max_length=64, description="sides in projector px"),
]


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


class Advise(Measuring, frozen=True, kw_only=True, tag="advise"):
    """A short sweep of checker sizes that says which pattern, how many images and what exposure
    this scene needs for a wanted error, and what limits it (Appendix A)."""

    error: Annotated[
        float, Meta(gt=0, le=0.5, description="wanted in direct and global, of full scale")
    ] = 0.01
    sizes: PatchSizes = (2, 3, 4, 6, 8, 12, 16, 24)
    average: Annotated[int, Meta(ge=2, le=1000, description="frames averaged a pattern")] = 2


AnySeparation = (
    Checkerboard
    | TwoImage
    | Stick
    | Mesh
    | Sinusoid
    | RandomPhase
    | GrayCode
    | RandomBinary
    | SingleImage
)
AnyCalibration = CalibrateDark | CalibrateNoise | CalibrateLeak | CalibrateTone | CalibrateLatency
AnyVerification = VerifyPatchSize | VerifyRandomPatterns | VerifyLitFraction | VerifyCheckerSize
AnyScan = AnySeparation | AnyCalibration | AnyVerification | Advise
