"""Whether the picture moved while patterns were shown: told, by how much, never of a still one."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.creep import Creep, Crept, marked
from daemon.separation.estimator import Components, Lighting, Observation, Quality
from daemon.separation.radiometry import Response

FULL = 4095
PATTERNS = 24
HEIGHT, WIDTH = 200, 260


def _texture(seed: int, grain: float) -> NDArray[np.float64]:
    noise = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH))
    smooth = cv2.GaussianBlur(noise, (0, 0), grain)
    return np.asarray(0.4 + 0.1 * smooth / smooth.std()).clip(0.1, 0.8)


def _patches(seed: int) -> NDArray[np.float64]:
    """Random patterns (n, H, W), each patch lit in half of them."""
    rng = np.random.default_rng(seed)
    rows, columns = HEIGHT // 10 + 1, WIDTH // 10 + 1
    lit = np.argsort(rng.random((PATTERNS, rows, columns)), axis=0) < PATTERNS // 2
    large = np.repeat(np.repeat(lit, 10, axis=1), 10, axis=2)
    return large[:, :HEIGHT, :WIDTH].astype(np.float64)


def _frames(scene: NDArray[np.float64], *steps: tuple[float, float, float]) -> list[NDArray[Any]]:
    """White, then the patterns, seen by a camera that has moved by x, y and a turn (degrees)."""
    rng = np.random.default_rng(3)
    light = [scene, *(scene * (0.3 + 0.7 * pattern) for pattern in _patches(4))]
    frames = []
    for picture, (x, y, turn) in zip(light, steps, strict=True):
        warp = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), turn, 1.0)
        warp[:, 2] += np.array([x, y])
        seen = cv2.warpAffine(picture, warp, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
        counts = FULL * seen + rng.normal(0, 8, seen.shape)
        frames.append(np.rint(np.clip(counts, 0, FULL)).astype(np.uint16))
    return frames


def _told(frames: list[NDArray[Any]], *, white: bool = True, balanced: bool = True) -> Crept | None:
    creep = Creep(Response(FULL), PATTERNS, balanced=balanced)
    if white:
        creep.add(frames[0], Observation(lighting=Lighting.WHITE))
    for number, frame in enumerate(frames[1:]):
        creep.add(frame, Observation(pattern=number))
    return creep.told()


STILL = ((0.0, 0.0, 0.0),) * (PATTERNS + 1)
ALONG = ((0.0, 0.0, 0.0), *((n / 8, 0.0, 0.0) for n in range(PATTERNS)))
TURNED = ((0.0, 0.0, 0.0), *((0.0, 0.0, 0.04 * n) for n in range(PATTERNS)))


@pytest.mark.parametrize("white", [True, False])
@pytest.mark.parametrize("grain", [1.5, 2.5])
def test_a_camera_that_creeps_is_told(white: bool, grain: float) -> None:
    """From the mean of the first four patterns to that of the last four it goes 2.5 px."""
    crept = _told(_frames(_texture(1, grain), *ALONG), white=white)
    assert crept is not None
    assert crept.within == pytest.approx(2.5, abs=0.6)
    assert crept.before == (pytest.approx(23 / 16, abs=0.3) if white else 0.0)


def test_a_camera_that_turns_is_told() -> None:
    """0.8 degrees at the corner, 164 px from the middle."""
    crept = _told(_frames(_texture(1, 2.0), *TURNED))
    assert crept is not None
    assert crept.within == pytest.approx(164 * np.deg2rad(0.8), abs=0.6)


@pytest.mark.parametrize("white", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_stands_still_is_not_told(white: bool, seed: int) -> None:
    """Nor is one that sees a lamp drift, a person walk by, or nothing but noise."""
    still = _frames(_texture(seed, 2.0), *STILL)
    assert _told(still, white=white) == Crept(0.0, 0.0)
    drifting = [(frame * (1.0 - 0.005 * n)).astype(np.uint16) for n, frame in enumerate(still)]
    assert _told(drifting, white=white) == Crept(0.0, 0.0)
    for n, frame in enumerate(still):
        frame[60:, 8 * n : 8 * n + 40] //= 3
    assert _told(still, white=white) == Crept(0.0, 0.0)
    blank = _frames(np.full((HEIGHT, WIDTH), 0.4), *STILL)
    assert _told(blank, white=white) == Crept(0.0, 0.0)


def test_patterns_that_shift_need_a_white_frame() -> None:
    frames = _frames(_texture(1, 2.0), *ALONG)
    assert _told(frames, white=False, balanced=False) is None
    assert _told(frames, balanced=False) == _told(frames)


def test_small_pictures_tell_nothing() -> None:
    small = [frame[:60, :60] for frame in _frames(_texture(1, 2.0), *ALONG)]
    assert _told(small) is None


def test_what_moved_is_marked_and_its_deviation_holds_it() -> None:
    direct = np.full((40, 60), 400.0, np.float32)
    direct[:, 30:] = 1000.0
    given = Components(
        direct,
        np.zeros_like(direct),
        np.zeros(direct.shape, np.uint16),
        {"direct_std": np.full_like(direct, 4.0)},
        {"quality": {}},
    )
    found, lines = marked(given, Crept(2.0, 0.0))
    moved = found.quality & np.uint16(Quality.MOVED) != 0
    assert moved[:, 28:32].all()
    assert not moved[:, :26].any()
    assert not moved[:, 34:].any()
    assert (found.planes["direct_std"][:, 29:31] > 100.0).all()
    assert found.planes["direct_std"][0, 5] == 4.0
    assert found.facts["quality"]["moved"]["pixels"] == np.count_nonzero(moved)
    assert "moved by 2.0 px while the patterns were shown" in lines[0]
    same, lines = marked(given, Crept(0.0, 1.2))
    assert not same.quality.any()
    assert "1.2 px between the white frame and" in lines[0]
