"""The source's strength is followed while a mesh's shadow moves, and is not fooled by it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Taken
from daemon.separation.estimator import Components, Observation
from daemon.separation.radiometry import Response
from daemon.separation.strength import SourceStrength
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.stage import StageInfo
from protocol.scans.occluded import Mesh
from tests.daemon.scanning import watched
from tests.daemon.test_mesh import COVERING, DEEP, HEIGHT, MESH, WIDTH, circle, counts, errors

TURN = 72
CLOUD = 2 * TURN


def sky(frame: int) -> float:
    """Steady for two turns, a cloud, then a source that has sunk a little."""
    if frame < CLOUD:
        return 1.0
    if frame < CLOUD + 32:
        return 0.6
    return 0.95


def frames(turns: int, *, steady: bool) -> list[NDArray[Any]]:
    one = circle(COVERING, TURN, noise=200.0)
    return [
        counts(one[k % TURN].astype(np.float64) * (1.0 if steady else sky(k)))
        for k in range(turns * TURN)
    ]


def test_strength_is_the_sources_and_not_the_shadows() -> None:
    source = SourceStrength(DEEP)
    seen = []
    for k, frame in enumerate(frames(4, steady=False)):
        strength = source.of(frame)
        seen.append(strength)
        if abs(strength - 1.0) < 0.15:
            source.accept()
        assert strength == pytest.approx(sky(k), abs=0.01)
    assert source.learned


def observed(shots: list[NDArray[Any]]) -> tuple[Components, list[Observation]]:
    camera = CameraInfo(WIDTH, HEIGHT, PixelFormat.MONO16)
    bench = Bench(camera, stage=StageInfo(((0, 500), (0, 300)), 100.0))
    return watched(Mesh(hole_mm=MESH.hole_mm, pitch_mm=MESH.pitch_mm, sun=True), bench, shots)


def test_a_cloud_is_kept_out_and_drift_is_scaled_so_that_the_separation_is_the_same() -> None:
    clear, _ = observed(frames(4, steady=True))
    cloudy, decided = observed(frames(4, steady=False))
    assert cloudy.facts["rejected"]["cloud"] == 32
    assert list(clear.facts["rejected"]) == ["before the source's strength was known"]
    assert "source at 60%" in decided[CLOUD + 20].reason
    assert [o.fresh for o in decided].count(True) == 1
    assert decided[-1].used
    assert decided[-1].strength == pytest.approx(0.95, abs=0.01)
    for one, other in zip(errors(clear), errors(cloudy), strict=True):
        assert other < 1.2 * one + 50.0  # 50 of 65535


def test_what_was_observed_is_followed_on_after_an_interruption() -> None:
    shots = frames(3, steady=False)
    whole, decided = observed(shots)
    camera = CameraInfo(WIDTH, HEIGHT, PixelFormat.MONO16)
    bench = Bench(camera, stage=StageInfo(((0, 500), (0, 300)), 100.0))
    method = method_for(Mesh(hole_mm=MESH.hole_mm, pitch_mm=MESH.pitch_mm, sun=True), bench)
    step = method.step(0, {})
    assert step is not None
    for frame, observation in zip(shots[:150], decided[:150], strict=True):
        method.recall(frame, observation)
    later = [
        method.observe(step, Taken(0, k, incomplete=False, pixels=shots[k]))
        for k in range(150, len(shots))
    ]
    assert later == decided[150:]
    assert method.conclude(whole).facts["rejected"] == whole.facts["rejected"]


def test_a_scan_that_begins_under_a_cloud_begins_anew_when_the_sun_is_out() -> None:
    one = circle(COVERING, TURN, noise=200.0)
    shots = [
        counts(one[k % TURN].astype(np.float64) * (0.5 if k < 100 else 0.9)) for k in range(350)
    ]
    _, decided = observed(shots)
    again = [k for k, o in enumerate(decided) if o.reason == "cloud at the start"]
    assert again == [149]  # 50 frames after the sun came out
    assert "180%: brighter than when the scan began" in decided[120].reason
    assert decided[149].fresh
    found, _ = observed(shots)
    assert found.facts["rejected"]["cloud at the start"] > 0
    reference, _ = observed([counts(f.astype(np.float64) * 0.9) for f in one * 4])
    np.testing.assert_allclose(
        np.nanmedian(found.direct), np.nanmedian(reference.direct), rtol=0.003
    )


@pytest.mark.parametrize("tone", ["linear", "srgb"])
def test_scaling_counts_scales_light(tone: str) -> None:
    response = Response(full_scale=4095, black=64.0, tone=tone)
    before = np.arange(200, 3000, 7, dtype=np.uint16)
    after = response.scaled(before, 1.25)
    np.testing.assert_allclose(
        response.linear(after), 1.25 * response.linear(before), rtol=0.01, atol=2
    )
    assert response.scaled(np.array([4095], np.uint16), 0.5) == 4095  # saturated stays so
