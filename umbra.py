"""The face for notebooks: ``import umbra; rig = umbra.connect()``. Only hands names on."""

from protocol.aio import AsyncClient
from protocol.client import Client, connect
from protocol.errors import Code, UmbraError
from protocol.patterns import BLACK, WHITE, Checker, Solid
from protocol.scans import (
    CalibrateDark,
    CalibrateLatency,
    CalibrateLeak,
    CalibrateNoise,
    CalibrateTone,
    Checkerboard,
    GrayCode,
    Mesh,
    Radiometry,
    RandomBinary,
    RandomPhase,
    Reference,
    SingleImage,
    Sinusoid,
    Stick,
    TwoImage,
)

__all__ = [
    "BLACK",
    "WHITE",
    "AsyncClient",
    "CalibrateDark",
    "CalibrateLatency",
    "CalibrateLeak",
    "CalibrateNoise",
    "CalibrateTone",
    "Checker",
    "Checkerboard",
    "Client",
    "Code",
    "GrayCode",
    "Mesh",
    "Radiometry",
    "RandomBinary",
    "RandomPhase",
    "Reference",
    "SingleImage",
    "Sinusoid",
    "Solid",
    "Stick",
    "TwoImage",
    "UmbraError",
    "connect",
]
