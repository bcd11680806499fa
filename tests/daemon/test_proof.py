"""Proof of step: what a frame looks like against what was shown."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.exposing.proof import Proof, head_problem, look_of
from daemon.patterns import render
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


class Torn(Scene):
    """Rows from `row` on, or up to it, are of another image."""

    def torn(self, upper: AnyPattern, lower: AnyPattern, row: int = H // 2) -> Pixels:
        return np.concatenate([self.frame(upper)[:row], self.frame(lower)[row:]])


def seen(proof: Proof, pixels: Pixels, asked: Expose) -> str:
    assert asked.pattern is not None
    return proof.problem(pixels, asked, look_of(render(asked.pattern, W, H)))


@pytest.mark.parametrize("row", [H // 4, H // 2, 3 * H // 4])
def test_a_frame_of_two_patterns_is_torn(row: int) -> None:
    scene = Torn()
    proof = begun(scene)
    for pattern in SHIFTS[:5]:
        assert judged(proof, scene, step(pattern)) == ""
    asked = step(SHIFTS[5])
    upper = seen(proof, scene.torn(SHIFTS[4], SHIFTS[5], row), asked)
    assert upper == "a frame is torn: its upper part shows the pattern before its own"
    lower = seen(proof, scene.torn(SHIFTS[5], SHIFTS[4], row), asked)
    assert lower == "a frame is torn: its lower part shows the pattern before its own"
    assert judged(proof, scene, asked) == ""  # exposed again


def test_a_pattern_torn_with_what_was_before_it() -> None:
    scene = Torn()
    proof = begun(scene)
    asked = step(SHIFTS[0])
    found = seen(proof, scene.torn(WHITE, SHIFTS[0]), asked)
    assert found == "a frame is torn: its upper part has not the light of its pattern"
    assert "lower part has not" in seen(proof, scene.torn(SHIFTS[0], BLACK), asked)
    assert judged(proof, scene, asked) == ""


def test_a_white_frame_that_the_next_pattern_cut_short() -> None:
    # Every frame of a camera whose rolling shutter nobody spoke of: black ends in white ...
    scene = Torn()
    proof = Proof()
    seen(proof, scene.torn(BLACK, WHITE), step(BLACK, Lighting.BLACK))
    found = seen(proof, scene.torn(WHITE, SHIFTS[0]), step(WHITE, Lighting.WHITE))
    assert found == "a frame is torn: its lower part is darker than in the black frame"


def test_a_torn_white_frame_is_told_by_the_patterns_after_it() -> None:
    scene = Torn()
    proof = Proof()
    judged(proof, scene, step(BLACK, Lighting.BLACK))
    seen(proof, scene.torn(BLACK, WHITE), step(WHITE, Lighting.WHITE))
    assert "upper part is brighter than in the white" in judged(proof, scene, step(SHIFTS[0]))


def test_half_a_scene_that_the_projector_does_not_reach_is_not_torn() -> None:
    scene = Scene()
    scene.albedo[: H // 2] = 0.0
    proof = begun(scene)
    assert [judged(proof, scene, step(p)) for p in SHIFTS] == [""] * len(SHIFTS)


def test_a_trial_leaves_no_trace() -> None:
    scene = Scene()
    proof = begun(scene)
    trial = proof.fork()
    for pattern in SHIFTS:
        assert judged(trial, scene, step(pattern)) == ""
    assert "the pattern before" in judged(trial, scene, step(SHIFTS[0]), shown=SHIFTS[5])
    assert judged(proof, scene, step(SHIFTS[0]), shown=SHIFTS[5]) == ""  # it never saw them


@pytest.mark.parametrize(
    ("first", "second", "late"),
    [(WHITE, BLACK, False), (None, WHITE, True), (BLACK, SHIFTS[0], True)],
)
def test_the_head_of_a_sequence(first: AnyPattern | None, second: AnyPattern, late: bool) -> None:
    scene = Scene()
    dark = (scene.rng.normal(AMBIENT, SIGMA, (H, W))).astype(np.uint16)
    white = dark if first is None else scene.frame(first)
    assert ("not in step" in head_problem(white, scene.frame(second))) is late


FULL = 4095
EXPOSURES = (None, 20_000.0, 80_000.0)


def bracketed(
    proof: Proof, scene: Scene, factor: float, asked: Expose, shown: AnyPattern | None = None
) -> str:
    assert asked.pattern is not None
    light = scene.frame(shown or asked.pattern).astype(np.float64) * factor
    counts: Pixels = np.minimum(light, FULL).astype(np.uint16)
    return proof.problem(counts, asked, look_of(render(asked.pattern, W, H)))


@pytest.mark.parametrize("longest", [4.0, 64.0])  # half of the scene is saturated; all of it
def test_exposures_of_a_bracket_are_judged_each_for_itself(longest: float) -> None:
    scene, proof = Scene(), Proof(FULL)
    factors = dict(zip(EXPOSURES, (1.0, 2.0, longest), strict=True))
    shown: list[tuple[AnyPattern, Lighting]] = [(BLACK, Lighting.BLACK), (WHITE, Lighting.WHITE)]
    shown += [(pattern, Lighting.PATTERN) for pattern in SHIFTS[:5]]
    for turn, (pattern, lighting) in enumerate(shown):
        order = EXPOSURES if turn % 2 == 0 else EXPOSURES[::-1]
        for exposure in order:
            asked = Expose(pattern, lighting, exposure_us=exposure)
            assert bracketed(proof, scene, factors[exposure], asked) == ""
    for exposure in EXPOSURES[:2]:
        asked = Expose(SHIFTS[5], exposure_us=exposure)
        before = bracketed(proof, scene, factors[exposure], asked, shown=SHIFTS[4])
        assert "the pattern before" in before
        black = bracketed(proof, scene, factors[exposure], asked, shown=BLACK)
        assert "another image was shown" in black
