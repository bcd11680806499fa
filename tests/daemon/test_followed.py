"""The noise that is left in the samples of a few pixels when their light is taken out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.scans import catalog
from daemon.scans.method import Expose
from daemon.scans.pattern_scan import RankedMethod
from daemon.separation.estimator import Components, Lighting, Observation
from daemon.separation.followed import Followed
from protocol.scans.projected import Checkerboard, RandomBinary
from tests.daemon.scene import FULL, Scene

ELECTRONS = 2000.0
READ = 0.004


class Shot:
    """Noise of a sensor, to be added to a scene's light."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(2)

    def __call__(self, light: NDArray[np.float64], _: Expose) -> NDArray[np.float64]:
        deviation = np.hypot(READ * FULL, np.sqrt(np.maximum(light, 0.0) * FULL / ELECTRONS))
        return light + self._rng.standard_normal(light.shape) * deviation


def frames(spec: Checkerboard | RandomBinary, scene: Scene) -> tuple[Followed, NDArray[np.uint16]]:
    method = catalog.method_for(spec, scene.bench())
    assert isinstance(method, RankedMethod)
    steps = (method.step(index, {}) for index in range(method.planned()))
    shown = [s for s in steps if isinstance(s, Expose) and s.lighting is Lighting.PATTERN]
    rng = np.random.default_rng(1)
    taken = np.stack([scene.frame(step, rng) for step in shown])
    return Followed(len(taken), method.grid, method.response), taken


@pytest.mark.parametrize("blur", [0.0, 1.2])
@pytest.mark.parametrize("spec", [Checkerboard(), Checkerboard(shifts=4, shift=4), RandomBinary()])
def test_read_and_shot_noise_are_told_whatever_the_blur(
    spec: Checkerboard | RandomBinary, blur: float
) -> None:
    followed, taken = frames(spec, Scene(blur=blur, leakage=0.06, ambient=0.02, change=Shot()))
    for index, frame in enumerate(taken):
        followed.add(frame, index)
    noise = followed.noise(followed.light(), average=1)
    assert noise is not None
    for quantile in (0.1, 0.5, 0.9):  # of unlit light, of both, of lit light
        level = float(np.quantile(taken, quantile))
        true = np.hypot(READ * FULL, np.sqrt(level * FULL / ELECTRONS))
        assert float(noise.deviation(np.array([level]))[0]) == pytest.approx(true, rel=0.08)


def test_a_frame_in_another_s_place_is_no_noise() -> None:
    followed, taken = frames(Checkerboard(), Scene(sigma=0.004))
    for index, frame in enumerate(taken):
        followed.add(taken[11] if index == 12 else frame, index)
    assert followed.noise(followed.light(), average=1) is None


def test_a_row_of_shifts_that_lacks_one_is_left_out() -> None:
    followed, taken = frames(Checkerboard(), Scene(sigma=0.01))
    for index, frame in enumerate(taken):
        if index != 7:
            followed.add(frame, index)
    noise = followed.noise(followed.light(), average=1)
    assert noise is not None
    assert noise.typical == pytest.approx(0.01 * FULL, rel=0.08)


def test_a_few_patterns_tell_nothing() -> None:
    followed, taken = frames(Checkerboard(), Scene(sigma=0.01))
    for index, frame in enumerate(taken[:7]):
        followed.add(frame, index)
    assert followed.noise(followed.light(), average=1) is None


def test_what_was_looked_at_early_is_the_same_whenever_a_result_is_asked_for() -> None:
    scene = Scene(sigma=0.01)
    method = catalog.method_for(Checkerboard(references=()), scene.bench())
    _, taken = frames(Checkerboard(references=()), scene)
    found = []
    for asked in ({10, 19, 20, 24}, set[int]()):
        estimator = method.estimator()
        for index, frame in enumerate(taken):
            estimator.update(frame, Observation(pattern=index))
            if index in asked:
                estimator.result()
        result = estimator.result()
        assert isinstance(result, Components)
        assert result.facts["mirrors_looked_for"]
        assert result.facts["noise_from"] == "residuals of the fit"
        found.append(result)
    one, other = found
    assert one.direct.tobytes() == other.direct.tobytes()
    assert one.global_.tobytes() == other.global_.tobytes()
    assert one.quality.tobytes() == other.quality.tobytes()
