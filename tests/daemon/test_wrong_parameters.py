"""A scan that was declared wrongly, or whose light was not what it should be, says so."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.scans import catalog
from daemon.scans.method import Expose, Unsuitable
from daemon.separation.estimator import Components, Lighting, Quality
from daemon.separation.frameset import UNCHECKED
from protocol.scans.anyscan import AnyScan, AnySeparation
from protocol.scans.projected import (
    Checkerboard,
    GrayCode,
    RandomBinary,
    RandomPhase,
    Sinusoid,
    TwoImage,
)
from protocol.scans.spec import Radiometry, Reference
from tests.daemon.scanning import declared
from tests.daemon.scene import Scene

LIGHT = Radiometry(leakage=0.02)
SCENE = Scene(sigma=0.005, leakage=0.02, blur=0.5, ambient=0.02)
REFERENCES = (Reference.BLACK, Reference.WHITE)


def _taken(spec: AnyScan, scene: Scene = SCENE) -> list[NDArray[np.uint16]]:
    """The frames of a scan, one after the other."""
    rng = np.random.default_rng(5)
    method = catalog.method_for(spec, scene.bench())
    frames: list[NDArray[np.uint16]] = []
    while (step := method.step(len(frames), {})) is not None:
        assert isinstance(step, Expose)
        frames.append(scene.frame(step, rng))
    return frames


def _says(components: Components, words: str) -> bool:
    return any(words in line for line in components.facts["advice"])


RIGHT: list[AnySeparation] = [
    Checkerboard(radiometry=LIGHT),
    Checkerboard(estimator="maxmin", radiometry=LIGHT),
    RandomBinary(radiometry=LIGHT),
    RandomBinary(estimator="maxmin", radiometry=LIGHT),
    TwoImage(radiometry=LIGHT),
    GrayCode(radiometry=LIGHT),
    RandomPhase(radiometry=LIGHT),
    Sinusoid(phases=3, radiometry=LIGHT),
    Sinusoid(phases=8, radiometry=LIGHT),
    Sinusoid(phases=5, periods=(12, 20), radiometry=LIGHT),
]


@pytest.mark.parametrize("spec", RIGHT)
@pytest.mark.parametrize("sigma", [0.002, 0.02])
def test_a_scan_as_declared_is_told_nothing(spec: AnySeparation, sigma: float) -> None:
    scene = Scene(sigma=sigma, leakage=0.02, blur=0.5, ambient=0.02)
    components = scene.scan(spec)
    assert components.facts["advice"] == []
    wrong = Quality.RESIDUE | Quality.MOVED | Quality.DISAGREE | Quality.NEGATIVE
    assert np.mean(components.quality & np.uint16(wrong) != 0) < 0.001


@pytest.mark.parametrize(
    ("phases", "periods"),
    [
        (12, (16.0, 20.0)),
        (8, (16.0, 20.0, 24.0)),
        (6, (16.0, 20.0, 24.0, 28.0)),
        (4, tuple(16.0 + 2 * n for n in range(6))),
        (3, tuple(16.0 + n for n in range(8))),
    ],
)
def test_24_phases_are_not_several_periods(phases: int, periods: tuple[float, ...]) -> None:
    frames = _taken(Sinusoid(phases=24, references=(), radiometry=LIGHT))
    wrong = Sinusoid(phases=phases, periods=periods, radiometry=LIGHT)
    assert _says(declared(wrong, frames), "--phases, --periods")


def test_24_phases_are_not_8_of_2_periods_for_their_number() -> None:
    frames = _taken(Sinusoid(phases=24, references=(), radiometry=LIGHT))
    with pytest.raises(Unsuitable, match=r"has 24 images; 8 phases x 2 periods need 16"):
        declared(Sinusoid(phases=8, periods=(16, 20), radiometry=LIGHT), frames)


def test_a_checkerboard_is_no_sinusoid_and_the_reverse() -> None:
    checkers = _taken(Checkerboard(references=(), radiometry=LIGHT))
    assert _says(declared(Sinusoid(phases=25, radiometry=LIGHT), checkers), "from a sinusoid")
    waves = _taken(Sinusoid(phases=25, references=(), radiometry=LIGHT))
    assert _says(declared(Checkerboard(radiometry=LIGHT), waves), "not the shifts")


@pytest.mark.parametrize(
    "spec",
    [
        RandomBinary(patterns=8, radiometry=LIGHT),
        RandomBinary(patterns=20, radiometry=LIGHT),
        RandomBinary(patterns=20, estimator="maxmin", radiometry=LIGHT),
    ],
)
def test_a_sinusoid_is_no_random_patches(spec: RandomBinary) -> None:
    waves = _taken(Sinusoid(phases=spec.patterns, references=(), radiometry=LIGHT))
    assert _says(declared(spec, waves), "no patterns of lit and unlit")


def test_shifts_in_another_order_are_told() -> None:
    checkers = _taken(Checkerboard(references=(), radiometry=LIGHT))
    order = np.random.default_rng(2).permutation(25)
    found = declared(Checkerboard(radiometry=LIGHT), [checkers[n] for n in order])
    assert _says(found, "in their order")
    columns_first = [checkers[5 * (n % 5) + n // 5] for n in range(25)]
    found = declared(Checkerboard(radiometry=LIGHT), columns_first)
    assert found.facts["advice"] == [UNCHECKED]


@pytest.mark.parametrize("phases", [3, 4, 8])
@pytest.mark.parametrize("references", [(), REFERENCES])
def test_a_projector_of_gamma_2_2_is_told(phases: int, references: tuple[Reference, ...]) -> None:
    scene = Scene(sigma=0.005, leakage=0.02, blur=0.5, ambient=0.02, gamma=2.2)
    for spec in (Sinusoid, RandomPhase):
        found = scene.scan(spec(phases=phases, references=references, radiometry=LIGHT))
        assert _says(found, "tone curve")


@pytest.mark.parametrize("spec", RIGHT)
def test_an_exposure_that_saturates_is_told(spec: AnySeparation) -> None:
    def longer(light: NDArray[Any], step: Expose) -> NDArray[Any]:
        del step
        return light * 2.5

    found = Scene(sigma=0.005, leakage=0.02, blur=0.5, change=longer).scan(spec)
    assert _says(found, "saturated")
    assert np.mean(found.quality & np.uint16(Quality.SATURATED) != 0) > 0.05


@pytest.mark.parametrize("spec", RIGHT)
def test_too_large_a_leakage_is_told(spec: AnySeparation) -> None:
    wrong = msgspec.structs.replace(spec, radiometry=Radiometry(leakage=0.25))
    assert _says(SCENE.scan(wrong), "leakage 0.25 cannot be")


@pytest.mark.parametrize("spec", [RIGHT[0], RIGHT[4], RIGHT[8]])
def test_leakage_that_was_not_given_is_told_where_nothing_else_is_in_black(
    spec: AnySeparation,
) -> None:
    wrong = msgspec.structs.replace(spec, radiometry=Radiometry(leakage=0.0))
    found = Scene(sigma=0.002, leakage=0.08, blur=0.5).scan(wrong)
    assert _says(found, "as leakage does")


@pytest.mark.parametrize("spec", RIGHT)
def test_what_moved_after_the_references_is_flagged(spec: AnySeparation) -> None:
    def moved(light: NDArray[Any], step: Expose) -> NDArray[Any]:
        if step.lighting is Lighting.PATTERN:
            light = light.copy()
            light[30:50, 30:60] *= 1.6
        return light

    found = Scene(sigma=0.005, leakage=0.02, blur=0.5, change=moved).scan(spec)
    flagged = (found.quality & np.uint16(Quality.MOVED)) != 0
    assert flagged[32:48, 32:58].mean() > 0.95
    flagged[28:52, 28:62] = False
    assert flagged.mean() < 0.001


@pytest.mark.parametrize("spec", RIGHT)
def test_a_source_that_drifted_is_told(spec: AnySeparation) -> None:
    def dimmer(light: NDArray[Any], step: Expose) -> NDArray[Any]:
        return light * 0.93 if step.lighting is Lighting.PATTERN else light

    found = Scene(sigma=0.005, leakage=0.02, blur=0.5, change=dimmer).scan(spec)
    assert _says(found, "drifted")


@pytest.mark.parametrize("spec", RIGHT)
def test_what_the_projector_does_not_reach_is_dark_or_flat_and_not_more(
    spec: AnySeparation,
) -> None:
    def beyond(light: NDArray[Any], step: Expose) -> NDArray[Any]:
        del step
        light = light.copy()
        light[:, 96:] = 0.1 * 65535  # ambient light alone
        return light

    found = Scene(sigma=0.005, leakage=0.02, blur=0.5, change=beyond).scan(spec)
    outside = found.quality[:, 100:]
    flat = np.uint16(Quality.LOW_MODULATION | Quality.DARK)
    assert np.mean(outside & flat != 0) > 0.95
    never = Quality.NEVER_LIT | Quality.NEVER_UNLIT | Quality.MOVED | Quality.RESIDUE
    assert not np.any(outside & np.uint16(never | Quality.DISAGREE))
