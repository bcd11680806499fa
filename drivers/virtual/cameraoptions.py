"""What a virtual camera can be told in rig.toml, and what its sensor is like."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from drivers.base.pixelformat import PixelFormat
from drivers.virtual.device import VirtualOptions

EXPOSURE_US = (20.0, 10e6)
GAIN_DB = (0.0, 36.0)
CORRECT_US = 1e6 / 60  # with this exposure and no gain radiance 1 gives CORRECT_LEVEL
CORRECT_LEVEL = 0.8  # of the scale


class CameraOptions(VirtualOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of ``[camera] driver = "virtual"``."""

    width: Annotated[int, Meta(ge=32, le=8192)] = 640
    height: Annotated[int, Meta(ge=32, le=8192)] = 480
    pixel_format: PixelFormat = PixelFormat.BAYER_RG12
    exposure_us: Annotated[float, Meta(ge=EXPOSURE_US[0], le=EXPOSURE_US[1])] = CORRECT_US
    gain: Annotated[float, Meta(ge=GAIN_DB[0], le=GAIN_DB[1])] = 0.0  # dB
    frame_rate_hz: Annotated[float, Meta(gt=0)] = 30.0  # free-running
    trigger_latency_us: Annotated[float, Meta(ge=0)] = 50.0
    readout_ms: Annotated[float, Meta(ge=0)] = 4.0
    rolling_ms: Annotated[float, Meta(ge=0)] = 0.0  # a rolling shutter: from first row to last
    rolling_told: bool = True  # whether it says so
    triggers: tuple[Literal["software", "hardware", "none"], ...] = (
        "software",
        "hardware",
        "none",
    )  # what it takes; "none": it can run free
    buffers: Annotated[int, Meta(ge=1, le=256)] = 8  # frames that wait in the driver
    black_level: Annotated[float, Meta(ge=0)] | None = None  # counts; None: 1/64 of full scale
    full_well_e: Annotated[float, Meta(gt=0)] = 10_500.0  # electrons at full scale without gain
    read_noise_e: Annotated[float, Meta(ge=0)] = 3.0
    noise: bool = True  # shot and read noise; rounding stays
    ambient: Annotated[float, Meta(ge=0)] = 0.02  # radiance of white under the room's light
    shake_px: Annotated[float, Meta(ge=0)] = 0.0  # sd of the picture's place, frame by frame
    gusts: tuple[tuple[float, Annotated[float, Meta(ge=0)]], ...] = ()  # (second, sd in px)
    sway_hz: Annotated[float, Meta(gt=0)] = 1.5  # how fast a gust makes the camera sway
    seed: Annotated[int, Meta(ge=0)] = 1
