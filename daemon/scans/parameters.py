"""The numbers a method reckons with: as the scan asks, else as calibrated, else as the camera says.

Values of the calibration are those that apply to the rig, see `daemon.runs.calibration`.
"""

from __future__ import annotations

from daemon.scans.method import Bench, Unsuitable
from daemon.separation.noise import Noise
from daemon.separation.radiometry import Response
from protocol.scans.spec import Radiometry


def response_of(radiometry: Radiometry, bench: Bench) -> Response:
    """How this camera's counts follow from light. Raises Unsuitable for numbers that don't fit the
    camera."""
    calibration = bench.calibration or {}
    black = radiometry.black
    if black is None:
        black = float(calibration.get("black", bench.camera.black_level))
    pixel_format = bench.camera.pixel_format
    noise = noise_of(radiometry, bench)
    try:
        return Response(
            full_scale=pixel_format.full_scale,
            black=black,
            tone=radiometry.tone,
            saturation=radiometry.saturation,
            bayer=pixel_format.bayer,
            noise=None
            if noise is None
            else Noise.of_read_and_shot(*noise, black, pixel_format.full_scale),
        )
    except ValueError as error:
        raise Unsuitable(str(error), "$.radiometry") from error


def noise_of(radiometry: Radiometry, bench: Bench) -> tuple[float, float] | None:
    """Read noise (counts) and counts an electron, as calibrated. None where they are not known, and
    where the camera encodes its counts: the calibration is of linear light."""
    found = (bench.calibration or {}).get("noise")
    if found is None or radiometry.tone != "linear":
        return None
    return float(found["read_counts"]), float(found["counts_per_e"])


def leakage_of(radiometry: Radiometry, bench: Bench) -> float:
    """The leakage b; 0 where nobody says."""
    if radiometry.leakage is not None:
        return radiometry.leakage
    return float((bench.calibration or {}).get("leakage", 0.0))


def exposure_of(asked_us: float | None, bench: Bench) -> float:
    """The run's exposure, us. Raises Unsuitable for a camera that does not say."""
    found = asked_us if asked_us is not None else bench.exposure_us
    if found is None:
        raise Unsuitable("the camera does not say how long it exposes: --exposure", "$.exposure_us")
    return found
