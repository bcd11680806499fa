"""DLP LightCrafter 4500 and other boards with a DLPC350: patterns with exact timing, over USB.

USB carries commands; pictures come by one of two ways, which rig.toml chooses:

- `display`: HDMI. Any picture, one a video frame; or up to 24 black and white ones within a single
  frame, as its bit planes.
- `flash`: pictures that TI's GUI has put into the board's flash. The driver has the same files, and
  finds what it is to show among their bit planes by its content.

In both, the board runs in pattern mode: one LED colour, no gamma, no colour wheel in time, and a
pulse on TRIG_OUT_1 for as long as each pattern is lit.

    standby ──connect──> dark ──show──> showing one;  dark ──load, run──> sequence ──> dark
    any ──safe──> dark (LEDs off), or standby

`show`, `load`, `stop`, `safe` and `check` are safe to send again; `run` begins anew. USB's errors
and what may be done after them: drivers/dlpc_hid.py.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
import usb.core
from msgspec import Meta
from numpy.typing import NDArray

from drivers import dlpc350_protocol as p
from drivers import dmd
from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.projector import LoadedSequence, Projector, ProjectorInfo, SequenceLimits
from drivers.clock import NS
from drivers.dlpc350_board import Board, Pulse
from drivers.dlpc350_flash import FlashImages, Place
from drivers.dlpc350_protocol import Command, Entry
from drivers.dlpc_hid import DlpcHid, attached
from drivers.registry import UnknownDriver, install

if TYPE_CHECKING:
    from drivers.display import DisplayProjector

FLASH_REFRESH_HZ = 60.0
VIDEO = Place(-1, 0, 8)  # not in flash: green's eight bits of each video frame
MARGIN_US = 250  # of a video frame, that patterns leave free
VIDEO_LATENCY_FRAMES = 1  # the board shows a frame while it takes in the next
PARALLEL_24 = b"\x00"  # the HDMI receiver's port


class Dlpc350Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of ``[projector] driver = "dlpc350"``."""

    serial: str = ""  # of the board, where there are several
    port: str = ""  # or the USB port that it is plugged into, as in "1-4.2"
    display: dict[str, Any] | None = None  # keys of the `display` driver, for the HDMI side
    flash: tuple[str, ...] = ()  # files of the 24-bit images in flash, by index
    layout: Literal["square", "native"] = "square"
    odd_rows_right: bool = True  # rows 1, 3, 5 ... lie half a column to the right
    led: Literal["red", "green", "yellow", "blue", "magenta", "cyan", "white"] = "white"
    trigger_delay_us: Annotated[float, Meta(ge=-20.0, le=2.7)] = 0.0  # against the light
    trigger_active_low: bool = False
    flash_load_ms: Annotated[float, Meta(gt=0)] = 200.0  # at worst, to fetch one 24-bit image
    standby: bool = False  # the safe state also parks the mirrors; 2 s to come back


class Dlpc350Projector(Projector):
    """See the module."""

    options_type = Dlpc350Options

    def __init__(self, name: str, options: Options, context: Context) -> None:
        """Raises msgspec.ValidationError for options that do not fit, UnknownDriver."""
        super().__init__(name, options, context)
        assert isinstance(options, Dlpc350Options)
        if (options.display is None) == (not options.flash):
            raise msgspec.ValidationError(
                "a dlpc350 projector needs `display` (HDMI) or `flash` (files), one of them"
            )
        self._o = options
        self._led = p.Led[options.led.upper()]
        self._halted = threading.Event()
        self._hid = DlpcHid(
            name, p.LIGHTCRAFTER_4500, options.serial, options.port, context.shared.get("usb")
        )
        pulse = Pulse(options.trigger_delay_us, options.trigger_active_low)
        self._board = Board(name, self._hid, self.clock, self._halted, pulse)
        self._screen = None if options.display is None else _display(name, options, context)
        self._flash = FlashImages(name, options.flash, options.flash_load_ms)
        self._refresh_hz = FLASH_REFRESH_HZ
        self._showing: Place | None = None
        self._loaded: LoadedSequence | None = None
        self._frame: NDArray[np.uint8] | None = None  # the sequence's video frame
        self._warnings: list[str] = []
        self._status: list[str] = []

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """See Device. Wakes it from standby, and reads the files of the flash images."""
        self._halted.clear()
        self._showing = self._loaded = None
        try:
            place = self._hid.open()
            firmware = p.version(self._hid.read(Command.VERSION, "connect"))
            self._board.wake("connect")
            self._board.write(Command.LEDS, p.LEDS_OFF, "connect")
            if self._screen is None:
                self._flash.read()
            else:
                self._screen.connect()
                self._refresh_hz = self._screen.info().refresh_hz
                self._board.write(Command.INPUT, PARALLEL_24, "connect")
        except DeviceError:
            self.close()
            raise
        self.check()
        return Identity(p.LIGHTCRAFTER_4500.name, place.serial or place.port, firmware)

    def check(self) -> None:
        """See Device. Raises DeviceRefused for what the controller reports of itself."""
        hardware = self._hid.read(Command.HARDWARE_STATUS, "check")[0]
        main = self._hid.read(Command.MAIN_STATUS, "check")[0]
        self._status = p.words(main, p.MAIN_STATUS)
        if self._screen is not None:
            self._screen.check()
        faults = p.words(hardware, p.HARDWARE_FAULTS)
        if not hardware >> p.HARDWARE_READY & 1:
            faults.append("it has not finished its start")
        if faults:
            raise self._refuse("check", ", ".join(faults), "switch it off and on again")

    def safe(self) -> None:
        """See Device: LEDs off, and in standby where rig.toml says so."""
        self._dark("safe")
        if self._o.standby:
            self._board.write(Command.POWER, b"\x01", "safe")

    def stop(self) -> None:
        """See Projector: LEDs off."""
        self._dark("stop")

    def _dark(self, phase: str) -> None:
        self._halted.clear()  # what was halted has ended; this must not end with it
        try:
            self._board.write(Command.LEDS, p.LEDS_OFF, phase)  # first: it is dark from here on
            self._showing = None
            self._board.stop(phase)
        except DeviceRefused:
            if not self._board.in_standby(phase):  # where it is dark, and takes no such commands
                raise

    def halt(self) -> None:
        """See Device: ends a wait; no USB call lasts longer than a second."""
        self._halted.set()

    def close(self) -> None:
        """See Device. The board stays as it is: send it to its safe state before."""
        self._showing = self._loaded = None
        self._hid.close()
        if self._screen is not None:
            self._screen.close()

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device."""
        try:
            found = attached(p.LIGHTCRAFTER_4500)
        except (usb.core.NoBackendError, usb.core.USBError):
            return []
        return [
            {
                "model": p.LIGHTCRAFTER_4500.name,
                "serial": place.serial,
                "options": {"serial": place.serial} if place.serial else {"port": place.port},
            }
            for _, place in found
        ]

    def facts(self) -> dict[str, Any]:
        """See Device; the status in words, as of the last check."""
        way = {"flash_images": len(self._o.flash)}
        return {
            "source": "flash" if self._screen is None else "hdmi",
            **(way if self._screen is None else self._screen.facts()),
            "led": self._o.led,
            "layout": self._o.layout,
            "status": self._status,
            "warnings": self._warnings,
        }

    # ------------------------------------------------------------ single images

    def info(self) -> ProjectorInfo:
        """See Projector."""
        square = self._o.layout == "square"
        if self._screen is None:
            latency, most = self._o.flash_load_ms / 1e3, p.ENTRIES
            longest, total = float(p.LONGEST_US), 0.0
        else:
            latency = self._screen.info().latency_s + VIDEO_LATENCY_FRAMES / self._refresh_hz
            most, longest = dmd.PLANES, float(self._frame_us)
            total = longest  # one video frame holds them all
        return ProjectorInfo(
            2 * dmd.COLUMNS if square else dmd.COLUMNS,
            dmd.ROWS,
            self._refresh_hz,
            latency,
            SequenceLimits(most, 1, (float(p.SHORTEST_US[1]), longest), total),
        )

    @property
    def _frame_us(self) -> int:
        """What of a video frame patterns can use."""
        return int(1e6 / self._refresh_hz) - MARGIN_US

    def show(self, image: NDArray[np.uint8]) -> int:
        """See Projector. From flash: what is not in it, and neither black nor white, is refused."""
        self._halted.clear()
        mirrors = self._mirrors("show", image)
        if self._screen is None:
            return self._show_flash(mirrors)
        if self._showing != VIDEO:
            entry = Entry(VIDEO.number, bits=VIDEO.bits, led=self._led, external=True)
            self._program("show", [entry], [], self._frame_us, self._frame_us, repeat=True)
            self._board.play("show")
            self._showing = VIDEO
        lit = self._screen.show(np.repeat(mirrors[..., None], 3, axis=2))
        return lit + round(VIDEO_LATENCY_FRAMES * NS / self._refresh_hz)

    def _show_flash(self, mirrors: NDArray[np.uint8]) -> int:
        wanted = self._flash.find("show", mirrors)
        if self._showing == wanted:
            return self.clock.now_ns()
        period = int(1e6 / FLASH_REFRESH_HZ)
        entries, images = [replace(wanted.entry(self._led), swap=True)], [max(wanted.index, 0)]
        self._program("show", entries, images, period, period, repeat=True)
        self._board.play("show")
        self._showing = wanted
        return self.clock.now_ns() + round(self._o.flash_load_ms * 1e6)

    # ------------------------------------------------------------ sequences

    def load(
        self, images: Sequence[NDArray[np.uint8]], exposure_us: float, period_us: float
    ) -> LoadedSequence:
        """See Projector. Images are black and white; times are rounded to whole microseconds."""
        self._halted.clear()
        exposure, period = round(exposure_us), round(period_us)
        self._check_times(len(images), exposure, period)
        mirrors = [self._mirrors("load", image) for image in images]
        for k, image in enumerate(mirrors):
            if np.count_nonzero(image) != np.count_nonzero(image == 255):
                raise self._refuse(
                    "load", f"image {k} has grey levels", "a sequence is of black and white only"
                )
        if self._screen is None:
            entries, order = self._flash.arrange(mirrors, period, self._led)
        else:
            entries, order = self._from_video(mirrors, period), []
        gaps = exposure < period  # a black fill needs time, save after the last
        entries = [replace(entry, clear=gaps) for entry in entries]
        entries[-1] = replace(entries[-1], clear=True)
        self._dark("load")
        self._program("load", entries, order, exposure, period, repeat=False)
        self._loaded = LoadedSequence(len(images), exposure, period)
        return self._loaded

    def _check_times(self, count: int, exposure: int, period: int) -> None:
        limits = self.info().sequence
        assert limits is not None
        shortest, longest = limits.period_us
        for wrong, problem, remedy in (
            (not 0 < count <= limits.images, f"{count} images", f"give 1 to {limits.images}"),
            (
                not shortest <= period <= longest,
                f"a period of {period} us",
                f"give {shortest:g} to {longest:g} us",
            ),
            (
                exposure < shortest or period - p.DARK_US < exposure != period,
                f"an exposure of {exposure} us in a period of {period} us",
                f"light the whole period, or from {shortest:g} us to {p.DARK_US} us less than it",
            ),
        ):
            if wrong:
                raise self._refuse("load", problem, remedy)

    def _from_video(self, images: list[NDArray[np.uint8]], period: int) -> list[Entry]:
        if len(images) * period > self._frame_us:
            raise self._refuse(
                "load",
                f"{len(images)} images of {period} us are longer than a video frame",
                f"they must fit into {self._frame_us} us; longer ones need `flash`",
            )
        self._frame = dmd.pack(images)
        return [Entry(k, led=self._led, external=k == 0, onward=k > 0) for k in range(len(images))]

    def run(self) -> int:
        """See Projector. Over HDMI it returns when the sequence's video frame is there."""
        self._halted.clear()
        if self._loaded is None:
            raise self._refuse("run", "no sequence is loaded", "load one first")
        if self._board.in_standby("run"):  # its tables may be gone
            raise self._refuse("run", "it is in standby", "load the sequence again")
        self._board.stop("run")
        if self._screen is not None:
            assert self._frame is not None
            there = self._screen.show(self._frame) + round(NS / self._refresh_hz)
            if self.clock.wait_until(there, self._halted):
                raise DeviceTimeout(self.name, "run", "halted before it began", "run it again")
        began = self.clock.now_ns()
        self._board.play("run")
        self._showing = None
        return began

    def _program(
        self,
        phase: str,
        entries: list[Entry],
        images: list[int],
        exposure_us: int,
        period_us: int,
        *,
        repeat: bool,
    ) -> None:
        """Stop, and program the board; nothing is lit yet."""
        self._loaded = self._showing = None
        self._warnings = self._board.program(
            phase,
            entries,
            images,
            exposure_us,
            period_us,
            video=self._screen is not None,
            repeat=repeat,
        )

    def _refuse(self, phase: str, problem: str, remedy: str) -> DeviceRefused:
        return DeviceRefused(self.name, phase, problem, remedy)

    # ------------------------------------------------------------ images

    def _mirrors(self, phase: str, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        info = self.info()
        if image.shape != (info.height, info.width) or image.dtype != np.uint8:
            raise self._refuse(
                phase,
                f"an image of {image.shape} {image.dtype}, not {(info.height, info.width)} uint8",
                "draw it for the size in info()",
            )
        if self._o.layout == "native":
            return image
        return dmd.to_mirrors(image, odd_rows_right=self._o.odd_rows_right)


def _display(name: str, options: Dlpc350Options, context: Context) -> DisplayProjector:
    """The HDMI side, at the DMD's own size: anything else would be scaled by the board."""
    try:
        from drivers.display import DisplayProjector  # noqa: PLC0415 - an extra
        from drivers.displaywindow import DisplayOptions  # noqa: PLC0415
    except ImportError as error:
        raise UnknownDriver(
            f"{name}: dlpc350 with a `display` needs {error.name}, which is not installed: "
            + install("display")
        ) from error
    keys = {"latency_frames": 2.0} | (options.display or {})
    keys["size"] = (dmd.COLUMNS, dmd.ROWS)
    return DisplayProjector(name, msgspec.convert(keys, DisplayOptions), context)
