"""A camera over a folder of images or a video file: scans of yesterday, photographs of others.

`connect` looks at every file before the first frame is given, so that bad input is refused before
a scan begins (`drivers.recording`); each refusal names the file and what to do. Frames come as fast
as they can be read; their times are made up: frame k begins k / rate after `start(..., at=0)` would
have.

Every command may be sent again. `start(..., at=k)` gives frame k next, also of a video, where the
frames before it are decoded and dropped: a seek by time would not be exact.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers import imagefile
from drivers.base.camera import Acquisition, Camera, CameraInfo, CameraSettings, Frame
from drivers.base.device import Context, Identity, Options
from drivers.base.errors import (
    DeviceError,
    DeviceGarbled,
    DeviceLost,
    DeviceRefused,
    DeviceTimeout,
    EndOfRecording,
)
from drivers.base.pixelformat import PixelFormat
from drivers.clock import NS
from drivers.imagefile import BadImage
from drivers.recording import BadRecording, Recording, find
from drivers.videofile import VideoFile

T = TypeVar("T")


class ReplayOptions(Options, frozen=True, kw_only=True):
    """Keys of a `driver = "replay"` camera."""

    path: str  # a folder of images, or a video file
    first: tuple[
        str, ...
    ] = ()  # files given before all others; relative ones are within the folder
    match: str = "*"  # which of the folder's names are frames
    bayer: Literal["", "RG", "GR", "GB", "BG"] = ""  # grey files are a mosaic that begins so
    bits: Literal[8, 10, 12, 14, 16] | None = None  # significant bits, if fewer than the file's
    exposure_us: float = 0.0  # of every frame; 0: unknown
    rate_hz: float | None = None  # default: a video's own, 30 for images


_Read = tuple[NDArray[Any] | None, str]  # pixels (None: the end), the name of their source


class ReplayCamera(Camera):
    """See the module. One frame is read ahead in a thread, so memory is two frames whatever the
    length of the recording."""

    options_type = ReplayOptions
    options: ReplayOptions

    def __init__(self, name: str, options: ReplayOptions, context: Context) -> None:
        super().__init__(name, options, context)
        self._halted = threading.Event()
        self._recording: Recording | None = None
        self._info: CameraInfo | None = None
        self._reader: ThreadPoolExecutor | None = None
        self._ahead: Future[_Read] | None = None
        self._video: VideoFile | None = None
        self._next = 0
        self._origin_ns = 0
        self._utc_minus_now = 0

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """List and check every file. Raises DeviceRefused naming the first that will not do."""
        self.close()
        options, root = self.options, Path(self.options.path).expanduser()
        try:
            recording = find(
                root,
                first=options.first,
                match=options.match,
                grey=bool(options.bayer),  # a mosaic is stored as grey video
                rate_hz=options.rate_hz,
            )
        except BadRecording as error:
            raise self._refused("connect", error.problem, error.remedy) from error
        self._info = self._describe(recording)
        self._recording = recording
        if recording.images:
            # A wrong `bits` shows now, not in mid-scan.
            self._read_image(recording.images[-1], "connect")
        return Identity(model=f"replay of {root.name}", serial=str(root.resolve()))

    def check(self) -> None:
        """The recording is still there."""
        root = Path(self.options.path).expanduser()
        if not root.exists():
            raise DeviceLost(self.name, "check", f"{root} has gone", "mount or restore it")

    def safe(self) -> None:
        """A recording is always safe."""
        self.stop()

    def halt(self) -> None:
        """See Device. The grab that waits raises at once; `start` clears it."""
        self._halted.set()
        if (ahead := self._ahead) is not None:
            ahead.cancel()

    def close(self) -> None:
        """See Device."""
        self.stop()
        self._recording = self._info = None

    def facts(self) -> dict[str, Any]:
        """Where the recording is, how long, and which frame comes next."""
        facts: dict[str, Any] = {"path": self.options.path, "next": self._next}
        if self._recording is not None:
            facts |= {"frames": self._recording.frames, "layout": str(self._recording.layout)}
        return facts

    # ------------------------------------------------------------ camera

    def info(self) -> CameraInfo:
        """See Camera."""
        if self._info is None:
            raise DeviceLost(self.name, "info", "not connected", "connect it first")
        return self._info

    def settings(self) -> CameraSettings:
        """What the frames were taken with, as far as the options say."""
        info = self.info()
        return CameraSettings(
            exposure_us=self.options.exposure_us or None,
            pixel_format=info.pixel_format,
            frame_rate_hz=self._known_rate(),
            roi=(0, 0, info.width, info.height),
        )

    def _known_rate(self) -> float | None:
        """As the options or a video say; photographs were taken at none."""
        recording = self._connected("settings")
        return recording.rate_hz if self.options.rate_hz or recording.video else None

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """The frames were taken before: anything but what they have is refused."""
        have = self.settings()
        for name in CameraSettings.__dataclass_fields__:
            value, kept = getattr(wanted, name), getattr(have, name)
            if value is not None and value != kept:
                state = "unknown" if kept is None else f"{kept}"
                raise self._refused(
                    "configure", f"{name} is {state} and recorded, not {value}", "leave it out"
                )
        return have

    def start(self, acquisition: Acquisition, at: int = 0) -> None:
        """See Camera. Raises EndOfRecording when there is no frame `at`."""
        del acquisition  # who triggered the frames is history
        recording = self._connected("start")
        self.stop()
        if not 0 <= at < recording.frames:
            raise EndOfRecording(
                self.name,
                "start",
                f"no frame {at}: the recording has {recording.frames}",
                "start earlier or record more",
            )
        self._halted.clear()
        now = self.clock.now_ns()
        self._utc_minus_now = self.clock.utc_ns() - now
        self._origin_ns = now - round(at / recording.rate_hz * NS)
        self._next = at
        self._reader = ThreadPoolExecutor(1, thread_name_prefix=f"{self.name}-replay")
        self._read_ahead(at)

    def trigger(self) -> tuple[int, int]:
        """Nothing to wait for: the light may be changed at once."""
        self._connected("trigger")
        now = self.clock.now_ns()
        return now, now

    def grab(self, out: NDArray[Any], timeout_s: float) -> Frame:
        """See Camera. Raises DeviceGarbled for a file that changed since `connect`."""
        recording = self._connected("grab")
        info = self.info()
        if out.shape != info.shape or out.dtype != info.pixel_format.dtype:
            raise self._refused(
                "grab",
                f"frames are {info.shape} {info.pixel_format.dtype}, "
                f"the buffer is {out.shape} {out.dtype}",
                "make the buffer from `info()`",
            )
        pixels, source = self._wait(timeout_s)
        if pixels is None:
            raise EndOfRecording(
                self.name,
                "grab",
                f"the recording has ended after {self._next} frames",
                "record more frames, or ask for a shorter scan",
            )
        index = self._next
        self._next += 1
        self._read_ahead(self._next)
        np.copyto(out, pixels)
        start = self._origin_ns + round(index / recording.rate_hz * NS)
        return Frame(
            pixels=out,
            sequence=index,
            start_ns=start,
            end_ns=start + round(self.options.exposure_us * 1000),
            utc_ns=start + self._utc_minus_now,
            exposure_us=self.options.exposure_us,
            source=source,
        )

    def stop(self) -> None:
        """See Camera."""
        reader, self._reader, self._ahead = self._reader, None, None
        if reader is not None:
            reader.shutdown(wait=True, cancel_futures=True)  # at most one frame's reading
        if self._video is not None:
            self._video.close()
            self._video = None

    def _describe(self, recording: Recording) -> CameraInfo:
        layout, options = recording.layout, self.options
        bits = options.bits or layout.bits
        if (layout.bits == 8) != (bits == 8):
            raise self._refused(
                "connect",
                f"the files have {layout.bits} bits a sample, `bits` says {bits}",
                "leave `bits` out" if layout.bits == 8 else "choose 10, 12, 14 or 16",
            )
        if options.bayer and layout.channels != 1:
            raise self._refused(
                "connect",
                f"`bayer` says that files are a mosaic, but they are {layout}",
                "leave `bayer` out, or give the raw mosaic as grey files",
            )
        kind = f"Bayer{options.bayer}" if options.bayer else ("Mono", "RGB")[layout.channels == 3]
        return CameraInfo(
            width=layout.width,
            height=layout.height,
            pixel_format=PixelFormat(f"{kind}{bits}"),
            exposure_range_us=(options.exposure_us, options.exposure_us),
            max_rate_hz=recording.rate_hz,
            triggers=("software", "hardware", "none"),
            recorded=True,
            frame_count=recording.frames,
        )

    # ------------------------------------------------------------ reading

    def _read_ahead(self, index: int) -> None:
        if self._reader is not None:
            self._ahead = self._reader.submit(self._read, index)

    def _wait(self, timeout_s: float) -> _Read:
        if self._ahead is None:
            raise self._refused("grab", "not started", "start it first")
        if self._halted.is_set():
            raise self._refused("grab", "halted", "start it again")
        try:
            return self._ahead.result(timeout_s)
        except CancelledError as error:
            raise self._refused("grab", "halted", "start it again") from error
        except FutureTimeout as error:
            raise DeviceTimeout(
                self.name,
                "grab",
                f"frame {self._next} was not read within {timeout_s:g} s",
                "grab again, or copy the recording to a faster disk",
            ) from error

    def _read(self, index: int) -> _Read:
        """Frame `index`; runs in the reader's thread, in order."""
        recording = self._connected("grab")
        if index < len(recording.images):
            path = recording.images[index]
            return self._read_image(path, "grab"), path.name
        if recording.video is None:
            return None, ""
        video = self._video
        if video is None:
            video = self._video = self._at(recording.video, "grab", VideoFile)
            video.skip(index - len(recording.images))
        number = video.next
        image = self._at(recording.video, "grab", lambda _: video.read())
        if image is None:
            return None, ""
        return self._fit(image, recording.video, "grab"), f"{recording.video.name}#{number}"

    def _read_image(self, path: Path, phase: str) -> NDArray[Any]:
        return self._fit(self._at(path, phase, imagefile.read), path, phase)

    def _fit(self, pixels: NDArray[Any], path: Path, phase: str) -> NDArray[Any]:
        """`pixels` as `info()` says, or DeviceGarbled."""
        info = self.info()
        if info.pixel_format.channels == 1 and pixels.ndim == 3:  # a mosaic in a grey video
            if (pixels != pixels[:, :, :1]).any():
                raise self._refused(
                    phase, f"{path.name} is in colour, not a mosaic", "leave `bayer` out"
                )
            pixels = pixels[:, :, 0]
        if pixels.shape != info.shape or pixels.dtype != info.pixel_format.dtype:
            raise DeviceGarbled(
                self.name,
                phase,
                f"{path.name} changed while it was in use: {pixels.shape} {pixels.dtype}",
                "leave the files alone during a scan",
            )
        full = info.pixel_format.full_scale
        if info.pixel_format.bits % 8 and int(pixels.max()) > full:
            raise self._refused(
                phase,
                f"{path.name} has counts up to {pixels.max()}, but {info.pixel_format.bits} bits "
                f"end at {full}",
                "leave `bits` out (samples stored in the upper bits are 16-bit samples)",
            )
        return pixels

    # ------------------------------------------------------------ errors

    def _at(self, path: Path, phase: str, call: Callable[[Path], T]) -> T:
        try:
            return call(path)
        except BadImage as error:
            kind: type[DeviceError] = DeviceRefused if phase == "connect" else DeviceGarbled
            raise kind(self.name, phase, f"{path.name} {error.problem}", error.remedy) from error

    def _connected(self, phase: str) -> Recording:
        if self._recording is None:
            raise self._refused(phase, "not connected", "connect it first")
        return self._recording

    def _refused(self, phase: str, problem: str, remedy: str) -> DeviceRefused:
        return DeviceRefused(self.name, phase, problem, remedy)
