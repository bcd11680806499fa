"""SDL's video in this process: started, had by one at a time, and its outputs' names."""

from __future__ import annotations

import ctypes
import os
import threading
from pathlib import Path

import pygame

HINTS = {
    "SDL_NO_SIGNAL_HANDLERS": "1",  # SIGTERM is the daemon's
    "SDL_VIDEO_DOUBLE_BUFFER": "1",  # KMSDRM: a flip returns when it has happened
    "SDL_RENDER_SCALE_QUALITY": "nearest",
    "SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": "0",  # a click on another screen must not take it down
    "SDL_VIDEO_ALLOW_SCREENSAVER": "0",
}


class Screen:
    """SDL's one display in this process, and who has it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._owner: object = None

    def take(self, owner: object) -> bool:
        """Have it, unless somebody else does."""
        with self._lock:
            if self._owner in {None, owner}:
                self._owner = owner
            return self._owner is owner

    def leave(self, owner: object) -> None:
        """Let others have it."""
        with self._lock:
            if self._owner is owner:
                self._owner = None


screen = Screen()


def start(video_driver: str) -> None:
    """Start SDL's video in this thread. Raises pygame.error, also where nothing can be seen."""
    for key, value in HINTS.items():
        os.environ.setdefault(key, value)
    if video_driver:
        before = os.environ.get("SDL_VIDEODRIVER")
        os.environ["SDL_VIDEODRIVER"] = video_driver
    try:
        pygame.display.init()
    finally:
        if video_driver:
            del os.environ["SDL_VIDEODRIVER"]
            if before is not None:
                os.environ["SDL_VIDEODRIVER"] = before
    if (driver := pygame.display.get_driver()) in {"dummy", "offscreen"}:
        raise pygame.error(f"no display was found (its {driver} driver shows nothing)")


def names(driver: str) -> list[str]:
    """The outputs' names in SDL's order: the connectors' under KMSDRM, else SDL's own."""
    count = pygame.display.get_num_displays()
    if driver == "kmsdrm":
        found = connectors(Path("/sys/class/drm"))
        if len(found) == count:
            return found
    library = ctypes.CDLL(pygame.base.__file__)  # SDL is among what it is linked with
    library.SDL_GetDisplayName.restype = ctypes.c_char_p
    return [(library.SDL_GetDisplayName(k) or str(k).encode()).decode() for k in range(count)]


def connectors(drm: Path) -> list[str]:
    """Connectors with something plugged in ("HDMI-A-1"), in the kernel's order."""
    connected = [
        path.parent
        for path in drm.glob("card*-*/status")
        if path.read_text().strip() == "connected"
    ]

    def order(path: Path) -> tuple[str, int]:
        number = path / "connector_id"
        return path.name.partition("-")[0], int(number.read_text()) if number.exists() else 0

    return [path.name.partition("-")[2] for path in sorted(connected, key=order)]
