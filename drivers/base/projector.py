"""What a projector is: single images, and sequences that it times by itself."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base.device import Device
from drivers.base.errors import DeviceRefused


@dataclass(frozen=True, slots=True)
class SequenceLimits:
    """What a projector that times a sequence by itself can be asked for."""

    images: int  # at most, in one sequence
    bits: int  # 1: black and white only; 8: grey levels
    period_us: tuple[float, float]  # the shortest and the longest from one image to the next
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
