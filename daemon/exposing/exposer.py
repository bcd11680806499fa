"""What every way of exposing pattern steps can do; the step loop knows no more of it."""

from __future__ import annotations

from abc import ABC, abstractmethod

from daemon.scans.method import Expose


class Behind(Exception):
    """The recorder gives no buffer back: the disk does not keep up."""


class Exposer(ABC):
    """A way of exposing pattern steps.

    Whatever it is: a frame is handed on only when it shows its own pattern, wholly and alone, by
    time stamps and looks; one that does not, or does not come, is exposed again, and after
    `attempts` times becomes an explicit missing record. Frames are handed on in order.
    """

    @abstractmethod
    def expose(self, index: int, step: Expose, first: int) -> tuple[int, int]:
        """Expose a step's frames from sub-index `first` on, and perhaps of steps after it.

        Gives the step and sub-index to go on with: the same again when it was called off by a
        pause. Its last frame may still be under way. Raises DeviceError, Revoked, Behind.
        """

    def settle(self) -> None:  # noqa: B027 - most have nothing under way between two steps
        """See what is under way to its end: recorded, repeated, or missing."""
