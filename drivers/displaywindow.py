"""SDL's fullscreen window on an output: what the process of a `display` projector runs.

Works under a desktop (X11, Wayland) and without one (KMSDRM), where SDL owns the output alone. The
image is neither scaled nor filtered, the cursor is hidden, the screen saver is off.

Under X11 the end of the X server ends this process, too (Xlib knows no other way), and SDL belongs
to the thread that started it, one display a process: drivers/display.py gives it a process.
"""

from __future__ import annotations

import os
import threading
import warnings
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
import pygame

from drivers import sdl
from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.base.projector import Projector, ProjectorInfo
from drivers.clock import NS

ASSUMED_FRAMES = 6.0  # what slow projectors need
MEASURED = 24  # flips, to learn the refresh rate
FASTEST_HZ = 500.0  # flips that come faster do not wait for the refresh
DRIFT = 0.1  # by which the measured rate may differ from the one in rig.toml
NO_DISPLAY = (
    "set DISPLAY for a desktop; without one, umbrad needs /dev/dri/card* (group video) and "
    'video_driver = "kmsdrm"'
)
MASKS = {"white": 0xFFFFFF, "red": 0xFF0000, "green": 0x00FF00, "blue": 0x0000FF}


class DisplayOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of ``[projector] driver = "display"``."""

    output: int | str = 0  # its number, or its name as `umbra devices --scan` prints it
    size: tuple[int, int] | None = None  # width, height that the output must have
    refresh_hz: Annotated[float, Meta(gt=0)] | None = None  # None: as measured at connect
    #: from the flip to this image's light; None: nobody knows, and scans wait for ASSUMED_FRAMES
    #: until it has been calibrated
    latency_frames: Annotated[float, Meta(ge=0)] | None = None
    channel: Literal["white", "red", "green", "blue"] = "white"
    video_driver: str = ""  # SDL's name: kmsdrm, x11, wayland; "": SDL chooses
    windowed: bool = False  # in a window of `size`, paced by the clock: to try out, no more


class DisplayWindow(Projector):
    """A projector within this process; `show`, `safe` and what they give: see DisplayProjector."""

    options_type = DisplayOptions

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        assert isinstance(options, DisplayOptions)
        self._o = options
        self._surface: pygame.Surface | None = None
        self._size = (0, 0)
        self._refresh_hz = 0.0
        self._facts: dict[str, Any] = {}
        self._halted = threading.Event()
        self._next = 0  # windowed: when the next refresh would be

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """See Device. Takes half a second: the refresh rate is measured, on black."""
        self.close()
        if not sdl.screen.take(self):
            raise self._refuse(
                "connect",
                "another device of this rig has the display",
                "one display a rig: SDL has but one in a process",
            )
        try:
            return self._open()
        except DeviceError:
            self.close()
            raise
        except pygame.error as error:
            self.close()
            raise DeviceLost(
                self.name,
                "connect",
                f"SDL: {error}",
                NO_DISPLAY,
            ) from error

    def _open(self) -> Identity:
        sdl.start(self._o.video_driver)
        driver = pygame.display.get_driver()
        index = self._find(sdl.names(driver))
        output = pygame.display.get_desktop_sizes()[index]
        size = self._o.size or output
        if self._o.windowed:
            flags = pygame.NOFRAME
        else:
            if size != output:
                raise self._refuse(
                    "connect",
                    f"output {self._o.output} is {output[0]} x {output[1]}, "
                    f"not {size[0]} x {size[1]}",
                    "set the output's mode: nothing is ever scaled",
                )
            flags = pygame.FULLSCREEN | pygame.SCALED  # SCALED, at the output's size, is for vsync
        with warnings.catch_warnings(record=True) as slow:  # "no fast renderer": without a GPU
            warnings.simplefilter("always")
            surface = pygame.display.set_mode(
                size, flags, display=index, vsync=0 if self._o.windowed else 1
            )
        pygame.mouse.set_visible(False)
        pygame.display.set_allow_screensaver(False)
        self._surface, self._size = surface, size
        self._check_window("connect")
        self._refresh_hz = self._measure()
        name = sdl.names(driver)[index]
        self._facts = {
            "output": name,
            "sdl": ".".join(map(str, pygame.get_sdl_version())),
            "video_driver": driver,
            "refresh_hz": round(self._refresh_hz, 3),
            "flips_by": "timer" if slow or self._o.windowed else "output",
            "channel": self._o.channel,
        }
        if self._o.latency_frames is None:
            self._facts["assumed_latency_s"] = round(ASSUMED_FRAMES / self._refresh_hz, 6)
        return Identity(f"display {name} {size[0]}x{size[1]}", "", f"SDL {self._facts['sdl']}")

    def _find(self, names: list[str]) -> int:
        wanted = self._o.output
        if isinstance(wanted, int) and 0 <= wanted < len(names):
            return wanted
        found = [k for k, name in enumerate(names) if name == wanted]
        if len(found) == 1:
            return found[0]
        there = ", ".join(f"{k} ({name})" for k, name in enumerate(names)) or "none"
        problem = (
            f"{len(found)} outputs are called {wanted!r}" if found else f"no output {wanted!r}"
        )
        raise DeviceLost(self.name, "connect", problem, f"there are {there}; is it plugged in?")

    def _measure(self) -> float:
        """Refreshes a second."""
        if self._o.windowed:
            return self._o.refresh_hz or 60.0
        assert self._surface is not None
        self._surface.fill(0)
        moments = []
        for _ in range(MEASURED):
            pygame.display.flip()
            moments.append(self.clock.now_ns())
        rate = NS / max(1.0, float(np.median(np.diff(moments))))
        told = self._o.refresh_hz
        if rate > FASTEST_HZ or not pygame.display.is_vsync():
            raise self._refuse(
                "connect",
                f"flips do not wait for the refresh ({rate:.0f} a second)",
                "switch on vertical sync in the graphics driver, or use KMSDRM",
            )
        if told is not None and abs(rate / told - 1) > DRIFT:
            raise self._refuse(
                "connect",
                f"the output refreshes at {rate:.2f} Hz, not at refresh_hz = {told:g}",
                "set the output's mode, or leave refresh_hz out",
            )
        return told or rate

    def check(self) -> None:
        """See Device. Answers the window system, too: a window that does not is taken for dead."""
        self._check_window("check")

    def _check_window(self, phase: str) -> None:
        if self._surface is None:
            raise DeviceLost(
                self.name,
                phase,
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        try:
            closed = [
                event
                for event in pygame.event.get()
                if event.type in {pygame.QUIT, pygame.WINDOWCLOSE}
            ]
            size, shown = pygame.display.get_window_size(), pygame.display.get_active()
        except pygame.error as error:
            raise DeviceLost(self.name, phase, f"SDL: {error}", "connect again") from error
        problem = ""
        if closed:
            problem = "the window was closed"
        elif not shown:
            problem = "the window is minimised or hidden"
        elif size != self._size:
            problem = (
                f"the output is now {size[0]} x {size[1]}, not {self._size[0]} x {self._size[1]}"
            )
        if problem:
            raise DeviceLost(
                self.name, phase, problem, "leave its screen alone; it is opened again"
            )

    def safe(self) -> None:
        """See Device: black. A halt ends the wait for the light, not the flip."""
        self._halted.clear()
        dark_ns = self.show(np.zeros(self._size[::-1], np.uint8))
        dark_ns += round(self._facts.get("assumed_latency_s", 0.0) * NS)
        self.clock.wait_until(dark_ns, self._halted)

    def halt(self) -> None:
        """See Device. No flip blocks for longer than a refresh."""
        self._halted.set()

    def close(self) -> None:
        """See Device."""
        if sdl.screen.take(self):
            self._surface = None
            pygame.display.quit()
            sdl.screen.leave(self)

    # ------------------------------------------------------------ what it shows

    def info(self) -> ProjectorInfo:
        """See Projector."""
        width, height = self._size
        frames = self._o.latency_frames or 0.0
        latency = frames / self._refresh_hz if self._refresh_hz else 0.0
        return ProjectorInfo(width, height, self._refresh_hz, latency)

    def facts(self) -> dict[str, Any]:
        """See Device."""
        return self._facts

    def show(self, image: NDArray[np.uint8]) -> int:
        """See Projector and the class."""
        self._check_window("show")
        width, height = self._size
        if image.dtype != np.uint8 or image.shape not in {(height, width), (height, width, 3)}:
            raise self._refuse(
                "show",
                f"an image of {image.shape} {image.dtype}, not {(height, width)} uint8",
                "draw it for the size in info()",
            )
        self._draw(image)
        return self._flip() + round((self._o.latency_frames or 0.0) * NS / self._refresh_hz)

    def _draw(self, image: NDArray[np.uint8]) -> None:
        assert self._surface is not None
        if image.ndim == 3:
            pygame.surfarray.blit_array(self._surface, image.swapaxes(0, 1))
            return
        pixels = pygame.surfarray.pixels2d(self._surface)  # (W, H) uint32, the surface's own
        grey = np.uint32(0x010101 & MASKS[self._o.channel])
        np.multiply(image, grey, out=pixels.T, dtype=np.uint32, casting="unsafe")

    def _flip(self) -> int:
        try:
            pygame.display.flip()
        except pygame.error as error:
            raise DeviceLost(self.name, "show", f"SDL: {error}", "connect again") from error
        now = self.clock.now_ns()
        if self._o.windowed:  # no refresh to wait for: the clock stands in
            period = round(NS / self._refresh_hz)
            self._next = max(self._next + period, now)
            self.clock.wait_until(self._next)
            now = self.clock.now_ns()
        return now

    def _refuse(self, phase: str, problem: str, remedy: str) -> DeviceRefused:
        return DeviceRefused(self.name, phase, problem, remedy)

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device. [] while this process shows something, or where there is no display."""
        here = object()
        if not sdl.screen.take(here):
            return []
        try:
            sdl.start("")
            names = sdl.names(pygame.display.get_driver())
            sizes = pygame.display.get_desktop_sizes()
            return [
                {
                    "model": f"display {name} {size[0]}x{size[1]}",
                    "serial": "",
                    "options": {"output": name if names.count(name) == 1 else k},
                }
                for k, (name, size) in enumerate(zip(names, sizes, strict=True))
            ]
        except pygame.error:
            return []
        finally:
            pygame.display.quit()
            sdl.screen.leave(here)
