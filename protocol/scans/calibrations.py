"""Measurements of the rig that later runs apply by themselves."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from protocol.scans.measuring import Measuring
from protocol.scans.spec import Count, Positive

Levels = Annotated[int, Meta(ge=3, le=256)]


class Calibration(Measuring, frozen=True, kw_only=True):
    """A measurement that later runs apply by themselves, for as long as it is valid."""

    @property
    def kind(self) -> str:
        """What it calibrates: dark, noise, leak, tone or latency."""
        return str(self.__struct_config__.tag).removeprefix("calibrate-")


class CalibrateDark(Calibration, frozen=True, kw_only=True, tag="calibrate-dark"):
    """Black level, read noise and hot pixels of the camera; put its lens cap on if it has one."""

    exposures: Annotated[int, Meta(ge=2, le=32, description="exposure times, doubled from one to "
                                   "the next up to the present one")] = 4  # fmt: skip
    frames: Annotated[int, Meta(ge=2, le=1000, description="frames at each exposure")] = 8


class CalibrateNoise(Calibration, frozen=True, kw_only=True, tag="calibrate-noise"):
    """The camera's gain and noise by photon transfer: pairs of frames at several exposures."""

    exposures: Annotated[int, Meta(ge=2, le=32, description="exposure times, evenly spread up to "
                                   "the present one")] = 6  # fmt: skip
    pairs: Annotated[int, Meta(ge=1, le=500, description="pairs of frames at each exposure")] = 4


class CalibrateLeak(Calibration, frozen=True, kw_only=True, tag="calibrate-leak"):
    """The projector's leakage b, and what lit and unlit patches of several sizes keep of it."""

    sizes: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=256)], ...],
        Meta(min_length=2, description="sides of the patches, projector px; largest: reference"),
    ] = (1, 2, 3, 4, 6, 8, 12, 16)
    average: Annotated[int, Meta(ge=2, le=1000, description="frames averaged a pattern")] = 2


class CalibrateTone(Calibration, frozen=True, kw_only=True, tag="calibrate-tone"):
    """The projector's response to its levels; patterns are then drawn so that light is linear."""

    levels: Annotated[Levels, Meta(description="levels, evenly spread from black to white")] = 33
    average: Annotated[Count, Meta(description="frames averaged a level")] = 2


class CalibrateLatency(Calibration, frozen=True, kw_only=True, tag="calibrate-latency"):
    """How much later than the driver says the projector's light changes, and its spread."""

    longest_ms: Annotated[Positive, Meta(le=2000, description="delays up to this are found")] = 100
    flashes: Annotated[int, Meta(ge=8, le=1000, description="flashes, their triggers spread")] = 48
