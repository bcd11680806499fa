"""The contract of a scan method: which steps, what each frame is for, which estimator.

A method is asked for its next step until it gives None. It sees the summary of the estimator as
far as frames have been taken in, so it may repeat, extend or end; it never touches a device.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, TypeVar

import msgspec
from numpy.typing import NDArray

from daemon.separation.estimator import Components, Estimator, Lighting, Observation
from drivers.base.camera import CameraInfo
from drivers.base.projector import ProjectorInfo
from drivers.base.stage import StageInfo
from protocol.patterns import AnyPattern
from protocol.scans.spec import Spec

S = TypeVar("S", bound=Spec)

INCOMPLETE = "incomplete frame"
"""The reason for which a frame that the camera delivered in part is not used."""


class Unsuitable(Exception):
    """The rig cannot do the scan as it was asked for; says what and how to mend it."""

    def __init__(self, message: str, where: str = "") -> None:
        super().__init__(message)
        self.where = where


@dataclass(frozen=True, slots=True)
class Bench:
    """The rig as a method sees it: facts, no devices. None: the rig has no such device."""

    camera: CameraInfo
    projector: ProjectorInfo | None = None
    stage: StageInfo | None = None
    lights: tuple[str, ...] = ()
    exposure_us: float | None = None  # of the camera as it is set
    gain: float | None = None  # the same
    calibration: Mapping[str, Any] | None = None  # values that apply: see daemon.runs.calibration

    def recorded(self) -> dict[str, Any]:
        """As run.json keeps it, JSON-able; the calibration has a place of its own there."""
        found: dict[str, Any] = msgspec.to_builtins(replace(self, calibration=None))
        return found

    @classmethod
    def of(cls, recorded: Mapping[str, Any], calibration: Mapping[str, Any]) -> Bench:
        """The bench that was recorded. Raises msgspec.ValidationError."""
        return replace(msgspec.convert(recorded, cls), calibration=calibration)


@dataclass(frozen=True, slots=True)
class Expose:
    """A step: show one pattern, then expose `frames` times. On a recording, take the next frames.

    With `pattern` None the projector goes dark and the lights off, as for ambient.
    """

    pattern: AnyPattern | None
    lighting: Lighting = Lighting.PATTERN
    index: int = 0  # which of the pattern set
    frames: int = 1
    exposure_us: float | None = None  # None: the run's
    exposure: float = 1.0  # which of a bracket, as a multiple of the run's
    delay_s: float = 0.0  # from the light being the pattern's to the first trigger


@dataclass(frozen=True, slots=True)
class Circle:
    """A motion of the stage: round and round, without an end of its own."""

    centre_mm: tuple[float, float]
    radius_mm: float
    feed_mm_s: float


@dataclass(frozen=True, slots=True)
class Sweep:
    """A motion of the stage: straight to each point in turn; it ends at the last."""

    points_mm: tuple[tuple[float, float], ...]
    feed_mm_s: float


Motion = Circle | Sweep


@dataclass(frozen=True, slots=True)
class Watch:
    """A step: let the camera stream, `frames` of them or (None) to the end of a recording, or until
    the method says `enough`, or its motion ends.

    `lights` are switched on before; the stage is homed if it must be, and moves meanwhile.
    """

    frames: int | None
    motion: Motion | None = None
    lights: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Digest:
    """A step without frames: the next is asked for only when the estimator has taken in all frames
    before it, so that it may depend on what they said."""


Step = Expose | Watch | Digest


@dataclass(frozen=True, slots=True)
class Taken:
    """What the recorder knows of a frame when the method decides on its use."""

    step: int
    sub: int
    incomplete: bool
    source: str = ""
    pixels: NDArray[Any] | None = None  # of the frame, only to be read, within the call
    delay_us: float = 0.0  # see Observation
    exposure_us: float = 0.0


class Method(ABC, Generic[S]):
    """A scan in its course. Made from a validated spec and a bench; pure."""

    name: ClassVar[str]
    looked_at: ClassVar[bool] = True  # frames must look like their patterns: see exposing.proof

    def __init__(self, spec: S, bench: Bench) -> None:
        """Raises Unsuitable when the rig lacks what the scan needs, or the numbers don't fit."""
        self.spec = spec
        self.bench = bench

    @abstractmethod
    def planned(self) -> int | None:
        """Frames that the plan will expose; None where it is not known beforehand."""

    @abstractmethod
    def step(self, index: int, summary: Mapping[str, float]) -> Step | None:
        """Step number `index`, or None at the end. For a plan the same index gives the same step,
        which is how an interrupted scan goes on."""

    @abstractmethod
    def observe(self, step: Step, taken: Taken) -> Observation:
        """Decide what a frame is used for. Called once a frame, in order; recorded."""

    def foresee(self, frames: Iterator[NDArray[Any]]) -> None:
        """Look through a recording before its first frame is observed or recalled. `frames` gives
        all of them from the first on, references included; each is valid until the next is taken.
        """
        del frames

    def recall(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See a frame again that `observe` has decided on before an interruption; in order."""
        del pixels, observation

    def decides_as(self, other: Method[Any]) -> bool:
        """Whether `observe` would decide on every frame as `other` did, a method of the same scan
        with another reading of its frames (tone, black level ...). If not, reprocessing has every
        frame observed again."""
        del other
        return True

    @abstractmethod
    def estimator(self) -> Estimator:
        """A fresh estimator for this scan."""

    def enough(self, summary: Mapping[str, float], seconds: float) -> str:
        """Why a video may end now, `seconds` after it began; "": it goes on."""
        del summary, seconds
        return ""

    def short(self) -> bool:
        """Whether the video ended with too few frames for its reason to be one of the scene's."""
        return False

    def conclude(self, components: Components) -> Components:
        """Complete the components with what only the method knows, before they are kept."""
        return components
