"""Specs become plans: which steps, which frames, and what is refused."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest

from daemon.scans import catalog
from daemon.scans.method import Bench, Expose, Method, Taken, Unsuitable, Watch
from daemon.separation.estimator import Components, Lighting, Quality
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.patterns import BLACK, WHITE, Checker
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import Stick
from protocol.scans.projected import Checkerboard, TwoImage
from protocol.scans.spec import Radiometry, Reference

PROJECTOR = ProjectorInfo(width=64, height=48, refresh_hz=60)


def live(projector: ProjectorInfo | None = PROJECTOR) -> Bench:
    return Bench(CameraInfo(8, 6, PixelFormat.MONO8, black_level=4.0), projector)


def recorded(images: int | None) -> Bench:
    return Bench(CameraInfo(8, 6, PixelFormat.RGB8, recorded=True, frame_count=images))


def steps(method: Method[Any]) -> list[Any]:
    found: list[Any] = []
    while (step := method.step(len(found), {})) is not None:
        found.append(step)
    return found


def test_a_live_checkerboard_takes_black_and_white_first() -> None:
    method = catalog.method_for(Checkerboard(average=2), live())
    plan = steps(method)
    assert [s.pattern for s in plan[:2]] == [BLACK, WHITE]
    assert [s.lighting for s in plan[:2]] == [Lighting.BLACK, Lighting.WHITE]
    shown = [s.pattern for s in plan[2:]]
    assert shown[:2] == [Checker(size=8), Checker(size=8, shift_x=3)]
    assert shown[-1] == Checker(size=8, shift_x=12, shift_y=12)
    assert [s.index for s in plan[2:]] == list(range(25))
    assert method.planned() == 54 == sum(s.frames for s in plan)


def test_a_recording_has_only_the_references_that_are_named() -> None:
    assert len(steps(catalog.method_for(Checkerboard(), recorded(25)))) == 25
    spec = Checkerboard(references=(Reference.AMBIENT,), average=2)
    plan = steps(catalog.method_for(spec, recorded(51)))
    assert plan[0] == Expose(None, Lighting.AMBIENT, frames=1)


def test_a_folder_of_another_size_is_refused_with_the_remedy() -> None:
    with pytest.raises(Unsuitable) as refused:
        catalog.method_for(Checkerboard(), recorded(24))
    said = str(refused.value)
    assert said == "the folder has 24 images; 5 x 5 shifts need 25 (set --shifts)"
    with pytest.raises(Unsuitable, match=r"a pattern and its complement, with black first need 3"):
        catalog.method_for(TwoImage(references=(Reference.BLACK,)), recorded(2))


def test_the_last_frame_of_a_pattern_is_marked_and_an_incomplete_one_not_used() -> None:
    method = catalog.method_for(Checkerboard(average=3, references=()), live())
    step = method.step(4, {})
    assert isinstance(step, Expose)
    seen = [method.observe(step, Taken(4, sub, incomplete=sub == 1)) for sub in range(3)]
    assert [o.last for o in seen] == [False, False, True]
    assert [o.used for o in seen] == [True, False, True]
    assert {o.pattern for o in seen} == {4}
    assert seen[1].reason == "incomplete frame"


@pytest.mark.parametrize(
    "spec",
    [
        Checkerboard(checker=8, shift=16),  # every shift is the same picture
        Checkerboard(checker=8, shift=1, shifts=5),  # a checker's middle never changes
    ],
)
def test_shifts_that_leave_pixels_unlit_are_refused(spec: Checkerboard) -> None:
    with pytest.raises(Unsuitable, match="never both light and shade"):
        catalog.method_for(spec, live())


def test_shifts_that_cover_are_taken() -> None:
    for spec in (Checkerboard(), Checkerboard(checker=8, shift=8, shifts=2)):
        catalog.method_for(spec, live())


@pytest.mark.parametrize("spec", [Checkerboard(), TwoImage()])
def test_a_rig_without_a_projector_is_told_so(spec: AnyScan) -> None:
    with pytest.raises(Unsuitable, match="needs a projector"):
        catalog.method_for(spec, live(None))


def test_two_images_need_a_lit_fraction_below_one() -> None:
    with pytest.raises(Unsuitable, match="lit fraction 1 "):
        catalog.method_for(TwoImage(lit_fraction=1.0), recorded(2))


def test_alpha_is_the_patterns_own_on_this_projector() -> None:
    odd = ProjectorInfo(width=3, height=1, refresh_hz=60)
    method = catalog.method_for(TwoImage(checker=1, references=()), live(odd))
    estimator = method.estimator()
    for index, level in enumerate((200, 90)):
        step = method.step(index, {})
        assert step is not None
        frame = np.full((6, 8), level, dtype=np.uint8)
        estimator.update(frame, method.observe(step, Taken(index, 0, incomplete=False)))
    found = estimator.result()
    assert found.facts["lit_fraction"] == pytest.approx(2 / 3)
    assert found.facts["black_level"] == 4.0


def test_calibration_is_used_unless_the_spec_says_otherwise() -> None:
    bench = Bench(
        CameraInfo(8, 6, PixelFormat.MONO8), PROJECTOR, calibration={"leakage": 0.07, "black": 9.0}
    )
    for radiometry, leakage, black in (
        (Radiometry(), 0.07, 9.0),
        (Radiometry(leakage=0.0, black=1.0), 0.0, 1.0),
    ):
        method = catalog.method_for(Checkerboard(references=(), radiometry=radiometry), bench)
        estimator = method.estimator()
        for index in range(2):
            step = method.step(index, {})
            assert step is not None
            frame = np.full((6, 8), 50 * (index + 1), dtype=np.uint8)
            estimator.update(frame, method.observe(step, Taken(index, 0, incomplete=False)))
        facts = estimator.result().facts
        assert (facts["leakage"], facts["black_level"]) == (leakage, black)


def test_a_stick_is_watched_to_the_end_of_the_recording() -> None:
    method = catalog.method_for(Stick(), recorded(166))
    assert steps(method) == [Watch(166)]
    assert method.planned() == 166
    assert steps(catalog.method_for(Stick(), recorded(None))) == [Watch(None)]
    assert steps(catalog.method_for(Stick(frames=40), live(None))) == [Watch(40)]


@pytest.mark.parametrize(("width_mm", "leak"), [(None, None), (3.0, 0.0), (0.5, 0.6602)])
def test_a_stick_thinner_than_the_penumbra_is_told(
    width_mm: float | None, leak: float | None
) -> None:
    spec = Stick(width_mm=width_mm, scene_mm=200.0)
    method = catalog.method_for(spec, recorded(166))
    plane = np.zeros((2, 2), np.float32)
    facts = {"advice": ["look"]}
    found = method.conclude(Components(plane, plane, plane.astype(np.uint16), {}, facts)).facts
    assert found.get("leakage_at_most") == (leak if leak is None else pytest.approx(leak, abs=1e-3))
    assert ("not known" in found["leakage_from"]) == (leak is None)
    assert found["advice"][0] == "look"
    assert any("shines past the stick" in line for line in found["advice"]) == bool(leak)


@pytest.mark.parametrize(
    ("spec", "bench", "said"),
    [
        (Stick(), recorded(1), "has 1 frames of the stick, and 2 are needed"),
        (Stick(frames=1), live(None), "2 frames at least"),
        (Stick(), live(None), "say how many frames"),
        (Stick(references=(Reference.WHITE,)), recorded(9), "no black or white"),
        (Stick(radiometry=Radiometry(leakage=0.1)), recorded(9), "umbra"),
        (Stick(radiometry=Radiometry(black=255.0)), recorded(9), "black level"),
    ],
)
def test_a_stick_that_cannot_be(spec: Stick, bench: Bench, said: str) -> None:
    with pytest.raises(Unsuitable, match=said):
        catalog.method_for(spec, bench)


@pytest.mark.parametrize(
    ("spec", "frames", "told"),
    [(TwoImage(), 2, True), (TwoImage(bracket=(1.0, 4.0)), 4, False), (Stick(), 9, False)],
)
def test_a_bracket_is_advised_where_there_can_be_one(
    spec: AnyScan, frames: int, told: bool
) -> None:
    plane = np.zeros((2, 2), np.float32)
    clipped = np.full((2, 2), np.uint16(Quality.SATURATED))
    method = catalog.method_for(spec, recorded(frames))
    found = method.conclude(Components(plane, plane, clipped, {}, {})).facts
    assert any("--bracket" in line for line in found.get("advice", ())) == told


def test_names() -> None:
    tags = {kind.__struct_config__.tag for kind in get_args(AnyScan)}
    assert set(catalog.NAMES) == tags
