"""A run made from another's frames: the same bits, other numbers, and what is refused."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import config
from daemon.products import separated
from daemon.runs import aftermath
from daemon.runs.reprocessing import Reprocessing, method_of
from daemon.runs.reprocessor import Reprocessor
from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Expose, Method, Step, Taken
from daemon.separation.estimator import Components, Observation
from daemon.storage.frames import FrameRecord, FrameStore
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from drivers.base.stage import StageInfo
from protocol.errors import Code, UmbraError
from protocol.messages.commands import Reprocess
from protocol.messages.events import AnyEvent, Progressed
from protocol.messages.runs import Product, RunState
from protocol.scans.anyscan import AnyScan
from protocol.scans.calibrations import CalibrateLeak
from protocol.scans.occluded import Mesh, Stick
from protocol.scans.projected import Checkerboard, GrayCode, SingleImage, Sinusoid, TwoImage
from protocol.scans.spec import Radiometry

Frames = Iterable[NDArray[Any] | None]

BENCH = Bench(
    CameraInfo(64, 48, PixelFormat.BAYER_RG12, black_level=63.0),
    ProjectorInfo(64, 48, 60.0),
    exposure_us=5000.0,
    gain=1.0,
)
PLAIN = Checkerboard(checker=4, shift=2, estimator="maxmin")
VALUES: dict[str, Any] = {"latency_s": 0.03, "black": 64.0}
CALIBRATION: dict[str, Any] = {"values": VALUES, "sources": {}, "ignored": []}
CONFIG = config.parse('camera = {driver = "virtual"}\n', "test")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "data", reserve_bytes=0) as made:
        yield made


def reprocessor(store: Store, publish: Callable[[AnyEvent], None] = lambda _: None) -> Reprocessor:
    return Reprocessor(store=store, config=CONFIG, publish=publish, busy=lambda: False)


def noise(count: int, missing: Iterable[int] = ()) -> Frames:
    rng = np.random.default_rng(1)
    for index in range(count):
        pixels = rng.integers(100, 3000, (48, 64), dtype=np.uint16)
        yield None if index in missing else pixels


def steps_of(method: Method[Any]) -> Iterator[tuple[int, int, Step]]:
    """The frames of a plan: step, sub-index."""
    for index in range(1000):
        step = method.step(index, {})
        if step is None:
            return
        for sub in range(getattr(step, "frames", None) or 10_000):
            yield index, sub, step


def parent_of(
    store: Store,
    spec: AnyScan,
    frames: Frames,
    *,
    bench: Bench = BENCH,
    state: RunState = RunState.DONE,
    torn: Iterable[int] = (),
    pixels: bool = True,
) -> RunFolder:
    """A run as a course leaves it: frames, records, products."""
    method = method_for(spec, replace(bench, calibration=VALUES))
    estimator = method.estimator()
    camera = bench.camera
    run = store.create(
        spec, {"settings": {}}, bench=bench.recorded(), calibration=CALIBRATION, planned=None
    )
    frames = list(frames)
    method.foresee(picture for picture in frames if picture is not None)
    kept = FrameStore.create(run.path, camera.shape, camera.pixel_format.dtype, pixels=pixels)
    for index, (picture, (number, sub, step)) in enumerate(
        zip(frames, steps_of(method), strict=False)
    ):
        gone = picture is None
        incomplete = gone or index in torn
        taken = Taken(step=number, sub=sub, incomplete=incomplete, pixels=picture)
        observation = method.observe(step, taken)
        record = FrameRecord(
            index=index,
            step=number,
            sub=sub,
            pattern=step.pattern if isinstance(step, Expose) else None,
            observation=observation,
            missing="the camera gave none" if gone else "",
        )
        if picture is None:
            kept.append_missing(record)
        else:
            kept.append(picture, record)
            estimator.update(picture, observation)
    kept.commit()
    kept.close()
    result = estimator.result()
    assert isinstance(result, Components)
    made = separated.write(
        run,
        method.conclude(result),
        full_scale=camera.pixel_format.full_scale,
        pixel_format=camera.pixel_format,
    )
    run.add_products(made)
    run.update(state=state, ended="2026-01-01T00:00:00+00:00")
    return run


def asked(run: RunFolder, **changes: Any) -> Reprocess:
    return Reprocess(run=run.id, changes=msgspec.to_builtins(changes))


def reprocessed(store: Store, run: RunFolder, **changes: Any) -> RunFolder:
    """To its end, in this thread."""
    made = reprocessor(store).submit(asked(run, **changes), "me", "")
    executed(store, made)
    return made


def executed(store: Store, made: RunFolder) -> None:
    Reprocessing(
        made, store=store, busy=lambda: False, on_change=lambda: None, on_progress=lambda _: None
    ).execute()


def same(one: RunFolder, other: RunFolder) -> bool:
    files = ("direct.tiff", "global.tiff", "quality.png", "quality.json", "preview.png")
    return all((one.path / f).read_bytes() == (other.path / f).read_bytes() for f in files)


# ---------------------------------------------------------------- the same again


@pytest.mark.parametrize(
    ("spec", "count"),
    [
        (Checkerboard(checker=4, shift=2, average=2), 54),
        (TwoImage(), 4),
        (Sinusoid(periods=(8.0, 16.0)), 8),
        (GrayCode(), 14),
        (SingleImage(stripe=2, repeat=3), 5),
    ],
    ids=lambda value: getattr(type(value), "__name__", ""),
)
def test_nothing_changed_is_the_same_to_the_bit(store: Store, spec: AnyScan, count: int) -> None:
    parent = parent_of(store, spec, noise(count))
    again = reprocessed(store, parent)
    assert again.file.state is RunState.DONE, again.file.end
    assert again.file.parents == (parent.id,)
    assert again.file.recorded == count
    assert again.file.rig == parent.file.rig
    assert again.file.calibration == CALIBRATION
    assert same(parent, again)


def test_frames_that_are_missing_or_torn_are_so_again(store: Store) -> None:
    spec = msgspec.structs.replace(PLAIN, average=2)
    parent = parent_of(store, spec, noise(54, missing=[7, 30]), torn=[9, 40])
    again = reprocessed(store, parent)
    assert again.file.state is RunState.DONE
    assert (again.file.recorded, again.file.missing, again.file.rejected) == (52, 2, 2)
    assert same(parent, again)


def test_a_pattern_without_any_frame_ends_as_in_the_parent(store: Store) -> None:
    parent = parent_of(store, PLAIN, noise(27, missing=[7]))
    end = reprocessed(store, parent).file.end
    assert end is not None
    assert (end.state, end.code) == (RunState.FAILED, Code.FRAMES_MISSING)
    assert "1 of the patterns (5)" in end.reason


def test_a_run_that_was_aborted_gives_what_its_frames_give(store: Store) -> None:
    parent = parent_of(store, PLAIN, noise(20), state=RunState.ABORTED)
    again = reprocessed(store, parent)
    assert again.file.state is RunState.DONE
    assert same(parent, again)


# ---------------------------------------------------------------- otherwise


def test_changed_numbers_are_what_a_scan_with_them_would_have_given(store: Store) -> None:
    wrong = Checkerboard(checker=4, shift=2)
    right = Checkerboard(
        checker=4, shift=2, estimator="maxmin", lit_fraction=0.4,
        radiometry=Radiometry(black=80.0, leakage=0.03, tone="gamma:1.2", saturation=2900.0),
    )  # fmt: skip
    parent = parent_of(store, wrong, noise(27))
    wanted = parent_of(store, right, noise(27))
    changes = {"estimator": "maxmin", "lit_fraction": 0.4, "black": 80.0, "leakage": 0.03}
    again = reprocessed(store, parent, **changes, tone="gamma:1.2", saturation=2900.0)
    assert again.file.spec == right
    assert same(wanted, again)
    assert not same(parent, again)
    back = reprocessed(store, again, **{**dict.fromkeys(("lit_fraction", "black", "leakage"))},
                       estimator="auto", tone="linear", saturation=None)  # fmt: skip
    assert back.file.parents == (again.id, parent.id)
    assert same(parent, back)


def test_todays_calibration_is_applied_where_it_is_asked_for(store: Store) -> None:
    parent = parent_of(store, PLAIN, noise(27))
    leak = store.create(CalibrateLeak(), {"settings": {}})
    (leak.path / "calibration.json").write_text(
        '{"values": {"leakage": 0.05, "latency_s": 9, "tone": [1]}}'
    )
    product = Product(name="calibration", kind="facts", file="calibration.json")
    leak.update(state=RunState.DONE, ended="2999-01-01T00:00:00+00:00", products=(product,))
    rig = {name: {"driver": "d", "model": "m"} for name in ("camera", "projector")}
    for run in (parent, leak):
        run.update(rig={**rig, "settings": {}})
    lane = reprocessor(store)
    now = Reprocess(run=parent.id, calibration="now")
    found = lane.submit(now, "me", "").file.calibration
    assert found is not None
    # what was applied when the patterns were shown stays, black is not calibrated any more
    assert found["values"] == {"leakage": 0.05, "latency_s": 0.03}
    assert found["sources"]["leak"]["run"] == leak.id
    assert lane.submit(asked(parent), "me", "").file.calibration == CALIBRATION


# ---------------------------------------------------------------- occluders


WIDTH, HEIGHT = 224, 168
OUTDOORS = Bench(
    CameraInfo(WIDTH, HEIGHT, PixelFormat.MONO12, black_level=63.0, triggers=("none",)),
    stage=StageInfo(((0, 500), (0, 300)), 200.0),
    lights=("sun",),
)


@pytest.fixture(scope="module")
def film() -> list[NDArray[Any]]:
    """A mesh that goes round under a sun which dims in the end, before a camera that is nudged."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.random((HEIGHT, WIDTH)), (0, 0), 2)
    albedo = 0.3 + 0.7 * (texture - texture.min()) / np.ptp(texture)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    shots = []
    for k in range(62):
        turn = math.tau * k / 25
        hole = np.hypot((x + 18 * math.cos(turn)) % 20 - 10, (y + 18 * math.sin(turn)) % 20 - 10)
        light = albedo * (1500 * (hole < 6.25) + 300) * (0.93 if k > 51 else 1.0)
        light = np.roll(light, 2 if k > 55 else 0, axis=1) + rng.normal(0, 6, light.shape)
        shots.append(np.rint(64 + light).astype(np.uint16))
    return shots


def decisions(run: RunFolder) -> list[Observation]:
    return [record.observation for record in FrameStore.open(run.path, readonly=True).records()]


SUNNY = Mesh(hole_mm=12.5, pitch_mm=20.0, sun=True, scene_mm=150.0)


def test_a_mesh_is_the_same_again_with_the_decisions_that_were_recorded(
    store: Store, film: list[NDArray[Any]]
) -> None:
    parent = parent_of(store, SUNNY, [None, *film], bench=OUTDOORS, torn=[11])
    again = reprocessed(store, parent)
    assert decisions(again) == decisions(parent)
    assert len({o.strength for o in decisions(parent)}) > 1
    assert any(o.warp for o in decisions(parent))
    assert same(parent, again)


def test_another_hole_fraction_keeps_the_decisions_and_the_circle(
    store: Store, film: list[NDArray[Any]]
) -> None:
    parent = parent_of(store, SUNNY, film, bench=OUTDOORS)
    wanted = parent_of(
        store, msgspec.structs.replace(SUNNY, hole_fraction=0.25), film, bench=OUTDOORS
    )
    again = reprocessed(store, parent, hole_fraction=0.25)
    assert decisions(again) == decisions(parent)
    assert same(wanted, again)
    method, anew = method_of(again.file, parent.file)
    assert not anew
    then, _ = method_of(parent.file, parent.file)
    assert method.step(0, {}) == then.step(0, {})
    coarse = reprocessor(store).submit(asked(parent, pitch_mm=30.0), "me", "")
    method, anew = method_of(coarse.file, parent.file)
    assert method.step(0, {}) == then.step(0, {})  # not the circle that would be planned now
    assert any("18 mm leaves points" in line for line in method.warnings)  # type: ignore[attr-defined]


@pytest.mark.parametrize("changes", [{"sun": False}, {"align": False}, {"black": 10.0}], ids=str)
def test_what_the_decisions_depend_on_has_them_made_again(
    store: Store, film: list[NDArray[Any]], changes: dict[str, Any]
) -> None:
    parent = parent_of(store, SUNNY, [None, *film], bench=OUTDOORS, torn=[11])
    again = reprocessed(store, parent, **changes)
    wanted = parent_of(store, again.file.spec, [None, *film], bench=OUTDOORS, torn=[11])
    assert decisions(again) == decisions(wanted)
    assert decisions(again) != decisions(parent)
    assert same(wanted, again)


def test_a_stick_by_hand_is_the_same_again(store: Store, film: list[NDArray[Any]]) -> None:
    by_hand = Bench(OUTDOORS.camera)
    parent = parent_of(store, Stick(frames=30), film[:30], bench=by_hand)
    assert same(parent, reprocessed(store, parent))


def test_a_recording_that_shakes_from_the_beginning_is_the_same_again(
    store: Store, film: list[NDArray[Any]]
) -> None:
    rng = np.random.default_rng(6)
    shots = [
        np.ascontiguousarray(np.roll(shot, rng.integers(-2, 3, 2), (0, 1))[8:160, 8:216])
        for shot in film[:50]
    ]
    camera = CameraInfo(
        208, 152, PixelFormat.MONO12, black_level=63.0, recorded=True, frame_count=len(shots)
    )
    parent = parent_of(store, Mesh(hole_mm=12.5, pitch_mm=20.0), shots, bench=Bench(camera))
    assert sum(o.warp is not None for o in decisions(parent)) > 30
    again = reprocessed(store, parent)
    assert decisions(again) == decisions(parent)
    assert same(parent, again)


# ---------------------------------------------------------------- what goes wrong


def refusal(store: Store, run: RunFolder, **changes: Any) -> UmbraError:
    with pytest.raises(UmbraError) as caught:
        reprocessor(store).submit(asked(run, **changes), "me", "")
    assert store.to_reprocess() == []
    return caught.value


def test_runs_that_cannot_be_read_again_are_refused_with_the_remedy(store: Store) -> None:
    parent = parent_of(store, TwoImage(), noise(4))
    assert "no estimator topk" in refusal(store, parent, estimator="topk").message
    error = refusal(store, parent, checker=4)
    assert (error.code, error.where) == (Code.UNSUITABLE, "$.changes.checker")
    bare = parent_of(store, TwoImage(), noise(4), pixels=False)
    error = refusal(store, bare)
    assert error.code is Code.FRAMES_MISSING
    assert "umbra separate" in error.message
    parent.update(state=RunState.RUNNING)
    assert refusal(store, parent).code is Code.WRONG_STATE
    parent.update(state=RunState.DONE, bench=None)
    assert "older umbrad" in refusal(store, parent).message
    parent.update(bench={"camera": {"width": 64}})
    assert "cannot be read" in refusal(store, parent).message
    never = store.create(TwoImage(), {}, bench=BENCH.recorded())
    never.update(state=RunState.ABORTED)
    assert refusal(store, never).code is Code.NO_RESULT


def test_a_request_that_is_repeated_makes_one_run(store: Store) -> None:
    parent = parent_of(store, TwoImage(), noise(4))
    lane = reprocessor(store)
    first = lane.submit(asked(parent), "me", "the-request")
    assert lane.submit(asked(parent), "me", "the-request") is first


def test_a_damaged_frame_fails_it_by_name(store: Store) -> None:
    parent = parent_of(store, TwoImage(), noise(4))
    shard = next((parent.path / "frames.zarr").glob("c.2.*"))
    shard.write_bytes(bytes([shard.read_bytes()[0] ^ 1]) + shard.read_bytes()[1:])
    end = reprocessed(store, parent).file.end
    assert end is not None
    assert end.state is RunState.FAILED
    assert "frame 2 is not what was recorded" in end.reason


def test_frames_of_another_plan_are_not_taken_for_this_one(store: Store) -> None:
    parent = parent_of(store, TwoImage(), noise(4))
    lane = reprocessor(store)
    made = lane.submit(asked(parent), "me", "")
    made.update(spec=TwoImage(checker=4))  # as if a later version drew another pattern
    executed(store, made)
    assert made.file.end is not None
    assert made.file.end.code == Code.UNSUITABLE
    assert "frame 2 shows another pattern" in made.file.end.reason


def test_a_full_disk_fails_it_and_it_is_resumed(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    parent = parent_of(store, TwoImage(), noise(4))
    with monkeypatch.context() as full:
        full.setattr(store, "room_for", lambda _: False)
        made = reprocessed(store, parent)
    assert made.file.end is not None
    assert made.file.end.code == Code.STORAGE_FULL
    lane = reprocessor(store)
    assert lane.resume(made).file.state is RunState.QUEUED
    executed(store, made)
    assert same(parent, made)
    with pytest.raises(UmbraError, match="is done: it cannot be resumed"):
        lane.resume(made)


def test_what_an_interruption_left_is_done_again(store: Store) -> None:
    parent = parent_of(store, PLAIN, noise(27))
    made = reprocessed(store, parent)
    made.update(state=RunState.INTERRUPTED)
    reprocessor(store).resume(made)
    executed(store, made)
    assert made.file.recorded == 27
    assert same(parent, made)


def test_an_abort_ends_it_between_two_frames(store: Store) -> None:
    parent = parent_of(store, PLAIN, noise(27))

    def heard(event: AnyEvent) -> None:
        if isinstance(event, Progressed) and event.progress.recorded:
            lane.abort(begun, "me")

    lane = reprocessor(store, heard)
    waiting = lane.submit(asked(parent), "me", "")
    assert lane.abort(waiting, "me").file.state is RunState.ABORTED
    begun = lane.submit(asked(parent), "me", "")
    found = lane.begin()
    assert found is not None
    assert found.folder is begun
    end = found.execute()
    assert (end.state, end.by) == (RunState.ABORTED, "me")
    assert 0 < begun.file.recorded < 27
    assert begun.file.products == ()
    assert lane.under_way is None
    with pytest.raises(UmbraError, match="is aborted: it cannot be aborted"):
        lane.abort(begun, "me")


def test_a_result_and_progress_are_there_on_the_way(store: Store) -> None:
    parent = parent_of(store, PLAIN, noise(27))
    seen: list[AnyEvent] = []
    lane = reprocessor(store, seen.append)
    lane.submit(asked(parent), "me", "")
    found = lane.begin()
    assert found is not None
    with pytest.raises(UmbraError) as caught:
        found.result()
    assert caught.value.code is Code.NO_RESULT
    found.execute()
    told = [event.progress for event in seen if isinstance(event, Progressed)]
    assert (told[-1].recorded, told[-1].planned, told[-1].fraction) == (27, 27, 1.0)
    assert isinstance(found.result(), Components)


class Waits(threading.Event):
    """Somebody who is asked to wait, does not, and remembers for how long."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: list[float] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.seconds.append(timeout or 0.0)
        return False


def test_it_gives_way_while_a_scan_is_under_way(store: Store) -> None:
    parent = parent_of(store, PLAIN, noise(27))
    answers = [True] * 10 + [False] * 17
    made = reprocessor(store).submit(asked(parent), "me", "")
    slow = Reprocessing(
        made,
        store=store,
        busy=lambda: answers.pop(0),
        on_change=lambda: None,
        on_progress=lambda _: None,
    )
    slow.control.news = Waits()
    assert slow.execute().state is RunState.DONE
    assert len(slow.control.news.seconds) == 10
    assert min(slow.control.news.seconds) > 0
    assert same(parent, made)


def test_a_parent_is_kept_for_as_long_as_it_is_needed(store: Store) -> None:
    settings = config.parse('camera = {driver = "virtual"}\n[storage]\nkeep_days = 1\n', "test")
    parent = parent_of(store, TwoImage(), noise(4))
    child = reprocessor(store).submit(asked(parent), "me", "")
    other = parent_of(store, TwoImage(), noise(4))
    for state in (RunState.QUEUED, RunState.RUNNING, RunState.INTERRUPTED):
        child.update(state=state, ended="2999-01-01T00:00:00+00:00")
        aftermath.expire(store, settings, other)
        assert parent.path.exists()
    child.update(state=RunState.DONE)
    aftermath.expire(store, settings, other)
    assert not parent.path.exists()
    error = refusal(store, child)
    assert error.code is Code.UNKNOWN_RUN
