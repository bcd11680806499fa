"""What all cameras have in common that a library opens: the order of calls, and settings kept.

    closed ──connect──> idle ──start──> acquiring ──stop──> idle;  any ──close──> closed

After DeviceLost, `connect` again: it applies the settings that were in force.
"""

from __future__ import annotations

import contextlib
import threading
from abc import abstractmethod
from collections import deque
from contextlib import AbstractContextManager
from dataclasses import fields, replace

from drivers.base.camera import Acquisition, Camera, CameraInfo, CameraSettings
from drivers.base.device import Context, Identity, Options
from drivers.base.errors import DeviceError, DeviceRefused


class AttachedCamera(Camera):
    """See the module. A driver implements the methods below `what a driver adds`."""

    def __init__(self, name: str, options: Options, context: Context) -> None:
        super().__init__(name, options, context)
        self._halted = threading.Event()
        self._acquisition: Acquisition | None = None
        self._identity = Identity("")
        self._info: CameraInfo | None = None
        self._settings = CameraSettings()
        self._wanted = CameraSettings()  # to be set again after a loss
        self._triggered: deque[tuple[int, int]] = deque()  # exposures whose frames are to come
        self._late = False  # a triggered frame did not come, and may yet

    # ------------------------------------------------------------ what a driver adds

    @abstractmethod
    def _open(self) -> Identity:
        """Open the camera that the options name, all automatic corrections off."""

    @abstractmethod
    def _stated(self) -> CameraSettings:
        """The settings that the options name."""

    @abstractmethod
    def _apply(self, wanted: CameraSettings, phase: str) -> None:
        """Change settings; everything is checked before anything is set. Raises DeviceRefused."""

    @abstractmethod
    def _take_in(self) -> None:
        """Ask what is in force."""

    def _learn(self) -> None:
        """Find out what it delivers, once it has been opened and set."""
        self._take_in()

    @abstractmethod
    def _release(self) -> None:
        """Let go of the camera. Idempotent; does not raise for one that is gone."""

    @abstractmethod
    def _errors(self, phase: str) -> AbstractContextManager[None]:
        """Turns the library's exceptions into DeviceErrors."""

    # ------------------------------------------------------------ life

    def connect(self) -> Identity:
        """Open it, switch automatic corrections off, apply the options and the last settings."""
        self.close()
        try:
            with self._errors("connect"):
                self._identity = self._open()
                self._apply(merged(self._stated(), self._wanted), "connect")
                self._learn()
        except BaseException:
            self.close()
            raise
        return self._identity

    def safe(self) -> None:
        """Stopped."""
        self.stop()

    def halt(self) -> None:
        """See Device. A waiting grab or trigger raises soon; `start` clears it."""
        self._halted.set()

    def close(self) -> None:
        """See Device."""
        # A camera that is gone cannot be stopped: that it is gone is known already.
        with contextlib.suppress(DeviceError):
            self.stop()
        self._release()
        self._acquisition = self._info = None

    # ------------------------------------------------------------ settings

    def info(self) -> CameraInfo:
        """See Camera."""
        if self._info is None:
            raise self._refused(
                "info",
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )
        return self._info

    def settings(self) -> CameraSettings:
        """See Camera."""
        self.info()
        return self._settings

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """See Camera. Everything is checked against the camera's ranges before anything is set."""
        self._connected("configure")
        if self._acquisition is not None:
            raise self._refused("configure", "it is acquiring", "stop it first")
        with self._errors("configure"):
            self._apply(wanted, "configure")
            self._take_in()
        self._wanted = merged(self._wanted, wanted)
        return self._settings

    # ------------------------------------------------------------ errors

    def _connected(self, phase: str) -> None:
        if self._info is None:
            raise self._refused(
                phase,
                "not connected",
                "check its power and cable, and wait until it is connected again",
            )

    def _unless_halted(self, phase: str) -> None:
        if self._halted.is_set():
            raise self._refused(phase, "halted", "start it again")

    def _refused(self, phase: str, problem: str, remedy: str) -> DeviceRefused:
        return DeviceRefused(self.name, phase, problem, remedy)


def merged(under: CameraSettings, over: CameraSettings) -> CameraSettings:
    """The settings of `over`, and where it has none those of `under`."""
    given = {f.name: getattr(over, f.name) for f in fields(over)}
    return replace(under, **{name: v for name, v in given.items() if v is not None})
