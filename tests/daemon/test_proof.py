"""Proof of step: what a frame looks like against what was shown."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.patterns import render
from daemon.proof import Proof, look_of
from daemon.scans.method import Expose
from daemon.separation.estimator import Lighting
from protocol.patterns import BLACK, WHITE, AnyPattern, Checker, GrayCode, Solid

W, H = 96, 72
AMBIENT, DIRECT, GLOBAL, SIGMA = 200.0, 900.0, 500.0, 12.0
SHIFTS = [Checker(size=8, shift_x=3 * n) for n in range(6)]

Pixels = NDArray[np.uint16]


class Scene:
    """Uneven reflectance, global light at the mean of what is shown, noise."""

    def __init__(self, direct: float = DIRECT) -> None:
        self.rng = np.random.default_rng(5)
        self.albedo = self.rng.uniform(0.2, 1.0, (H, W))
        self.direct = direct

    def frame(self, shown: AnyPattern) -> Pixels:
        light = render(shown, W, H) / 255
        counts = AMBIENT + self.albedo * (self.direct * light + GLOBAL * light.mean())
        noisy: Pixels = (counts + self.rng.normal(0, SIGMA, counts.shape)).astype(np.uint16)
        return noisy


def step(pattern: AnyPattern, lighting: Lighting = Lighting.PATTERN) -> Expose:
    return Expose(pattern, lighting)


def judged(proof: Proof, scene: Scene, asked: Expose, shown: AnyPattern | None = None) -> str:
    assert asked.pattern is not None
    look = look_of(render(asked.pattern, W, H))
    return proof.problem(scene.frame(shown or asked.pattern), asked, look)


def begun(scene: Scene) -> Proof:
    proof = Proof()
    assert judged(proof, scene, step(BLACK, Lighting.BLACK)) == ""
    assert judged(proof, scene, step(WHITE, Lighting.WHITE)) == ""
    return proof


@pytest.mark.parametrize("direct", [DIRECT, 0.0])
def test_a_scan_in_step_passes(direct: float) -> None:
    scene = Scene(direct)  # without direct light all patterns look alike, and that is all right
    proof = begun(scene)
    assert [judged(proof, scene, step(p)) for p in SHIFTS] == [""] * len(SHIFTS)


def test_white_that_is_still_black() -> None:
    scene = Scene()
    proof = Proof()
    judged(proof, scene, step(BLACK, Lighting.BLACK))
    asked = step(WHITE, Lighting.WHITE)
    assert "not brighter" in judged(proof, scene, asked, shown=BLACK)
    assert judged(proof, scene, asked) == ""  # exposed again


@pytest.mark.parametrize("shown", [BLACK, WHITE])
def test_a_pattern_that_never_came(shown: Solid) -> None:
    scene = Scene()
    proof = begun(scene)
    assert "another image was shown" in judged(proof, scene, step(SHIFTS[0]), shown=shown)


def test_the_pattern_before() -> None:
    scene = Scene()
    proof = begun(scene)
    for pattern in SHIFTS[:5]:
        assert judged(proof, scene, step(pattern)) == ""
    assert "the pattern before" in judged(proof, scene, step(SHIFTS[5]), shown=SHIFTS[4])
    assert judged(proof, scene, step(SHIFTS[5])) == ""


def test_frames_averaged_of_one_pattern_are_alike_and_may_be() -> None:
    scene = Scene()
    proof = begun(scene)
    for pattern in SHIFTS:
        assert [judged(proof, scene, step(pattern)) for _ in range(3)] == [""] * 3


def test_a_coarse_pattern_says_nothing_of_the_level() -> None:
    scene = Scene()
    scene.albedo[:, : W // 2] = 0.01  # all that reflects is in one half
    proof = begun(scene)
    for bit in range(4):
        for inverted in (False, True):
            asked = step(GrayCode(bit=bit, inverted=inverted))
            assert judged(proof, scene, asked) == ""
