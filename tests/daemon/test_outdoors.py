"""A drifting sun with clouds, shake and noise gives the same separation as a steady one."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.estimator import Quality
from protocol.scans.occluded import Mesh
from tests.daemon.outdoor_rig import Outdoors, scan

SPEC = Mesh(coverage=1.0, hole_mm=25.0, pitch_mm=40.0, scene_mm=150.0, sun=True, time_limit_s=60.0)
STAGE = {"hole_mm": 25.0, "pitch_mm": 40.0}
CAMERA = {"width": 208, "height": 156, "frame_rate_hz": 12.0, "exposure_us": 4000.0}
SUN = {"strength": 4.0}  # exposed as briefly: the mesh moves less, and is drawn faster
CLOUDS = (
    (0.0, 1.0),
    (13.0, 1.0),
    (14.0, 0.5),
    (16.0, 0.5),
    (17.0, 1.0),
    (18.0, 0.95),
    (99.0, 0.95),
)
GUSTS = ((0.0, 0.0), (11.5, 0.0), (12.0, 2.0), (17.5, 2.0), (18.0, 0.0), (99.0, 0.0))
FULL_SCALE = 4095.0


@functools.cache
def under(weather: str, seed: int) -> Outdoors:
    sun: dict[str, Any] = {**SUN, "drift_deg_per_hour": 0.0}
    camera: dict[str, Any] = {**CAMERA, "seed": seed}
    if weather != "steady":
        sun = {**SUN, "clouds": CLOUDS}
    if weather == "rough":
        camera["gusts"] = GUSTS
    frames = 140 if weather == "steady" else 170
    return scan(SPEC, stage=STAGE, sun=sun, camera=camera, frames=frames)


def apart(
    one: Outdoors, other: Outdoors, among: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Differences of direct and global where the sun shines, over the deviations that both state:
    (2, n)."""
    a, b = one.components, other.components
    lit = one.truth["direct"] > 0.05 * FULL_SCALE
    if among is not None:
        lit &= among
    known = lit & np.isfinite(a.direct) & np.isfinite(b.direct)
    stated = [np.hypot(a.planes[name], b.planes[name]) for name in ("direct_std", "global_std")]
    different = b.direct - a.direct, b.global_ - a.global_
    return np.array([(x / std)[known] for x, std in zip(different, stated, strict=True)])


def rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_drift_and_clouds_change_nothing_beyond_the_noise() -> None:
    """The noise is what two steady scans differ by. Light other than the sun's is scaled with it:
    of global, up to a cloud's 5 % of the ambient light that it holds."""
    steady = under("steady", 1)
    cloudy = under("cloudy", 3)
    rejected = cloudy.components.facts["rejected"]
    assert rejected["cloud"] > 20
    least, most = cloudy.components.facts["source_strength"]
    assert least == pytest.approx(0.5, abs=0.03)
    assert most == pytest.approx(1.0, abs=0.1)
    assert steady.components.facts["penumbra_mm"] == pytest.approx(1.4, abs=0.2)
    assert steady.components.facts["leakage_at_most"] == 0.0
    noise, found = apart(steady, under("steady", 2)), apart(steady, cloudy)
    for component in noise:
        assert 0.8 < rms(component) < 1.25  # as stated
    assert rms(found[0]) < 1.2 * rms(noise[0])
    assert rms(found[1]) < 1.3 * rms(noise[1])
    bright = steady.truth["direct"] > 0.05 * FULL_SCALE
    ratio = np.nanmedian(cloudy.components.direct[bright] / steady.components.direct[bright])
    assert ratio == pytest.approx(1.0, abs=0.003)


def test_with_gusts_too_nothing_changes_beyond_the_noise() -> None:
    """Interpolation blurs what is finer than a pixel: there moved frames have no say, and where no
    others are the pixels are marked."""
    steady, rough = under("steady", 1), under("rough", 3)
    assert rough.components.facts["aligned_frames"] > 12
    marked = rough.components.quality & np.uint16(Quality.MOVED) != 0
    assert marked.mean() < 0.005
    noise, found = apart(steady, under("steady", 2)), apart(steady, rough, ~marked)
    for of_noise, of_gusts in zip(noise, found, strict=True):
        assert np.median(np.abs(of_gusts)) < 1.3 * np.median(np.abs(of_noise))
        assert rms(of_gusts) < 1.2 * rms(of_noise)
    bright = steady.truth["direct"] > 0.05 * FULL_SCALE
    ratio = np.nanmedian(rough.components.direct[bright] / steady.components.direct[bright])
    assert ratio == pytest.approx(1.0, abs=0.01)
