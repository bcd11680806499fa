"""All that `submit` takes."""

from __future__ import annotations

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
from protocol.scans.verifications import (
    VerifyCheckerSize,
    VerifyLitFraction,
    VerifyPatchSize,
    VerifyRandomPatterns,
)

AnySeparation = (
    Checkerboard
    | TwoImage
    | Stick
    | Mesh
    | Sinusoid
    | RandomPhase
    | GrayCode
    | RandomBinary
    | SingleImage
)
AnyCalibration = CalibrateDark | CalibrateNoise | CalibrateLeak | CalibrateTone | CalibrateLatency
AnyVerification = VerifyPatchSize | VerifyRandomPatterns | VerifyLitFraction | VerifyCheckerSize
AnyScan = AnySeparation | AnyCalibration | AnyVerification | Advise
