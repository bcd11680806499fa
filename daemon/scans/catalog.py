"""Which method does which scan."""

from __future__ import annotations

from typing import Any

from daemon.scans.advise import AdviseMethod
from daemon.scans.calibrate_dark import DarkMethod
from daemon.scans.calibrate_latency import LatencyMethod
from daemon.scans.calibrate_leak import LeakMethod
from daemon.scans.calibrate_noise import NoiseMethod
from daemon.scans.calibrate_tone import ToneMethod
from daemon.scans.checkerboard import CheckerboardMethod
from daemon.scans.gray_code import GrayCodeMethod
from daemon.scans.mesh import MeshMethod
from daemon.scans.method import Bench, Method, Unsuitable
from daemon.scans.random_binary import RandomBinaryMethod
from daemon.scans.single_image import SingleImageMethod
from daemon.scans.sinusoid import RandomPhaseMethod, SinusoidMethod
from daemon.scans.stick import StickMethod
from daemon.scans.two_image import TwoImageMethod
from daemon.scans.verify_checker_size import VerifyCheckerSizeMethod
from daemon.scans.verify_lit_fraction import VerifyLitFractionMethod
from daemon.scans.verify_patch_size import VerifyPatchSizeMethod
from daemon.scans.verify_random_patterns import VerifyRandomPatternsMethod
from protocol.scans.anyscan import AnyScan
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

_METHODS: dict[type[AnyScan], type[Method[Any]]] = {
    Checkerboard: CheckerboardMethod,
    TwoImage: TwoImageMethod,
    Stick: StickMethod,
    Mesh: MeshMethod,
    Sinusoid: SinusoidMethod,
    RandomPhase: RandomPhaseMethod,
    GrayCode: GrayCodeMethod,
    RandomBinary: RandomBinaryMethod,
    SingleImage: SingleImageMethod,
    CalibrateDark: DarkMethod,
    CalibrateNoise: NoiseMethod,
    CalibrateLeak: LeakMethod,
    CalibrateTone: ToneMethod,
    CalibrateLatency: LatencyMethod,
    Advise: AdviseMethod,
    VerifyPatchSize: VerifyPatchSizeMethod,
    VerifyRandomPatterns: VerifyRandomPatternsMethod,
    VerifyLitFraction: VerifyLitFractionMethod,
    VerifyCheckerSize: VerifyCheckerSizeMethod,
}

NAMES: tuple[str, ...] = tuple(method.name for method in _METHODS.values())
"""The methods' names, as they travel."""


def method_for(spec: AnyScan, bench: Bench) -> Method[Any]:
    """The method of a scan, checked against the rig. Raises Unsuitable."""
    shortest, longest = bench.camera.exposure_range_us
    asked = spec.exposure_us
    stated = asked is not None and not spec.auto_exposure and not bench.camera.recorded
    if stated and longest and not shortest <= asked <= longest:  # type: ignore[operator]
        raise Unsuitable(
            f"the camera exposes for {shortest:g} to {longest:g} µs, not for {asked:g}",
            "$.exposure_us",
        )
    try:
        made = _METHODS[type(spec)]
    except KeyError:
        raise Unsuitable(f"no method does {type(spec).__name__}") from None
    return made(spec, bench)
