"""The face for notebooks: ``import umbra; rig = umbra.connect()``. Only hands names on."""

from protocol.aio import AsyncClient
from protocol.client import Client, connect
from protocol.errors import Code, UmbraError
from protocol.patterns import BLACK, WHITE, Checker, Solid
from protocol.scans.calibrations import (
    CalibrateDark,
    CalibrateLatency,
    CalibrateLeak,
    CalibrateNoise,
    CalibrateTone,
)
from protocol.scans.measuring import Advise
from protocol.scans.occluded import Mesh, Stick
from protocol.scans.projected import (
    Checkerboard,
    GrayCode,
    RandomBinary,
    RandomPhase,
    SingleImage,
    Sinusoid,
    TwoImage,
)
from protocol.scans.spec import Radiometry, Reference
from protocol.scans.verifications import (
    Point,
    VerifyCheckerSize,
    VerifyLitFraction,
    VerifyPatchSize,
    VerifyRandomPatterns,
)

__all__ = [
    "BLACK",
    "WHITE",
    "Advise",
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
    "Point",
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
    "VerifyCheckerSize",
    "VerifyLitFraction",
    "VerifyPatchSize",
    "VerifyRandomPatterns",
    "connect",
]
