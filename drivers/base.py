"""What a device is: Camera, Projector, Stage, Light, the frames they make, the errors they raise.

A driver is small: connect, identify, configure, act, halt, close. The daemon gives each device one
thread that makes all of its calls, so a driver needs no locks of its own, with one exception:
`halt()` may be called from any thread at any moment, also while another call is blocked, and makes
that call return or raise soon. A driver never sleeps for a fixed time where it can wait for an
event, and takes the time from its context's clock.

Each driver's docstring states which of its commands are safe to send again after a failure.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock, RealClock

# ---------------------------------------------------------------- errors


class DeviceError(Exception):
    """Something went wrong in a device: which one, in what phase, and what to do about it."""

    def __init__(self, device: str, phase: str, problem: str, remedy: str = "") -> None:
        super().__init__(device, phase, problem, remedy)
        self.device = device
        self.phase = phase
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        sentence = f"{self.device}: {self.phase}: {self.problem}"
        return f"{sentence}; {self.remedy}" if self.remedy else sentence


class DeviceLost(DeviceError):
    """It is not there, or no longer: nothing may be assumed of what was in flight."""


class DeviceTimeout(DeviceError):
    """It did not answer in time; it may or may not have acted."""


class DeviceRefused(DeviceError):
    """It answered no: it did not act, and the same command will be refused again."""


class DeviceGarbled(DeviceError):
    """It answered something that makes no sense."""


class EndOfRecording(DeviceRefused):
    """A recorded camera has no more frames."""


# ---------------------------------------------------------------- what every device has


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A driver's own keys in rig.toml. Subclass it; the registry validates strictly."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device says it is; compared after every reconnect."""

    model: str
    serial: str = ""
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class Context:
    """What drivers of one rig share: the clock, and a place to meet (the virtual bench)."""

    clock: Clock = field(default_factory=RealClock)
    shared: dict[str, Any] = field(default_factory=dict)


class Device(ABC):
    """The life of a device: made (touches nothing) -> connect -> ... -> close. `connect` may be
    called again after a loss."""

    options_type: ClassVar[type[Options]] = Options
    kind: ClassVar[str]

    def __init__(self, name: str, options: Options, context: Context) -> None:
        self.name = name
        self.options = options
        self.clock = context.clock

    @abstractmethod
    def connect(self) -> Identity:
        """Open the device and find out what it is. Raises DeviceError; then nothing is held."""

    @abstractmethod
    def check(self) -> None:
        """Ask for a sign of life, cheaply; called now and then while idle. Raises DeviceError."""

    @abstractmethod
    def safe(self) -> None:
        """Go to the safe state (dark, off, held, stopped); idempotent. Raises DeviceError."""

    @abstractmethod
    def halt(self) -> None:
        """From any thread: end a blocked call, stop what moves. Never blocks, never raises."""

    @abstractmethod
    def close(self) -> None:
        """Let go of everything; idempotent; does not raise for a device that is gone."""

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """What of this driver is attached: `model`, `serial`, and `options` to paste into rig.toml.
        [] where a driver cannot tell. Raises DeviceError."""
        return []

    def facts(self) -> dict[str, Any]:
        """What people and scripts want to know of it, JSON-able; no I/O."""
        return {}


# ---------------------------------------------------------------- camera


class PixelFormat(enum.StrEnum):
    """SFNC PixelFormat names that Umbra understands; 10 to 14 bit come unpacked and unshifted."""

    MONO8 = "Mono8"
    MONO10 = "Mono10"
    MONO12 = "Mono12"
    MONO14 = "Mono14"
    MONO16 = "Mono16"
    BAYER_RG8 = "BayerRG8"
    BAYER_GR8 = "BayerGR8"
    BAYER_GB8 = "BayerGB8"
    BAYER_BG8 = "BayerBG8"
    BAYER_RG10 = "BayerRG10"
    BAYER_GR10 = "BayerGR10"
    BAYER_GB10 = "BayerGB10"
    BAYER_BG10 = "BayerBG10"
    BAYER_RG12 = "BayerRG12"
    BAYER_GR12 = "BayerGR12"
    BAYER_GB12 = "BayerGB12"
    BAYER_BG12 = "BayerBG12"
    BAYER_RG14 = "BayerRG14"
    BAYER_GR14 = "BayerGR14"
    BAYER_GB14 = "BayerGB14"
    BAYER_BG14 = "BayerBG14"
    BAYER_RG16 = "BayerRG16"
    BAYER_GR16 = "BayerGR16"
    BAYER_GB16 = "BayerGB16"
    BAYER_BG16 = "BayerBG16"
    RGB8 = "RGB8"
    RGB10 = "RGB10"
    RGB12 = "RGB12"
    RGB14 = "RGB14"
    RGB16 = "RGB16"

    @property
    def bits(self) -> int:
        """Significant bits a sample."""
        return int("".join(c for c in self.value if c.isdigit()))

    @property
    def full_scale(self) -> int:
        """The largest count."""
        return (1 << self.bits) - 1

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)

    @property
    def bayer(self) -> str:
        """The mosaic's first two pixels, "RG", "GR", "GB" or "BG"; "" where there is none."""
        return self.value[5:7] if self.value.startswith("Bayer") else ""

    @property
    def channels(self) -> int:
        """Samples a pixel: 3 for RGB, else 1."""
        return 3 if self.value.startswith("RGB") else 1


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What a configured camera delivers."""

    width: int
    height: int
    pixel_format: PixelFormat
    black_level: float = 0.0  # nominal counts in the dark
    exposure_range_us: tuple[float, float] = (1.0, 1e9)
    gain_range: tuple[float, float] | None = None  # None: unknown, or it has none
    gain_unit: str = ""  # "dB", "ISO"; "": the device's own
    max_rate_hz: float = 0.0  # frames a second at the present exposure; 0: unknown
    readout_s: float = 0.0  # from the end of the exposure to the frame being here
    rolling_s: float = 0.0  # how much later the last row is exposed than the first; 0: all at once
    triggers: tuple[str, ...] = ("software",)  # software, hardware, none (free-running only)
    recorded: bool = False  # frames were taken before: no projector is needed to get them
    frame_count: int | None = None  # of a recording, if it is known

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame's pixels: (H, W) or (H, W, 3)."""
        plane = (self.height, self.width)
        return plane if self.pixel_format.channels == 1 else (*plane, 3)


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What a camera can be told; None leaves a setting as it is. SFNC: ExposureTime, Gain ..."""

    exposure_us: float | None = None
    gain: float | None = None
    pixel_format: PixelFormat | None = None
    frame_rate_hz: float | None = None
    roi: tuple[int, int, int, int] | None = None  # x, y, width, height


class Acquisition(enum.StrEnum):
    """What makes a camera expose."""

    SOFTWARE = "software"  # one frame a `trigger()`
    HARDWARE = "hardware"  # one frame a pulse on its line
    FREE = "free"  # one after the other at its own rate


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure as the driver knows it; never modified after it leaves the driver.

    `pixels` (H, W) or (H, W, 3) RGB, uint8 or uint16, C order. `start_ns`/`end_ns` bound the
    exposure (of a rolling shutter: of the first row) on the rig's monotonic clock. `sequence` is
    the device's own count: a gap is a loss. `incomplete` says that parts are missing (lost
    packets): such a frame is never used.
    """

    pixels: NDArray[Any]
    sequence: int
    start_ns: int
    end_ns: int
    utc_ns: int
    exposure_us: float
    gain: float = 0.0
    incomplete: bool = False
    source: str = ""  # a recording's file name

    @property
    def mid_ns(self) -> int:
        """The middle of the exposure."""
        return (self.start_ns + self.end_ns) // 2


class Camera(Device):
    """A camera. Order of calls: connect, configure, start, (trigger, grab)*, stop, close."""

    kind = "camera"

    @abstractmethod
    def info(self) -> CameraInfo:
        """What it delivers as configured now; valid after connect; no I/O."""

    @abstractmethod
    def settings(self) -> CameraSettings:
        """The settings in force, every field filled that the camera has; no I/O."""

    @abstractmethod
    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """Change settings, between `stop` and `start` only; gives those in force.

        Raises DeviceRefused, naming the range, for a value that the camera cannot take.
        """

    @abstractmethod
    def start(self, acquisition: Acquisition, at: int = 0) -> None:
        """Begin to acquire; frames before it are forgotten. `at`: a recording's first frame."""

    @abstractmethod
    def trigger(self) -> tuple[int, int]:
        """Begin one exposure (SOFTWARE); gives its start and its end on the clock, as far as known.

        Returns at once, before the exposure ends. The caller may change the light after the end.
        """

    @abstractmethod
    def grab(self, out: NDArray[Any], timeout_s: float) -> Frame:
        """The next frame, its pixels in `out` (shape and dtype of `info()`).

        Raises DeviceTimeout when none came (a lost trigger), EndOfRecording, DeviceLost.
        """

    @abstractmethod
    def stop(self) -> None:
        """End acquisition; idempotent."""

    def truth(self, sources: tuple[str, ...] = ()) -> dict[str, NDArray[np.float32]]:
        """A simulated camera's noiseless `direct` and `global` (RGB or mono, linear counts,
        ambient and black removed) under its present settings, of the projector or of the lights
        that are named; {} for every camera of this world."""
        del sources
        return {}


# ---------------------------------------------------------------- projector


@dataclass(frozen=True, slots=True)
class SequenceLimits:
    """What a projector that times a sequence by itself can be asked for."""

    images: int  # at most, in one sequence
    bits: int  # 1: black and white only; 8: grey levels
    period_us: tuple[float, float]  # the shortest and the longest from one image to the next
    dark_us: float = 0.0  # at least this, where an image is lit for less than its period
    total_us: float = 0.0  # all images together at most; 0: any


@dataclass(frozen=True, slots=True)
class LoadedSequence:
    """A sequence as the projector will run it: its times may be rounded to what it can."""

    images: int
    exposure_us: float  # for so long each image is lit ...
    period_us: float  # ... and so much later comes the next


@dataclass(frozen=True, slots=True)
class ProjectorInfo:
    """A projector as its patterns must be drawn."""

    width: int
    height: int
    refresh_hz: float
    latency_s: float = 0.0  # from the flip to light, where it is known
    sequence: SequenceLimits | None = None  # None: it shows single images only

    @property
    def sequences(self) -> bool:
        """Whether it runs sequences by itself and triggers the camera (`load`, `run`)."""
        return self.sequence is not None


class Projector(Device):
    """A light source with pixels.

    One image at a time: `show`. A projector with `info().sequences` also runs whole sequences with
    no host in the loop, one pulse on its trigger output at the start of each image:

        load -> camera.start(HARDWARE) -> run -> as many grabs as images -> stop

    Frame k shows image k if the camera gave exactly as many frames as there are images, at the
    sequence's period (drivers/sequence.py says whether it did). If not, `run` all of it again.
    """

    kind = "projector"

    @abstractmethod
    def info(self) -> ProjectorInfo:
        """Size and pace; valid after connect; no I/O."""

    @abstractmethod
    def show(self, image: NDArray[np.uint8]) -> int:
        """Show `image` (H, W) uint8; returns when it has flipped: the moment on the clock from
        which the light is this image's (latency included where the driver knows it). Ends a
        sequence."""

    def load(
        self,
        images: Sequence[NDArray[np.uint8]],  # noqa: ARG002
        exposure_us: float,  # noqa: ARG002
        period_us: float,  # noqa: ARG002
    ) -> LoadedSequence:
        """Prepare a sequence of (H, W) uint8 images; ends one that runs. Safe to send again.

        Raises DeviceRefused, naming the limit, for what `info().sequence` does not allow.
        """
        raise self._no_sequences("load")

    def run(self) -> int:
        """Begin the loaded sequence, once through, and return: no trigger comes before the moment
        on the clock that it gives. After its last image the projector is dark; it may be run again.
        """
        raise self._no_sequences("run")

    def stop(self) -> None:
        """End a sequence, dark; no trigger comes after it returns. Idempotent."""
        self.safe()

    def _no_sequences(self, phase: str) -> DeviceRefused:
        return DeviceRefused(
            self.name, phase, "it cannot time a sequence by itself", "show the images one by one"
        )


# ---------------------------------------------------------------- stage


class StageState(enum.StrEnum):
    """What a stage is doing.

    unknown ──home──> homing ──> idle <──> moving | held;  any ──> alarm ──unlock──> unknown
    any ──reconnect──> unknown
    """

    UNKNOWN = "unknown"  # its position is not known: nothing but homing is allowed
    HOMING = "homing"
    IDLE = "idle"
    MOVING = "moving"
    HELD = "held"
    ALARM = "alarm"


@dataclass(frozen=True, slots=True)
class StageInfo:
    """Travel in mm from the origin on each axis, and the fastest feed."""

    travel_mm: tuple[tuple[float, float], tuple[float, float]]  # (x min, x max), (y min, y max)
    max_feed_mm_s: float
    max_acceleration_mm_s2: float = 0.0
    #: centre and radius of the only circle that it can go round (an eccentric); None: any
    only_circle_mm: tuple[tuple[float, float], float] | None = None


@dataclass(frozen=True, slots=True)
class StageStatus:
    """Where a stage was at a moment of the clock; `position_mm` is None while it is unknown."""

    state: StageState
    position_mm: tuple[float, float] | None
    at_ns: int
    detail: str = ""  # in words: which alarm, what holds it, and the remedy


class Stage(Device):
    """A motorised XY occluder. Motion calls return when the motion is accepted, not when it ends;
    soft limits are checked before anything is sent (DeviceRefused)."""

    kind = "stage"

    @abstractmethod
    def info(self) -> StageInfo:
        """Limits; valid after connect; no I/O."""

    @abstractmethod
    def status(self) -> StageStatus:
        """Ask it now. Raises DeviceTimeout, DeviceLost."""

    @abstractmethod
    def home(self, timeout_s: float) -> None:
        """Find the origin; returns when it is found. Raises DeviceRefused naming the switch."""

    @abstractmethod
    def unlock(self) -> None:
        """Leave the alarm without homing; the position stays unknown."""

    @abstractmethod
    def move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """Go straight to a point."""

    @abstractmethod
    def circle(
        self, centre_mm: tuple[float, float], radius_mm: float, feed_mm_s: float, turns: float
    ) -> None:
        """Go round, without a stop between turns, from the circle's first point (angle 0)."""

    @abstractmethod
    def pump(self) -> StageStatus:
        """Keep the planner full and the position fresh; called often while moving. See `status`."""

    @abstractmethod
    def position_at(self, at_ns: int) -> tuple[float, float] | None:
        """Where it was at a moment of the clock, between the positions reported; None: unknown."""

    def stop(self) -> None:
        """End every motion, endless circles too: decelerate, and drop what is queued. Idempotent.

        Unlike after `hold` there is nothing to resume. The position stays known if the device can
        prove it. A device that has no better way goes to its safe state.
        """
        self.safe()

    def jog(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """Go to a point by hand: as `move`, but `hold` ends it for good where the device can."""
        self.move(x_mm, y_mm, feed_mm_s)

    @abstractmethod
    def hold(self) -> None:
        """Decelerate and hold; the position stays known. Idempotent."""

    @abstractmethod
    def resume(self) -> None:
        """Go on after a hold."""


# ---------------------------------------------------------------- light


class Light(Device):
    """A source that can only be switched."""

    kind = "light"

    @abstractmethod
    def set(self, on: bool) -> None:
        """Switch it; returns when it has switched. Safe to send again."""

    @abstractmethod
    def is_on(self) -> bool:
        """What it was last told; no I/O."""
