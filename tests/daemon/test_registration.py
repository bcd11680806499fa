"""The camera's shake is told under a mesh's moving shadow, undone, or the frame is left out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Taken
from daemon.separation.estimator import Components, Observation
from daemon.separation.radiometry import Response
from daemon.separation.registration import (
    LEAST_PX,
    REFERENCE,
    Registration,
)
from daemon.separation.warping import aligned, beyond, uncertain, without
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.stage import StageInfo
from protocol.mesh import Mesh as Holes
from protocol.scans.occluded import Mesh
from tests.daemon.scanning import watched

HEIGHT, WIDTH = 156, 208
PITCH = 20.0
HOLES = Holes(0.625 * PITCH, PITCH)
DEEP = Response(full_scale=65535)
SPAN = 12  # px of the scene around the picture
TURN = 40
Shifts = Sequence[tuple[float, float]]


def wall(texture: float = 0.3) -> NDArray[np.float64]:
    """The albedo of a wall at half pixels: blocks of a few pixels, larger than the picture."""
    rng = np.random.default_rng(5)
    rows, columns = (n + 2 * SPAN for n in (HEIGHT, WIDTH))
    blocks = rng.uniform(1.0 - texture, 1.0, (rows // 4 + 1, columns // 4 + 1))
    whole = np.kron(blocks, np.ones((8, 8)))[: 2 * rows, : 2 * columns]
    return np.asarray(whole, np.float64)


def seen(plane: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """What a camera that moved by a whole number of half pixels sees of a plane."""
    left, top = round(2 * (SPAN - x)), round(2 * (SPAN - y))
    part = plane[top : top + 2 * HEIGHT, left : left + 2 * WIDTH]
    return np.asarray(part.reshape(HEIGHT, 2, WIDTH, 2).mean((1, 3)), np.float64)


@lru_cache(maxsize=TURN)
def light(k: int) -> NDArray[np.float64]:
    """What comes through the mesh at one of the TURN places of its circle, at half pixels."""
    y, x = np.mgrid[0 : 2 * (HEIGHT + 2 * SPAN), 0 : 2 * (WIDTH + 2 * SPAN)] / 2.0
    angle = math.tau * k / TURN
    away = 0.95 * PITCH
    clear = HOLES.clearance(x + away * math.cos(angle), y + away * math.sin(angle))
    return np.asarray(24000.0 * np.clip(clear + 0.5, 0, 1) + 0.3 * 9000.0)


def frames(shifts: Shifts, texture: float = 0.3, noise: float = 200.0) -> list[NDArray[Any]]:
    """The wall behind a mesh on its circle, by a camera that is shifted frame by frame."""
    rng = np.random.default_rng(6)
    albedo = wall(texture)
    found = []
    for k, (dx, dy) in enumerate(shifts):
        picture = seen(albedo * light(k % TURN), dx, dy) + rng.normal(0, noise, (HEIGHT, WIDTH))
        found.append(np.rint(np.clip(picture, 0, 65535)).astype(np.uint16))
    return found


def shaken(count: int, most: float, seed: int = 7) -> list[tuple[float, float]]:
    """Shifts in half pixels."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(round(-2 * most), round(2 * most), (count, 2), endpoint=True) / 2.0
    return [(float(x), float(y)) for x, y in steps]


STILL = [(0.0, 0.0)] * REFERENCE


def test_shifts_are_found_under_the_moving_shadow() -> None:
    later = shaken(24, 5.0)
    camera = Registration(DEEP, mesh=True)
    shots = frames([*STILL, *later])
    for frame in shots[:REFERENCE]:
        camera.learn(frame)
    assert camera.learned
    assert camera.tells
    assert camera.wandered < LEAST_PX
    for frame, (x, y) in zip(shots[REFERENCE:], later, strict=True):
        shift = camera.of(frame)
        assert shift.found
        assert (shift.x, shift.y) == pytest.approx((x, y), abs=0.12)
        assert shift.warp == ((1.0, 0.0, -shift.x, 0.0, 1.0, -shift.y) if x or y else None)


def test_a_camera_that_shakes_from_the_beginning_is_found_out() -> None:
    there = shaken(REFERENCE + 16, 2.0)
    camera = Registration(DEEP, mesh=True)
    shots = frames(there)
    for frame in shots[:REFERENCE]:
        camera.learn(frame)
    assert camera.wandered == pytest.approx(
        np.hypot(*(np.array(there[:REFERENCE]) - np.median(there[:REFERENCE], axis=0)).T).max(),
        abs=0.3,
    )
    found = [camera.of(frame) for frame in shots[REFERENCE:]]
    apart = np.array([(s.x, s.y) for s in found]) - np.array(there[REFERENCE:])
    assert np.abs(apart - np.median(apart, axis=0)).max() < 0.2


def test_a_tripod_that_twists_is_turned_back() -> None:
    camera = Registration(DEEP, mesh=True)
    shots = frames([*STILL, *STILL[:3]])
    for frame in shots[:REFERENCE]:
        camera.learn(frame)
    middle = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    for frame, degrees in zip(shots[REFERENCE:], (0.0, 0.3, -0.6), strict=True):
        turned = cv2.getRotationMatrix2D(middle, degrees, 1.0)
        place = camera.of(cv2.warpAffine(frame, turned, (WIDTH, HEIGHT)))
        assert place.found
        assert -math.degrees(place.turn) == pytest.approx(degrees, abs=0.08)
        if degrees:
            assert place.warp is not None
            back = np.asarray(place.warp).reshape(2, 3)
            whole = np.vstack([back, [0, 0, 1]]) @ np.vstack([turned, [0, 0, 1]])
            corner = np.array([WIDTH, HEIGHT, 1.0])
            np.testing.assert_allclose(whole @ corner, corner, atol=0.25)


def part(shots: Sequence[NDArray[Any]], height: int, width: int) -> list[NDArray[Any]]:
    """The middle of pictures, as a camera with a small region of interest gives it."""
    top, left = (HEIGHT - height) // 2, (WIDTH - width) // 2
    return [np.ascontiguousarray(x[top : top + height, left : left + width]) for x in shots]


def test_a_tripod_that_twists_from_the_beginning_is_followed() -> None:
    height, width = 148, 200
    rng = np.random.default_rng(9)
    there = shaken(REFERENCE + 8, 1.0)
    turns = rng.normal(0.0, 0.3, len(there))
    middle = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    shots = [
        cv2.warpAffine(
            frame,
            cv2.getRotationMatrix2D(middle, degrees, 1.0),
            (WIDTH, HEIGHT),
            flags=cv2.INTER_LANCZOS4,
        )
        for frame, degrees in zip(frames(there), turns, strict=True)
    ]
    shots = part(shots, height, width)
    camera = Registration(DEEP, mesh=True)
    assert camera.suits(shots[0].shape)
    for frame in shots[:REFERENCE]:
        camera.learn(frame)
    assert camera.tells
    places = [camera.of(frame) for frame in shots[REFERENCE:]]
    assert all(place.found for place in places)
    apart = np.array([-math.degrees(p.turn) for p in places]) - turns[REFERENCE:]
    assert np.abs(apart - np.median(apart)).max() < 0.12
    shifts = np.array([(p.x, p.y) for p in places])
    for k in range(len(places)):  # the shift came first, and was turned with the picture
        angle = math.radians(-turns[REFERENCE + k])
        turned = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        shifts[k] -= turned @ there[REFERENCE + k]
    assert np.abs(shifts - np.median(shifts, axis=0)).max() < 0.15


def test_a_frame_that_is_not_the_scenes_is_not_placed() -> None:
    shots = part(frames(STILL), 96, 128)
    camera = Registration(DEEP, mesh=True)
    for frame in shots:
        camera.learn(frame)
    assert camera.tells
    blurred = cv2.blur(np.roll(shots[0], 3, axis=1), (15, 1))  # drawn along by a blow
    assert not camera.of(blurred).found


def test_a_recording_is_aligned_from_its_first_frame() -> None:
    there = np.array(shaken(REFERENCE, 2.0))
    shots = frames([(float(x), float(y)) for x, y in there])
    camera = CameraInfo(WIDTH, HEIGHT, PixelFormat.MONO16, recorded=True, frame_count=len(shots))
    method = method_for(Mesh(hole_mm=HOLES.hole_mm, pitch_mm=HOLES.pitch_mm), Bench(camera))
    method.foresee(iter(shots))
    step = method.step(0, {})
    assert step is not None
    decided = [
        method.observe(step, Taken(0, k, incomplete=False, pixels=shot))
        for k, shot in enumerate(shots[:10])
    ]
    assert all(o.used and not o.fresh for o in decided)
    found = [(0.0, 0.0) if o.warp is None else (-o.warp[2], -o.warp[5]) for o in decided]
    apart = np.array(found) - there[:10]
    assert np.abs(apart - np.median(apart, axis=0)).max() < 0.25


def test_a_wall_without_texture_tells_nothing_and_says_so() -> None:
    for there in (STILL, shaken(REFERENCE, 2.0)):
        camera = Registration(DEEP, mesh=True)
        for frame in frames(there, texture=0.0):
            camera.learn(frame)
        assert not camera.tells  # what moves there is the mesh
    assert not Registration(DEEP).suits((48, 60))
    with pytest.raises(ValueError, match="no reference"):
        Registration(DEEP).of(frames(STILL[:1])[0])


@pytest.mark.parametrize("bayer", [False, True])
def test_aligning_moves_samples_to_where_they_were(bayer: bool) -> None:
    rng = np.random.default_rng(8)
    before = rng.integers(0, 4096, (40, 60), dtype=np.uint16)
    moved = np.roll(before, (2, 4), axis=(0, 1))  # by x = 4, y = 2
    warp = (1.0, 0.0, -4.0, 0.0, 1.0, -2.0)
    outside = beyond(before.shape, warp, bayer)
    assert 0 < outside.mean() < 0.2
    back = aligned(moved, warp, bayer)
    np.testing.assert_array_equal(back[~outside], before[~outside])
    known = np.full_like(before, 1000), np.full_like(before, 3000)
    assert (without(back, outside, known)[outside] == 2000).all()
    assert not uncertain(moved, warp, bayer, None, before).any()  # by whole pixels
    assert uncertain(moved, (1.0, 0.0, -3.5, 0.0, 1.0, -2.0), bayer, None, before).mean() > 0.9
    half = aligned(moved, (1.0, 0.0, -3.5, 0.0, 1.0, -2.0), bayer)
    assert half.min() >= moved.min()
    assert half.max() <= moved.max()


def separated(shifts: Shifts, *, align: bool) -> tuple[Components, list[Observation]]:
    camera = CameraInfo(WIDTH, HEIGHT, PixelFormat.MONO16)
    bench = Bench(camera, stage=StageInfo(((0, 500), (0, 300)), 100.0))
    spec = Mesh(hole_mm=HOLES.hole_mm, pitch_mm=HOLES.pitch_mm, align=align)
    return watched(spec, bench, frames(shifts))


def test_a_gust_is_aligned_and_a_fall_is_left_out() -> None:
    gust = [*STILL, *shaken(30, 4.0), (11.0, 0.0), (0.0, 0.0)]
    steady, _ = separated([(0.0, 0.0)] * len(gust), align=True)
    mended, decided = separated(gust, align=True)
    broken, _ = separated(gust, align=False)
    assert steady.facts["aligned_frames"] == 0
    assert all(o.warp is None for o in decided[:REFERENCE])
    assert decided[-2].used is False
    assert "to be aligned" in decided[-2].reason
    assert decided[-1].warp is None
    assert mended.facts["rejected"] == {decided[-2].reason: 1}
    assert mended.facts["aligned_frames"] >= 25
    assert mended.facts["camera_place"].startswith("known to ")

    def apart(one: Components) -> float:
        return float(np.sqrt(np.nanmean((one.direct - steady.direct) ** 2)))

    assert apart(mended) < 0.4 * apart(broken)


def test_a_scan_interrupted_while_the_place_is_learned_goes_on_with_the_same_decisions() -> None:
    cut = REFERENCE // 2
    shots = part(frames([*shaken(REFERENCE, 2.0), *shaken(12, 4.0, seed=9)]), 148, 200)
    bench = Bench(
        CameraInfo(200, 148, PixelFormat.MONO12), stage=StageInfo(((0, 500), (0, 300)), 100.0)
    )
    spec = Mesh(hole_mm=HOLES.hole_mm, pitch_mm=HOLES.pitch_mm)
    whole, method = method_for(spec, bench), method_for(spec, bench)
    step = method.step(0, {})
    assert step is not None
    decided = []
    for k, frame in enumerate(shots):
        taken = Taken(0, k, incomplete=False, pixels=frame)
        observation = whole.observe(step, taken)
        if k < cut:
            method.recall(frame, observation)
        else:
            assert method.observe(step, taken) == observation
        decided.append(observation)
    assert decided[REFERENCE - 1].fresh  # it shook before
    assert sum(o.warp is not None for o in decided[REFERENCE:]) > 8


def test_still_frames_are_used_as_they_are() -> None:
    still = [(0.0, 0.0)] * (REFERENCE + 20)
    one, decided = separated(still, align=True)
    other, _ = separated(still, align=False)
    assert all(o.warp is None and o.used for o in decided)
    assert one.direct.tobytes() == other.direct.tobytes()
    assert one.quality.tobytes() == other.quality.tobytes()
