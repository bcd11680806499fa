"""What every run can be told, and every scan that separates: exposure, readiness, radiometry."""

from __future__ import annotations

import enum
from typing import Annotated

import msgspec
from msgspec import Meta

Count = Annotated[int, Meta(ge=1, le=100_000)]
Leak = Annotated[float, Meta(ge=0.0, lt=1.0)]
Positive = Annotated[float, Meta(gt=0.0)]
LitFraction = Annotated[float, Meta(gt=0.0, le=1.0, description="lit fraction α of the source")]
ToneCurve = Annotated[
    str,
    Meta(
        pattern=r"^(linear|srgb|gamma:[0-9]+(\.[0-9]+)?)$",
        description="tone curve: linear, srgb, or gamma:2.2 (the exponent it was encoded with)",
    ),
]
LEAKAGE = "brightness b of an unlit source element as a fraction of a lit one"
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
            description="seconds to wait for all that a run needs before its first frame, and "
            "for a device that fails later; 0: it must be so at once",
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

    note: Annotated[str, Meta(max_length=4096, description="what the run is for, kept with it")] = (
        ""
    )
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
