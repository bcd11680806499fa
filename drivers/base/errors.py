"""What goes wrong in a device: the kinds of error that drivers raise."""

from __future__ import annotations


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


class OutOfRange(DeviceRefused):
    """It was asked for a number that is beyond what it can do; nothing was sent."""


class DeviceGarbled(DeviceError):
    """It answered something that makes no sense."""


class EndOfRecording(DeviceRefused):
    """A recorded camera has no more frames."""
