"""Separation from sinusoids in time."""

from __future__ import annotations

from math import tau

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.scans import catalog
from daemon.scans.method import Expose
from daemon.separation.deviation import of_noise
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.frameset import UNCHECKED
from daemon.separation.radiometry import Response
from daemon.separation.sinusoid import LeastSquares
from protocol.scans.projected import Sinusoid as Spec
from tests.daemon.scene import Scene

FULL = 65535
HEIGHT, WIDTH = 64, 96


def scene() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Direct, global, φ."""
    rng = np.random.default_rng(3)
    direct = rng.uniform(0.2, 0.5, (HEIGHT, WIDTH)) * FULL
    indirect = rng.uniform(0.05, 0.3, (HEIGHT, WIDTH)) * FULL
    return direct, indirect, rng.uniform(0, tau, (HEIGHT, WIDTH))


def frames(
    count: int,
    *,
    leakage: float = 0.0,
    sigma: float = 0.0,
    ambient: float = 0.0,
    gamma: float = 1.0,
    seed: int = 1,
    periods: int = 1,
) -> list[tuple[Observation, NDArray[np.uint16]]]:
    """Black, white and the phases, as a camera with Gaussian noise counts them."""
    rng = np.random.default_rng(seed)
    direct, indirect, phi = scene()
    levels = [(Observation(lighting=Lighting.BLACK), 0.0, 0.0)]
    levels += [(Observation(lighting=Lighting.WHITE), 1.0, 1.0)]
    shown = []
    for observation, lit, mean in levels:
        shown.append((observation, np.full_like(phi, lit), mean))
    for frequency in range(periods):
        for k in range(count):
            wave = 0.5 + 0.5 * np.sin(phi + tau * k / count)
            index = frequency * count + k
            shown.append((Observation(pattern=index), wave**gamma, float(_mean(gamma))))
    found = []
    for observation, level, mean in shown:
        light = direct * (leakage + (1 - leakage) * level)
        light = light + indirect * (leakage + (1 - leakage) * mean) + ambient
        noisy = np.clip(light + rng.normal(0, 1, light.shape) * sigma, 0, FULL)
        found.append((observation, np.rint(noisy).astype(np.uint16)))
    return found


def _mean(gamma: float) -> float:
    return float(np.mean((0.5 + 0.5 * np.sin(np.arange(1000) * tau / 1000)) ** gamma))


def separate(
    shown: list[tuple[Observation, NDArray[np.uint16]]],
    count: int,
    leakage: float = 0.0,
    *,
    references: bool = True,
) -> Components:
    estimator = LeastSquares(
        Response(full_scale=FULL),
        phases=[(0, tau * k / count) for k in range(count)],
        leakage=leakage,
    )
    for observation, frame in shown:
        if references or observation.lighting is Lighting.PATTERN:
            estimator.update(frame, observation)
    return estimator.result()


@pytest.mark.parametrize("count", [3, 4, 7])
@pytest.mark.parametrize("leakage", [0.0, 0.08])
@pytest.mark.parametrize("ambient", [0.0, 3000.0])
def test_components_and_phase_come_back(count: int, leakage: float, ambient: float) -> None:
    direct, indirect, phi = scene()
    found = separate(frames(count, leakage=leakage, ambient=ambient), count, leakage)
    np.testing.assert_allclose(found.direct, direct, atol=4)
    np.testing.assert_allclose(found.global_, indirect, atol=6)
    apart = (found.planes["phase"] - phi + np.pi) % tau - np.pi
    assert np.abs(apart).max() < 1e-3
    assert found.facts["mean_ratio"] == pytest.approx(1.0, abs=1e-3)
    # a picture whose pixels are all different may be noise for all that three phases tell; and none
    # can tell a room's light from a leakage that is taken as none
    usual = ("show no pattern", "leakage is taken as none")
    assert not [line for line in found.facts["advice"] if not any(u in line for u in usual)]


@pytest.mark.parametrize("count", [3, 7, 25])
def test_noise_is_the_theorys_and_is_stated(count: int) -> None:
    """sd(L_d) = 2σ√(2/N), sd(L_g) = 2σ√(3/N), and no bias."""
    sigma = 0.02 * FULL
    direct, indirect, _ = scene()
    runs = [separate(frames(count, sigma=sigma, seed=s), count, references=False) for s in range(6)]
    for name, truth, factor in (("direct", direct, 2), ("global_", indirect, 3)):
        errors = np.stack([getattr(run, name) - truth for run in runs])
        theory = 2 * sigma * np.sqrt(factor / count)
        assert errors.std() == pytest.approx(theory, rel=0.1)
        assert abs(errors.mean()) < 0.2 * sigma
        if count > 3:
            stated = of_noise(runs[0].planes, f"{name.rstrip('_')}_std")
            assert float(np.median(stated)) == pytest.approx(theory, rel=0.1)


def test_a_missing_phase_is_fitted_around() -> None:
    shown = [s for s in frames(6) if s[0].pattern != 2 or s[0].lighting is not Lighting.PATTERN]
    found = separate(shown, 6)
    np.testing.assert_allclose(found.direct, scene()[0], atol=5)
    np.testing.assert_allclose(found.global_, scene()[1], atol=8)


def test_three_phases_are_needed() -> None:
    shown = frames(3)[:4]  # black, white, two phases
    with pytest.raises(NotYet, match="3 phases"):
        separate(shown, 3)


def test_a_projectors_gamma_is_told_of() -> None:
    found = separate(frames(5, gamma=2.2), 5)
    assert found.facts["mean_ratio"] < 0.85
    assert "tone curve" in found.facts["advice"][0]


def test_frequencies_that_disagree_are_flagged() -> None:
    """A patch answers to the second frequency with half the direct light: it mirrors."""
    shown = frames(4, sigma=60.0, periods=2)
    _, indirect, _ = scene()
    estimator = LeastSquares(
        Response(full_scale=FULL),
        phases=[(f, tau * k / 4) for f in range(2) for k in range(4)],
        leakage=0.0,
    )
    for observation, frame in shown:
        seen = frame.astype(np.float64)
        if observation.lighting is Lighting.PATTERN and observation.pattern >= 4:
            mean = np.asarray(scene()[0] / 2 + indirect / 2)
            seen[:8, :8] = (mean + (seen - mean) / 2)[:8, :8]
        estimator.update(np.rint(seen).astype(np.uint16), observation)
    flagged = (estimator.result().quality & np.uint16(Quality.DISAGREE)) != 0
    assert flagged[:8, :8].mean() > 0.95
    flagged[:8, :8] = False
    assert flagged.mean() < 0.001


@pytest.mark.parametrize("axis", ["x", "y"])
def test_several_periods_give_an_absolute_coordinate(axis: str) -> None:
    rng = np.random.default_rng(5)
    periods, size = (16.0, 17.0, 19.0), 1024
    where = rng.uniform(0, size - 1, (40, 50))
    estimator = LeastSquares(
        Response(full_scale=FULL),
        phases=[(f, tau * k / 5) for f in range(3) for k in range(5)],
        leakage=0.0,
        periods=periods,
        size=size,
        axis=axis,
    )
    for f, period in enumerate(periods):
        for k in range(5):
            wave = 0.5 + 0.5 * np.sin(tau * where / period + tau * k / 5)
            light = 30000 * wave + 5000 + rng.normal(0, 300, wave.shape)
            seen = Observation(pattern=f * 5 + k)
            estimator.update(np.rint(np.clip(light, 0, FULL)).astype(np.uint16), seen)
    planes = estimator.result().planes
    error = np.abs(planes["column" if axis == "x" else "row"] - where)
    assert np.median(error) < 0.05
    assert (error < 0.5).mean() > 0.99


def test_a_resumed_fit_gives_the_same_bits() -> None:
    shown = frames(5, sigma=300.0)
    estimators = [
        LeastSquares(
            Response(full_scale=FULL), phases=[(0, tau * k / 5) for k in range(5)], leakage=0.0
        )
        for _ in range(2)
    ]
    for index, (observation, frame) in enumerate(shown):
        for which, estimator in enumerate(estimators):
            estimator.update(frame.copy(), observation)
            if which and index > 5:
                estimator.result()
    one, other = (e.result() for e in estimators)
    for name in ("direct", "global_", "quality"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    for plane in one.planes:
        assert one.planes[plane].tobytes() == other.planes[plane].tobytes()


def test_two_periods_give_back_what_blur_takes() -> None:
    scene = Scene(blur=0.8, sigma=0.003)
    one = scene.scan(Spec(phases=5, weave=0.0, references=()))
    two = scene.scan(Spec(phases=5, periods=(12.0, 20.0), references=()))
    inside = np.s_[8:-8, 8:-8]
    loss = float(np.median(one.direct[inside] / scene.direct[inside]))
    left = float(np.median(two.direct[inside] / scene.direct[inside]))
    assert loss < 0.96
    assert left == pytest.approx(1.0, abs=0.015)
    assert two.facts["blur_px"] == pytest.approx(0.8, abs=0.15)
    assert ((two.quality & np.uint16(Quality.DISAGREE)) != 0).mean() < 0.01


def test_phases_declared_wrongly_are_told_of() -> None:
    """Eight phases of one period, declared as four of each of two."""
    scene = Scene(sigma=0.003)
    rng = np.random.default_rng(1)
    eight = catalog.method_for(Spec(phases=8, references=()), scene.bench())
    frames = []
    for index in range(8):
        step = eight.step(index, {})
        assert isinstance(step, Expose)
        frames.append(scene.frame(step, rng))
    advice = {}
    for phases, periods in ((8, (16.0,)), (4, (16.0, 24.0))):
        spec = Spec(phases=phases, periods=periods, references=())
        estimator = catalog.method_for(spec, scene.bench()).estimator()
        for index, frame in enumerate(frames):
            estimator.update(frame, Observation(pattern=index))
        advice[phases] = estimator.result().facts["advice"]
    assert advice[8] == [UNCHECKED]
    assert "--phases" in advice[4][0]


def test_a_blur_that_is_not_known_is_in_the_deviation() -> None:
    """Frames with next to no noise: what blur takes of plain stripes is the whole error."""
    scene = Scene(sigma=0.0002, blur=0.8)
    one = scene.scan(Spec(weave=0.0, phases=8))
    two = scene.scan(Spec(weave=0.0, phases=8, periods=(12.0, 16.0)))
    for found, least in ((one, 0.02), (two, 0.002)):
        off = np.abs(found.direct - scene.direct)[8:-8, 8:-8]
        stated = found.planes["direct_std"][8:-8, 8:-8]
        assert np.median(stated) > least * np.median(found.direct)
        assert np.median(off / stated) < 2.0
