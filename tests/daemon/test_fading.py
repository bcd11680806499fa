"""Light that scatters over less than a patch or a period: stated, flagged, told."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.method import Expose
from daemon.separation.estimator import Components, Lighting, Quality
from daemon.separation.sampling import gathered
from protocol.scans.anyscan import AnySeparation
from protocol.scans.projected import RandomPhase, Sinusoid, TwoImage
from protocol.scans.spec import Radiometry
from tests.daemon.scene import FULL, Scene

LIGHT = Radiometry(leakage=0.0)
LEFT, RIGHT = np.s_[16:-16, 16:96], np.s_[16:-16, 120:-8]


def scattering(part: float) -> Scene:
    """The right third scatters so much of full scale over 3 px."""

    def change(light: NDArray[Any], step: Expose) -> NDArray[Any]:
        if step.lighting is Lighting.BLACK or step.pattern is None:
            return light
        shown = patterns.render(step.pattern, scene.width, scene.height) / 255.0
        near = cv2.GaussianBlur(shown.astype(np.float64), (0, 0), 3.0) * (part * FULL)
        near[:, :108] = 0.0
        return np.asarray(light + near)

    scene = Scene(width=160, height=96, sigma=0.004, blur=0.4, change=change)
    return scene


def _errors(scene: Scene, found: Components) -> tuple[NDArray[Any], NDArray[Any]]:
    return np.abs(found.direct - scene.direct) / found.planes["direct_std"], (
        found.quality & np.uint16(Quality.DISAGREE)
    ) != 0


@pytest.mark.parametrize(
    "spec",
    [
        TwoImage(radiometry=LIGHT),
        RandomPhase(patch=8, phases=5, radiometry=LIGHT),
        Sinusoid(phases=5, periods=(12, 20), radiometry=LIGHT),
    ],
    ids=lambda s: type(s).__name__,
)
def test_it_is_in_the_deviation_and_flagged(spec: AnySeparation) -> None:
    scene = scattering(0.3)
    found = scene.scan(spec)
    off, flagged = _errors(scene, found)
    over = (found.direct - scene.direct)[RIGHT] / FULL
    assert np.median(over) > 0.02  # it does count as direct
    assert np.median(off[RIGHT]) < 1.5
    assert np.mean(off[RIGHT] > 5) < 0.01
    assert flagged[RIGHT].mean() > 0.95
    assert np.median(off[LEFT]) < 1.2
    assert flagged[LEFT].mean() < 0.03
    ratio = found.planes["direct_std"][RIGHT].mean() / found.planes["direct_noise"][RIGHT].mean()
    assert ratio > 3.0
    assert len(found.facts["advice"]) == 1
    assert "scattered" in found.facts["advice"][0]


@pytest.mark.parametrize(
    "spec",
    [TwoImage(radiometry=LIGHT), Sinusoid(phases=5, periods=(12, 20), radiometry=LIGHT)],
    ids=lambda s: type(s).__name__,
)
def test_there_is_none_where_light_is_smooth(spec: AnySeparation) -> None:
    scene = scattering(0.0)
    off, flagged = _errors(scene, scene.scan(spec))
    assert flagged.mean() < 0.003
    assert np.mean(off > 5) < 0.01


def test_one_period_says_that_it_does_not_tell() -> None:
    for periods, told in (((16,), False), ((16, 24), True)):
        found = scattering(0.0).scan(Sinusoid(phases=3, periods=periods, radiometry=LIGHT))
        assert found.facts["scattering_looked_for"] is told


def test_the_finest_period_counts_where_others_differ() -> None:
    scene = scattering(0.3)
    both = scene.scan(Sinusoid(phases=5, periods=(20, 12), radiometry=LIGHT))
    fine, coarse = (
        scene.scan(Sinusoid(phases=5, periods=(period,), radiometry=LIGHT)) for period in (12, 20)
    )
    over = [float(np.median((one.direct - scene.direct)[RIGHT])) for one in (fine, both, coarse)]
    assert over[1] < 0.5 * (over[0] + over[2])


def test_most_of_a_population_is_not_moved_by_a_tail() -> None:
    rng = np.random.default_rng(3)
    tail = np.concatenate([rng.normal(1.0, 0.1, 6000), rng.uniform(1.0, 4.0, 4000)])
    assert gathered(tail) == pytest.approx(1.0, abs=0.04)
    assert np.median(tail) > 1.08
    assert gathered(np.array([2.0])) == 2.0
