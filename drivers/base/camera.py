"""What a camera is, and the frames that it makes."""

from __future__ import annotations

import enum
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base.device import Device
from drivers.base.pixelformat import PixelFormat


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
