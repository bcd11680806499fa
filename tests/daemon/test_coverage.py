"""What a sweep tells of the pixels that the shadow never reached."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.coverage import Occluder
from daemon.separation.estimator import Components, NotYet, Observation, Quality
from daemon.separation.radiometry import Response

HEIGHT, WIDTH = 96, 160
DEEP = Response(full_scale=65535)
CAST = np.s_[32:64, 56:88]  # the scene's own shadow: no direct light
DARK = np.s_[72:88, 16:32]  # a dark marker


def scene() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Direct and global light of a wall with a cast shadow and a dark marker."""
    rng = np.random.default_rng(7)
    texture = 1.0 + 0.03 * rng.standard_normal((HEIGHT, WIDTH))
    direct, indirect = 20000.0 * texture, 12000.0 * texture
    direct[CAST] = 0.0
    direct[DARK] *= 0.05
    indirect[DARK] *= 0.05
    return direct, indirect


def sweep(positions: Iterable[float], noise: float = 150.0, stick: int = 8) -> list[NDArray[Any]]:
    """Frames of a vertical stick's shadow with its left edge at each position."""
    rng = np.random.default_rng(8)
    direct, indirect = scene()
    columns = np.arange(WIDTH)
    frames = []
    for left in positions:
        light = np.where((columns >= left) & (columns < left + stick), 0.0, 1.0) * direct + indirect
        noisy = np.clip(light + rng.normal(0, noise, light.shape), 0, 65535)
        frames.append(np.rint(noisy).astype(np.uint16))
    return frames


def separate(
    frames: list[NDArray[Any]], response: Response = DEEP, *, averaged: bool = True
) -> Components:
    estimator = Occluder(response, lit_fraction=1.0, averaged=averaged)
    for index, frame in enumerate(frames):
        estimator.update(frame, Observation(pattern=index))
    return estimator.result()


WHOLE = [*range(-10, WIDTH, 2)]


def flagged(found: Components, flag: Quality) -> NDArray[np.bool_]:
    return np.asarray((found.quality & np.uint16(flag)) != 0)


def test_a_whole_sweep_separates_and_flags_nothing_as_never_unlit() -> None:
    direct, indirect = scene()
    found = separate(sweep(WHOLE))
    assert not flagged(found, Quality.NEVER_UNLIT).any()
    assert not np.isnan(found.direct).any()
    np.testing.assert_allclose(found.direct, direct, atol=1400)
    np.testing.assert_allclose(found.global_, indirect, atol=800)


def test_full_light_is_a_mean_and_not_what_noise_made_brightest() -> None:
    """Once and three times in the umbra; the shadow lies on the first columns from the start."""
    direct, _ = scene()
    lit = np.ones((HEIGHT, WIDTH), dtype=np.bool_)
    lit[CAST] = lit[DARK] = False
    for step in (8, 3):
        frames = [*sweep([0], 1000.0) * 3, *sweep(range(-8, WIDTH, step), 1000.0)]
        frames += sweep([WIDTH + 1] * 20, 1000.0)
        off = [
            (separate(frames, averaged=a).direct - direct) / direct.mean() for a in (True, False)
        ]
        assert abs(np.mean(off[0][lit])) < 0.03
        assert np.mean(off[1][lit]) > 0.1
        assert abs(np.mean(off[0][:, :8])) < 0.06
        assert off[0][lit].std() < 0.75 * np.sqrt(np.mean(np.square(off[1][lit])))


def test_the_scenes_own_shadow_has_no_direct_light_and_says_so() -> None:
    found = separate(sweep(WHOLE))
    inside = np.s_[34:62, 58:86]
    assert flagged(found, Quality.LOW_MODULATION)[inside].mean() > 0.5
    assert np.abs(found.direct[inside]).max() < 1400


def test_what_the_stick_never_reached_is_not_called_direct_zero() -> None:
    """The sweep ends at column 100: beyond it nothing is known, the marker apart."""
    found = separate(sweep(range(-10, 92, 2)))
    beyond = flagged(found, Quality.NEVER_UNLIT)[:, 108:]
    assert beyond.mean() > 0.99
    assert np.isnan(found.direct[:, 108:]).mean() > 0.99
    assert np.isnan(found.global_[:, 108:]).mean() > 0.99
    assert flagged(found, Quality.NEVER_UNLIT)[:, :92].mean() < 0.005
    assert (found.planes["coverage"][:, 108:][beyond] == 0).all()


def test_a_gap_that_a_fast_hand_left_is_found_where_the_scene_is_lit() -> None:
    """Nothing between columns 104 and 136 was shaded."""
    positions = [p for p in WHOLE if not 96 < p < 136]
    found = separate(sweep(positions))
    assert flagged(found, Quality.NEVER_UNLIT)[:, 112:128].mean() > 0.99
    outside = np.r_[0:96, 144:WIDTH]
    assert flagged(found, Quality.NEVER_UNLIT)[:, outside].mean() < 0.005


def test_a_dark_surface_is_not_never_unlit_for_being_dark() -> None:
    found = separate(sweep(WHOLE, noise=700.0))
    assert not flagged(found, Quality.NEVER_UNLIT)[DARK].any()
    assert flagged(found, Quality.LOW_MODULATION)[DARK].mean() > 0.5


def test_one_frame_in_the_umbra_is_kept_and_flagged() -> None:
    found = separate(sweep(range(-10, WIDTH, 8)))  # each column shaded in one frame, 8 px steps
    lit = np.ones((HEIGHT, WIDTH), dtype=np.bool_)
    lit[CAST] = lit[DARK] = False
    assert flagged(found, Quality.SINGLE)[lit].mean() > 0.99
    assert not np.isnan(found.direct[lit]).any()
    assert (found.planes["coverage"][lit] == 1).mean() > 0.99
    several = separate(sweep(WHOLE))
    assert flagged(several, Quality.SINGLE)[lit].mean() < 0.01
    assert (several.planes["coverage"][lit] == 4).mean() > 0.95


def soft_sweep(step: float, noise: float = 150.0) -> tuple[list[NDArray[Any]], NDArray[Any]]:
    """Frames of a stick of 12 px with a penumbra of 4 px, and the least light of each column."""
    rng = np.random.default_rng(9)
    direct, indirect = scene()
    columns = np.arange(WIDTH)
    frames, least = [], np.ones(WIDTH)
    for middle in np.arange(-12.0, WIDTH + 12, step):
        passed = np.clip((np.abs(columns - middle) - 6.0) / 4.0 + 0.5, 0, 1)
        least = np.minimum(least, passed)
        light = passed * direct + indirect + rng.normal(0, noise, direct.shape)
        frames.append(np.rint(np.clip(light, 0, 65535)).astype(np.uint16))
    return frames, least


@pytest.mark.parametrize("bayer", ["", "RG"])
def test_what_saw_but_a_penumbra_is_not_taken_for_shaded(bayer: str) -> None:
    frames, least = soft_sweep(18.0)
    found = separate(frames, Response(full_scale=65535, bayer=bayer))
    lit = np.ones((HEIGHT, WIDTH), dtype=np.bool_)
    lit[CAST] = lit[DARK] = False
    penumbra, umbra = (np.broadcast_to(c, lit.shape) & lit for c in (least > 0.4, least == 0))
    assert 0.1 < penumbra.mean() < umbra.mean()
    never = flagged(found, Quality.NEVER_UNLIT)
    assert never[penumbra].mean() > 0.95
    assert np.isnan(found.direct[penumbra]).mean() > 0.95
    assert (found.planes["coverage"][never] == 0).all()
    assert never[umbra].mean() < 0.01
    assert not never[36:60, 60:84].any()  # the scene's own shadow
    assert flagged(found, Quality.SINGLE)[umbra].mean() > 0.99
    (line,) = [line for line in found.facts["advice"] if "sweep again" in line]
    assert "in a single frame" in line


def test_a_slow_sweep_has_no_gaps_whatever_the_scene() -> None:
    rng = np.random.default_rng(10)
    print_ = rng.uniform(0.05, 1.0, (HEIGHT, WIDTH))  # of direct alone: depths of all kinds
    frames, _ = soft_sweep(2.0)
    rest = np.rint(scene()[1])
    found = separate(
        [np.rint(rest + (f - rest) * print_).clip(0).astype(np.uint16) for f in frames]
    )
    lit = np.ones((HEIGHT, WIDTH), dtype=np.bool_)
    lit[CAST] = lit[DARK] = False
    assert flagged(found, Quality.NEVER_UNLIT)[lit].mean() < 0.005
    assert not [line for line in found.facts["advice"] if "sweep again" in line]


def test_frames_without_a_shadow_do_no_harm() -> None:
    frames = sweep([*[WIDTH + 1] * 20, *WHOLE, *[WIDTH + 1] * 20])
    found = separate(frames)
    np.testing.assert_allclose(found.direct, scene()[0], atol=1500)
    assert not flagged(found, Quality.NEVER_UNLIT).any()


def test_no_shadow_at_all_is_no_result_but_flags() -> None:
    found = separate(sweep([WIDTH + 1] * 12))
    assert flagged(found, Quality.NEVER_UNLIT).all()
    assert np.isnan(found.direct).all()


def test_colour_and_mosaic_agree_on_coverage() -> None:
    frames = sweep(range(-10, 92, 2))
    colour = separate([np.repeat(f[..., None], 3, axis=2) for f in frames])
    raw = separate(frames, Response(full_scale=65535, bayer="GR"))
    plain = separate(frames)
    for found in (colour, raw):
        assert found.direct.shape == (HEIGHT, WIDTH, 3)
        same = flagged(found, Quality.NEVER_UNLIT) == flagged(plain, Quality.NEVER_UNLIT)
        assert same.mean() > 0.99
    assert np.isnan(raw.direct[:, 110:]).all(axis=2).mean() > 0.99


def test_a_resumed_sweep_gives_the_same_bits() -> None:
    frames = sweep(WHOLE)
    one, other = (Occluder(DEEP, lit_fraction=1.0) for _ in range(2))
    for index, frame in enumerate(frames):
        one.update(frame, Observation(pattern=index))
        if index == 30:
            one.result()
    for index, frame in enumerate(frames):
        other.update(frame.copy(), Observation(pattern=index))
    a, b = one.result(), other.result()
    assert a.direct.tobytes() == b.direct.tobytes()
    assert a.quality.tobytes() == b.quality.tobytes()
    assert a.planes["coverage"].tobytes() == b.planes["coverage"].tobytes()


def test_the_summary_knows_how_far_the_sweep_is() -> None:
    estimator = Occluder(DEEP, lit_fraction=1.0)
    with pytest.raises(NotYet):
        estimator.result()
    covered = []
    for index, frame in enumerate(sweep(WHOLE)):
        estimator.update(frame, Observation(pattern=index))
        covered.append(estimator.summary()["covered"])
    assert covered[0] == 0.0
    assert 0.3 < covered[len(covered) // 2] < 0.7
    assert covered[-1] > 0.9


def test_frames_of_shifted_checkerboards_are_not_a_sticks_and_it_says_so() -> None:
    direct, indirect = scene()
    rows, columns = np.indices(direct.shape)
    frames = []
    for shift in np.ndindex(5, 5):
        lit = ((rows + 3 * shift[0]) // 8 + (columns + 3 * shift[1]) // 8) % 2
        frames.append(np.rint(lit * direct + indirect).astype(np.uint16))
    found = separate(frames)
    assert [line for line in found.facts["advice"] if "do not look like a stick's" in line]
    assert found.facts["change_per_frame"] > 0.25
    assert found.facts["lit_of_the_time"] == pytest.approx(0.5, abs=0.1)


def test_a_meshs_frames_are_not_a_sticks_however_slow_and_it_says_so() -> None:
    direct, indirect = scene()
    y, x = np.indices(direct.shape)
    frames = [
        np.rint(((x + k) // 10 % 3 == 0) * ((y // 10) % 3 == 0) * direct + indirect).astype(
            np.uint16
        )
        for k in range(30)
    ]
    found = separate(frames)
    assert [line for line in found.facts["advice"] if "do not look like a stick's" in line]


@pytest.mark.parametrize(("noise", "stick", "stride"), [(150, 8, 2), (2000, 8, 4), (150, 24, 12)])
def test_a_sticks_frames_look_like_a_sticks(noise: float, stick: int, stride: int) -> None:
    found = separate(sweep(range(-stick, WIDTH, stride), noise, stick))
    assert not [line for line in found.facts["advice"] if "do not look like" in line]
    assert found.facts["lit_of_the_time"] > 0.8


def test_most_lit_pixels_lost_is_said() -> None:
    half = separate(sweep(range(-10, 40, 2)))
    lines = [line for line in half.facts["advice"] if "cannot be separated" in line]
    assert len(lines) == 1
    whole = separate(sweep(WHOLE))
    assert not [line for line in whole.facts["advice"] if "cannot be separated" in line]


@pytest.mark.parametrize("stride", [0.5, 4.0])  # a pixel is in the umbra in 16 frames, or in 2
def test_what_noise_leaves_in_the_components_is_stated(stride: float) -> None:
    def swept(seed: int) -> Components:
        rng = np.random.default_rng(seed)
        light = sweep(np.arange(-8, WIDTH + 8, stride), noise=0.0)
        estimator = Occluder(Response(full_scale=65535), lit_fraction=1.0)
        for frame in light:
            noisy = np.clip(frame + rng.normal(0, 150.0, frame.shape), 0, 65535)
            estimator.update(np.rint(noisy).astype(np.uint16), Observation())
        return estimator.result()

    scans = [swept(seed) for seed in range(3)]
    good = np.all([scan.quality == 0 for scan in scans], axis=0)
    assert good.mean() > 0.5
    direct, _ = scene()
    for name, plane in (("direct", "direct_std"), ("global_", "global_std")):
        real = np.std([getattr(scan, name) for scan in scans], axis=0, ddof=1)[good]
        stated = np.mean([scan.planes[plane] for scan in scans], axis=0)[good]
        assert 0.8 < np.median(stated) / (np.median(real) / 0.833) < 1.25
    off = np.mean([scan.direct for scan in scans], axis=0)[good] - direct[good]
    assert abs(np.median(off)) < 60.0  # less than half of a sample's deviation
