"""Frames that are not what was declared, for every pattern method: said, or harmless and shown so.

The matrix of docs/theory.md, "Wrong parameters".
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.scans import catalog
from daemon.scans.method import Expose, Taken
from daemon.separation import frameset
from daemon.separation.envelope import block_mean
from daemon.separation.estimator import Components, Lighting, Observation, Quality
from daemon.separation.finish import Judgement, bits, finish
from daemon.separation.frameset import UNCHECKED, Ceiling, FrameSet
from daemon.separation.radiometry import Response
from protocol.patterns import Axis
from protocol.scans.anyscan import AnySeparation
from protocol.scans.projected import (
    Checkerboard,
    GrayCode,
    RandomBinary,
    RandomPhase,
    SingleImage,
    Sinusoid,
    TwoImage,
)
from protocol.scans.spec import Radiometry, Reference
from tests.daemon.scanning import declared
from tests.daemon.scene import Scene

Frames = list[NDArray[np.uint16]]

SIGMA = 0.005
LIGHT = Radiometry(leakage=0.02)
NONE: tuple[Reference, ...] = ()
BLACK_WHITE = (Reference.BLACK, Reference.WHITE)
BOTH = (Axis.X, Axis.Y)

METHODS: dict[str, AnySeparation] = {
    "checkerboard": Checkerboard(radiometry=LIGHT),
    "checkerboard maxmin": Checkerboard(estimator="maxmin", radiometry=LIGHT),
    "random-binary": RandomBinary(radiometry=LIGHT),
    "random-binary maxmin": RandomBinary(estimator="maxmin", radiometry=LIGHT),
    "two-image": TwoImage(radiometry=LIGHT),
    "random-phase 3": RandomPhase(radiometry=LIGHT),
    "random-phase 5": RandomPhase(phases=5, radiometry=LIGHT),
    "sinusoid 3": Sinusoid(radiometry=LIGHT),
    "sinusoid 8": Sinusoid(phases=8, radiometry=LIGHT),
    "sinusoid 5 x 2": Sinusoid(phases=5, periods=(12, 20), radiometry=LIGHT),
    "gray-code x": GrayCode(bits=7, radiometry=LIGHT),
    "gray-code x,y": GrayCode(axes=BOTH, bits=7, radiometry=LIGHT),
    "single-image": SingleImage(stripe=2, radiometry=LIGHT),
}
ALL = tuple(METHODS)
SETS = ALL[:-1]  # of more than one image
GRAY = ("gray-code x", "gray-code x,y")
ORDERLESS = ("random-binary", "random-binary maxmin", "two-image", "random-phase 3", "sinusoid 3")
ORDERED = tuple(name for name in SETS if name not in ORDERLESS)


def _scene(**given: Any) -> Scene:
    small = {"width": 96, "height": 80}
    return Scene(
        **({"sigma": SIGMA, "leakage": 0.02, "blur": 0.5, "ambient": 0.02} | small | given)
    )


@lru_cache(maxsize=64)
def _of_right_scene(name: str, references: tuple[Reference, ...]) -> tuple[Frames, Frames]:
    return _taken(msgspec.structs.replace(METHODS[name], references=references), _scene())


def _taken(spec: AnySeparation, scene: Scene) -> tuple[Frames, Frames]:
    """The frames of a scan: references, and patterns."""
    rng = np.random.default_rng(5)
    method = catalog.method_for(spec, scene.bench())
    references: Frames = []
    frames: Frames = []
    while (step := method.step(len(references) + len(frames), {})) is not None:
        assert isinstance(step, Expose)
        kind = frames if step.lighting is Lighting.PATTERN else references
        kind.append(scene.frame(step, rng))
    return references, frames


def _judged(
    name: str,
    references: tuple[Reference, ...],
    wrong: Callable[[Frames], Frames] = lambda frames: frames,
    *,
    scene: Scene | None = None,
    **changes: Any,
) -> Components:
    spec = msgspec.structs.replace(METHODS[name], references=references)
    first, frames = _taken(spec, scene) if scene else _of_right_scene(name, references)
    return declared(msgspec.structs.replace(spec, **changes), [*first, *wrong(frames)])


def _advice(components: Components) -> list[str]:
    """Without the line that references are missing, which every folder without them gets."""
    return [line for line in components.facts["advice"] if line != UNCHECKED]


def _says(components: Components, *words: str) -> bool:
    return any(word in line for line in _advice(components) for word in words)


def _error(components: Components) -> float:
    direct: NDArray[Any] = _scene().direct
    if components.direct.shape != direct.shape:
        direct = block_mean(direct.astype(np.float32), 4)
    return float(np.sqrt(np.nanmean((components.direct - direct) ** 2))) / 65535


references_or_not = pytest.mark.parametrize("references", [NONE, BLACK_WHITE])


@pytest.mark.parametrize("name", ALL)
@references_or_not
def test_right_frames_are_told_nothing(name: str, references: tuple[Reference, ...]) -> None:
    found = _judged(name, references)
    assert _advice(found) == []
    assert (UNCHECKED in found.facts["advice"]) == (not references)


def _shuffled(frames: Frames) -> Frames:
    return [frames[n] for n in np.random.default_rng(2).permutation(len(frames))]


@pytest.mark.parametrize("name", ORDERED)
@references_or_not
def test_shuffled_frames_are_told(name: str, references: tuple[Reference, ...]) -> None:
    words = ("in their order", "that were declared", "add up to light", "jump or run back")
    assert _says(_judged(name, references, _shuffled), *words)


@pytest.mark.parametrize("name", ORDERLESS)
@references_or_not
def test_an_order_that_makes_no_difference_makes_none(
    name: str, references: tuple[Reference, ...]
) -> None:
    def back(frames: Frames) -> Frames:
        return frames[::-1]

    right, wrong = _judged(name, references), _judged(name, references, back)
    assert _advice(wrong) == []
    assert _error(wrong) == pytest.approx(_error(right), abs=0.002)


@pytest.mark.parametrize("name", SETS)
@references_or_not
def test_a_folder_that_slipped_by_one_is_told_by_the_frame_at_its_end(
    name: str, references: tuple[Reference, ...]
) -> None:
    """The first pattern is missing, and at the end is one frame of something else."""

    def slipped(frames: Frames) -> Frames:
        other = (_scene().direct * 0.3).astype(np.uint16)
        return [*frames[1:], other]

    assert _advice(_judged(name, references, slipped))


@pytest.mark.parametrize("name", ["sinusoid 5 x 2", *GRAY, "checkerboard", "checkerboard maxmin"])
def test_a_set_that_begins_with_its_second_frame_is_told(name: str) -> None:
    found = _judged(name, NONE, lambda frames: [*frames[1:], frames[0]])
    assert _says(found, "declared", "add up to light")


@pytest.mark.parametrize("name", SETS)
@references_or_not
def test_a_frame_in_two_places_is_told(name: str, references: tuple[Reference, ...]) -> None:
    found = _judged(name, references, lambda frames: [frames[0], frames[0], *frames[2:]])
    assert _says(found, "pattern 2's frame is pattern 1's frame over again, bit by bit")


@pytest.mark.parametrize("name", SETS)
@references_or_not
def test_a_pattern_that_was_exposed_twice_is_told(
    name: str, references: tuple[Reference, ...]
) -> None:
    def twice(frames: Frames) -> Frames:
        noise = np.random.default_rng(9).normal(0, SIGMA * 65535, frames[0].shape)
        again = np.clip(frames[0] + noise, 0, 65535).astype(np.uint16)
        return [frames[0], again, *frames[2:]]

    words = ("hardly differ", "show no pattern", "the pattern itself shows")
    assert _says(_judged(name, references, twice), *words)


@pytest.mark.parametrize("name", SETS)
@references_or_not
def test_a_black_frame_among_the_patterns_is_told(
    name: str, references: tuple[Reference, ...]
) -> None:
    def black(frames: Frames) -> Frames:
        noise = np.random.default_rng(3).normal(1500, 300, frames[1].shape)
        return [frames[0], np.clip(noise, 0, 65535).astype(np.uint16), *frames[2:]]

    words = ("stand out by their light", "add up to light", "differ in their light")
    assert _says(_judged(name, references, black), *words)


@pytest.mark.parametrize("name", [n for n in SETS if n != "two-image"])
@references_or_not
def test_a_lamp_that_was_switched_on_during_the_scan_is_told(
    name: str, references: tuple[Reference, ...]
) -> None:
    def later(light: NDArray[Any], step: Expose) -> NDArray[Any]:
        on = step.lighting is Lighting.PATTERN and step.index >= 2
        return light + 0.05 * 65535 if on else light

    # random patches light a small scene less evenly from pattern to pattern
    found = _judged(name, references, scene=_scene(width=160, height=128, change=later))
    words = ("stand out by", "changed during the scan", "add up to light", "the pattern itself")
    assert _says(found, *words, "from a sinusoid")


@pytest.mark.parametrize("name", ALL)
def test_a_lamp_that_was_switched_on_after_the_references_is_told(name: str) -> None:
    def later(light: NDArray[Any], step: Expose) -> NDArray[Any]:
        return light + 0.05 * 65535 if step.lighting is Lighting.PATTERN else light

    found = _judged(name, BLACK_WHITE, scene=_scene(change=later))
    assert _says(found, "of the light of white", "of half the light of white")


@pytest.mark.parametrize("name", ALL)
def test_black_and_white_exchanged_is_told(name: str) -> None:
    spec = msgspec.structs.replace(METHODS[name], references=BLACK_WHITE)
    first, frames = _taken(spec, _scene())
    assert _says(declared(spec, [*first[::-1], *frames]), "brighter than the white one")


@pytest.mark.parametrize("name", ALL)
def test_linear_frames_declared_srgb_are_told_with_references(name: str) -> None:
    found = _judged(name, BLACK_WHITE, radiometry=Radiometry(leakage=0.02, tone="srgb"))
    assert _says(found, "--tone")


@pytest.mark.parametrize("name", ALL)
def test_too_large_a_leakage_is_told_with_references(name: str) -> None:
    found = _judged(name, BLACK_WHITE, radiometry=Radiometry(leakage=0.2))
    assert _says(found, "leakage 0.2 cannot be")


@pytest.mark.parametrize("name", ["checkerboard", "two-image", "sinusoid 8", "gray-code x"])
def test_a_leakage_that_is_not_given_is_bounded_by_references(name: str) -> None:
    """The room's light is .02 of full scale, white .55: K/W is .05 and more."""
    found = _judged(name, BLACK_WHITE, scene=_scene(), radiometry=Radiometry())
    assert _says(found, "leakage is taken as none, and black frames have 0.0")
    assert not _says(_judged(name, BLACK_WHITE), "leakage")


def test_a_frame_with_the_source_off_tells_the_leakage() -> None:
    every = (Reference.AMBIENT, *BLACK_WHITE)
    found = _judged("checkerboard", every, radiometry=Radiometry())
    assert _says(found, "have a leakage of 0.02")
    assert _says(_judged("checkerboard", every, radiometry=Radiometry(leakage=0.1)), "of 0.02")
    assert not _says(_judged("checkerboard", every), "leakage")


@pytest.mark.parametrize("name", ALL)
def test_too_high_a_black_level_is_told_and_harmless_with_references(name: str) -> None:
    found = _judged(name, BLACK_WHITE, radiometry=Radiometry(leakage=0.02, black=6000.0))
    assert _says(found, "black level that was given is too high")
    assert _error(found) == pytest.approx(_error(_judged(name, BLACK_WHITE)), abs=0.002)


@pytest.mark.parametrize("name", ALL)
@references_or_not
@pytest.mark.parametrize("ambient", [0.0, 0.02])
def test_a_projector_of_gamma_2_2_is_told_or_makes_no_difference(
    name: str, references: tuple[Reference, ...], ambient: float
) -> None:
    found = _judged(name, references, scene=_scene(gamma=2.2, ambient=ambient))
    if "sinusoid" in name or "phase" in name:
        assert _says(found, "tone curve")
    else:  # lit and unlit alone are shown: there is nothing to bend
        right = _judged(name, references, scene=_scene(ambient=ambient))
        assert _error(found) == pytest.approx(_error(right), abs=0.002)


@pytest.mark.parametrize("name", GRAY)
def test_gray_code_in_another_order_is_told(name: str) -> None:
    finest_first = _judged(name, NONE, lambda frames: frames[::-1])
    assert _says(finest_first, "jump or run back")
    assert np.all(finest_first.quality & np.uint16(Quality.DISAGREE) != 0)
    inverse_first = _judged(name, NONE, lambda f: [f[n ^ 1] for n in range(len(f))])
    assert _says(inverse_first, "jump or run back")


def test_gray_code_without_inverses_is_told() -> None:
    """Ten patterns of two axes declared as five bits and their inverses."""
    spec = GrayCode(axes=BOTH, bits=6, references=NONE, radiometry=LIGHT)
    _, frames = _taken(spec, _scene())
    patterns = frames[::2]
    found = declared(GrayCode(bits=6, radiometry=LIGHT), patterns)
    assert _says(found, "add up to light")


def test_stripes_of_the_other_axis_are_told() -> None:
    found = _judged("gray-code x", NONE, axes=(Axis.Y,))
    assert _says(found, "--axes")
    assert _error(found) < 0.02, "light does not depend on it"
    assert _says(_judged("single-image", NONE, axis=Axis.Y), "--axis x")


def test_two_images_of_unlike_exposure_are_told() -> None:
    def longer(frames: Frames) -> Frames:
        return [frames[0], np.clip(frames[1] * 1.4, 0, 65535).astype(np.uint16)]

    assert _says(_judged("two-image", NONE, longer), "not a pattern and its complement")


def test_white_darker_than_the_patterns_and_black_brighter_are_told() -> None:
    frames = FrameSet(Response(65535), even=True)
    method = catalog.method_for(Checkerboard(references=BLACK_WHITE), _scene().bench())
    rng = np.random.default_rng(1)
    for level, index in ((2000, 0), (9000, 1), (20_000, 2), (20_100, 3)):
        step = method.step(index, {})
        assert step is not None
        pixels = rng.integers(level - 500, level + 500, (48, 64)).astype(np.uint16)
        frames.add(pixels, method.observe(step, Taken(index, 0, incomplete=False)))
    assert any("brighter than the white frame" in line for line in frames.told()[1])


@pytest.mark.parametrize(
    ("largest", "gain", "saturation", "words"),
    [
        (4095, 0.9, None, ("no sample is above", "--depth 12")),
        (4095, 2.0, None, ("largest count of all, 4095", "--depth 12")),
        (65520, 2.0, None, ("largest count of all, 65520", "--saturation 65520")),
        (65520, 2.0, 65520.0, ()),
        (4095, 2.0, 4095.0, ()),
        (65535, 2.0, None, ()),
        (65535, 0.9, None, ()),
    ],
)
def test_a_scale_that_ends_below_16_bits_is_told(
    largest: int, gain: float, saturation: float | None, words: tuple[str, ...]
) -> None:
    ceiling = Ceiling()
    rng = np.random.default_rng(4)
    for _ in range(3):
        light = rng.normal(0.5, 0.12, (60, 80)).clip(0, 1) * gain
        ceiling.add((light.clip(0, 1) * largest).astype(np.uint16))
    told = ceiling.told(Response(65535, saturation=saturation))
    assert len(told) == (1 if words else 0)
    assert all(word in told[0] for word in words)


@pytest.mark.parametrize(
    ("limit", "edges", "words"),
    [(30.0, False, "noise hides"), (3.0, True, "edges of the pattern"), (3.0, False, "in order")],
)
def test_what_most_pixels_lack_is_named(limit: float, edges: bool, words: str) -> None:
    """Seven tenths of the pixels are lit, and have no direct light that is told from noise."""
    light = np.full((20, 30), 100.0, dtype=np.float32)
    lost = np.broadcast_to(np.arange(30) < 21, light.shape)
    found = finish(
        direct=np.where(lost, np.float32(0), np.float32(60)),
        indirect=light.copy(),
        response=Response(255),
        brightest=light,
        saturated=np.zeros(light.shape, dtype=np.bool_),
        judgement=Judgement(*(np.full_like(light, x) for x in (limit, limit, limit / 3))),
        flags=bits(lost, Quality.LOW_MODULATION) if edges else None,
        facts={},
    )
    (line,) = found.facts["advice"]
    assert "70.0% of the pixels that are lit at all cannot be separated" in line
    assert words in line


def test_what_is_known_of_frames_does_not_grow_with_their_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frameset, "_PRINTS", 8)
    known, rng = FrameSet(Response(full_scale=4095), even=True), np.random.default_rng(3)
    sizes, frames = [], []
    for count in range(80):
        frames.append(rng.integers(0, 4000, (12, 16)).astype(np.uint16))
        known.add(frames[-1], Observation(lighting=Lighting.PATTERN, pattern=count % 4))
        sizes.append(len(pickle.dumps(known)))
    assert max(sizes[40:]) < 1.05 * max(sizes[:40])
    for _ in range(3):
        known.add(frames[-2], Observation(lighting=Lighting.PATTERN, pattern=0))
    assert sum("over again, bit by bit" in line for line in known.told()[1]) == 1
