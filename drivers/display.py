"""Any projector on a display output, through SDL (extra `display`): fullscreen, pixel for pixel.

Works under a desktop (X11, Wayland) and without one (KMSDRM), where SDL owns the output alone: that
is the better way for an instrument. What the projector does with the picture (keystone, sharpening,
gamma) is set on the projector: docs/hardware.md has the list.

The window has a process of its own (drivers/displayprocess.py): when the X server ends, Xlib ends
every program that uses it, and a graphics driver may crash or hang. Here that is DeviceLost, and
the next `connect` starts another process. `show`, `safe` and `check` are safe to send again.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import subprocess
import sys
import tempfile
import threading
from multiprocessing.connection import Pipe
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceLost, DeviceRefused
from drivers.base.projector import Projector, ProjectorInfo
from drivers.clock import NS
from drivers.displayprocess import Call, Reply
from drivers.displaywindow import DisplayOptions, DisplayWindow

PROGRAM = "from drivers.displayprocess import main; main()"
START_S = 20.0  # to start Python, SDL and the output
CALL_S = 4.0  # for a flip: some refreshes of the slowest output; less than the daemon waits
LEAVE_S = 2.0  # for the process to end by itself
UNKNOWN = ProjectorInfo(0, 0, 0.0)


class DisplayProjector(Projector):
    """See the module. `show` also takes (H, W, 3) RGB, for drivers that send bit planes.

    The moment that `show` gives is the flip's plus `latency_frames` refreshes, where they are told.
    The safe state is black, the lamp stays on; `safe` returns when it is black by the same
    reckoning, or, where nothing was told, after what slow projectors need.
    """

    options_type = DisplayOptions

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        self._process: subprocess.Popen[bytes] | None = None
        self._calls: Any = None
        self._errors: IO[bytes] | None = None  # what the process says at its end
        self._memory = -1
        self._pixels: mmap.mmap | None = None
        self._info = UNKNOWN
        self._facts: dict[str, Any] = {}
        self._halted = threading.Event()

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """See Device. Takes a second: a process is started, and the refresh rate measured."""
        self.close()
        try:
            self._launch()
            identity: Identity
            identity, info, facts = self._ask(Call("connect"), "connect", START_S)
        except BaseException:
            self.close()
            raise
        self._pixels = mmap.mmap(self._memory, 3 * info.width * info.height)
        self._info, self._facts = info, facts
        return identity

    def _launch(self) -> None:
        ours, theirs = Pipe()
        self._calls = ours
        self._memory = os.memfd_create(f"umbra-{self.name}")
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        inherited = (theirs.fileno(), self._memory)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM, *map(str, inherited)],
                pass_fds=inherited,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                start_new_session=True,  # Ctrl-C in a terminal is for the daemon alone
            )
        ours.send((self.name, self.options))

    def check(self) -> None:
        """See Device. Answers the window system, too: a window that does not is taken for dead."""
        self._ask(Call("check"), "check")

    def safe(self) -> None:
        """See Device: black. A halt ends the wait for the light, not the flip."""
        self._halted.clear()
        black = np.zeros((self._info.height, self._info.width), np.uint8)
        dark_ns = self._show(black, "safe")
        dark_ns += round(self._facts.get("assumed_latency_s", 0.0) * NS)
        self.clock.wait_until(dark_ns, self._halted)

    def halt(self) -> None:
        """See Device. No flip blocks for longer than a refresh."""
        self._halted.set()

    def close(self) -> None:
        """See Device."""
        process, self._process = self._process, None
        calls, self._calls = self._calls, None
        if calls is not None:
            calls.close()  # it ends by itself now
        if process is not None:
            try:
                process.wait(LEAVE_S)
            except subprocess.TimeoutExpired:  # hung in a graphics driver
                process.kill()
                process.wait()
        if self._pixels is not None:
            self._pixels.close()
        if self._memory >= 0:
            os.close(self._memory)
        if self._errors is not None:
            self._errors.close()
        self._pixels, self._memory, self._errors = None, -1, None

    # ------------------------------------------------------------ what it shows

    def info(self) -> ProjectorInfo:
        """See Projector."""
        return self._info

    def facts(self) -> dict[str, Any]:
        """See Device."""
        return self._facts

    def show(self, image: NDArray[np.uint8]) -> int:
        """See Projector and the class."""
        return self._show(image, "show")

    def _show(self, image: NDArray[np.uint8], phase: str) -> int:
        if self._pixels is None:
            raise self._lost(
                phase,
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        size = (self._info.height, self._info.width)
        if image.dtype != np.uint8 or image.shape not in {size, (*size, 3)}:
            raise DeviceRefused(
                self.name,
                phase,
                f"an image of {image.shape} {image.dtype}, not {size} uint8",
                "draw it for the size in info()",
            )
        np.copyto(np.ndarray(image.shape, np.uint8, self._pixels), image)
        moment: int = self._ask(Call("show", image.shape), phase)
        return moment

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device. [] where there is no display."""
        return DisplayWindow.discover()

    # ------------------------------------------------------------ the process

    def _ask(self, call: Call, phase: str, timeout_s: float = CALL_S) -> Any:
        """One call, answered. Raises the window's DeviceError, DeviceLost where nothing answers."""
        if self._calls is None:
            raise self._lost(
                phase,
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        try:
            self._calls.send(call)
            if not self._calls.poll(timeout_s):
                if self._process is not None:
                    self._process.kill()
                self.close()
                raise self._lost(
                    phase,
                    f"its window did not answer within {timeout_s:g} s",
                    "look whether the graphics driver hangs; it is opened again",
                )
            reply: Reply = self._calls.recv()
        except (EOFError, OSError) as error:
            said = self._last_words()
            self.close()
            raise self._lost(
                phase,
                f"the process of its window has ended{said}",
                "start the X server or desktop again; it is opened again when that is there",
            ) from error
        if reply.error is not None:
            raise reply.error(self.name, phase, *reply.words[1:])
        return reply.value

    def _last_words(self) -> str:
        """What the process wrote last, or how it ended."""
        if self._process is None or self._errors is None:
            return ""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(LEAVE_S)
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        said = " ".join(" ".join(lines[-2:]).split())  # Xlib takes two for one sentence
        return f": {said}" if said else f" (exit status {self._process.returncode})"

    def _lost(self, phase: str, problem: str, remedy: str) -> DeviceLost:
        return DeviceLost(self.name, phase, problem, remedy)
