"""A simulated wall behind a moving mesh: components, what noise does, and what was not covered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.separation.estimator import Components, Lighting, Observation, Quality
from daemon.separation.mesh import MeshOccluder
from daemon.separation.radiometry import Response
from daemon.separation.still import StillPlaces
from protocol.mesh import Mesh
from protocol.mesh import circle as circle_of

HEIGHT, WIDTH = 96, 128
PITCH = 16.0  # pixels
MESH = Mesh(0.625 * PITCH, PITCH)
DEEP = Response(full_scale=65535)
AMBIENT = 3000.0
CAST = np.s_[20:52, 80:120]  # the scene's own shadow, larger than a pitch
UNKNOWN = Quality.NEVER_LIT | Quality.NEVER_UNLIT
COVERING, SHORT = 0.95, 0.55  # radii in pitches: every point lit and shaded; islands never lit


def scene() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Direct and global light of a textured wall."""
    rng = np.random.default_rng(3)
    albedo = 1.0 + 0.1 * rng.standard_normal((HEIGHT, WIDTH))
    albedo[60:80, 20:50] *= 0.5
    direct, indirect = 24000.0 * albedo, 9000.0 * albedo
    direct[CAST] = 0.0
    return direct, indirect


def circle(
    radius: float,
    frames: int = 72,
    noise: float = 0.0,
    ambient: float = 0.0,
    lit: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    scattered: float = 0.0,
) -> list[NDArray[Any]]:
    """Frames of the wall, or of what is `lit` otherwise, while the mesh goes round once; light may
    be scattered over some pixels."""
    rng = np.random.default_rng(4)
    direct, indirect = lit or scene()
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    found = []
    for k in range(frames):
        angle = math.tau * k / frames
        clear = MESH.clearance(
            x + radius * PITCH * math.cos(angle), y + radius * PITCH * math.sin(angle)
        )
        through = np.clip(clear + 0.5, 0, 1)
        if scattered:
            through = np.asarray(cv2.GaussianBlur(through, (0, 0), scattered), np.float64)
        light = through * direct + MESH.hole_fraction * indirect + ambient
        found.append(counts(light + rng.normal(0, noise, light.shape)))
    return found


def counts(light: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.rint(np.clip(light, 0, 65535)).astype(np.uint16)


def separate(
    frames: Sequence[NDArray[Any]],
    beta: float | None = MESH.hole_fraction,
    references: dict[Lighting, NDArray[np.float64]] | None = None,
    *,
    averaged: bool = True,
    response: Response = DEEP,
    least: float | None = None,
) -> Components:
    estimator = MeshOccluder(response, hole_fraction=beta, averaged=averaged, least=least)
    for kind, light in (references or {}).items():
        estimator.update(counts(light), Observation(lighting=kind))
    for frame in frames:
        estimator.update(frame, Observation())
    return estimator.result()


def errors(found: Components) -> tuple[float, float]:
    direct, indirect = scene()
    return (
        float(np.sqrt(np.nanmean((found.direct - direct) ** 2))),
        float(np.sqrt(np.nanmean((found.global_ - indirect) ** 2))),
    )


def flagged(found: Components, flag: Quality) -> NDArray[np.bool_]:
    return np.asarray((found.quality & np.uint16(flag)) != 0)


def test_without_noise_both_estimators_are_exact() -> None:
    frames = circle(COVERING)
    for averaged in (True, False):
        found = separate(frames, averaged=averaged)
        assert np.isnan(found.direct).mean() < 0.01
        assert max(errors(found)) < 60.0  # 0.1 % of full scale
        assert found.facts["coverage"] > 0.985


def test_averaging_halves_what_noise_does_to_extremes() -> None:
    frames = circle(COVERING, noise=650.0)
    averaged, extremes = (errors(separate(frames, averaged=a)) for a in (True, False))
    assert averaged[0] < 0.5 * extremes[0]
    assert averaged[1] < 0.5 * extremes[1]


@pytest.mark.parametrize("noise", [0.0, 300.0])
def test_islands_that_were_never_lit_are_flagged_and_not_guessed(noise: float) -> None:
    frames = circle(SHORT, noise=noise)
    direct, _ = scene()
    span = np.max(circle(SHORT), axis=0).astype(float) - np.min(circle(SHORT), axis=0)
    lit_part = np.divide(span, direct, out=np.ones_like(direct), where=direct > 0)
    missed, reached = lit_part < 0.6, lit_part > 0.97
    assert 0.02 < missed.mean() < 0.3
    found = separate(frames)
    never = flagged(found, Quality.NEVER_LIT)
    assert never[missed].mean() > 0.9
    assert never[reached].mean() < 0.08  # some rims too
    assert np.isnan(found.direct[never]).all()
    assert np.isnan(found.global_[never]).all()
    assert (found.planes["coverage"][never] == 0).all()
    plain = separate(frames, averaged=False)
    assert errors(found)[0] < 0.05 * 65535
    assert flagged(plain, Quality.NEVER_LIT)[missed].mean() > 0.9
    assert found.facts["pitch_px"] == pytest.approx(PITCH, rel=0.25)


@pytest.mark.parametrize("part", [0.01, 0.06, 0.2])
def test_print_is_covered_however_dark_it_is(part: float) -> None:
    """Stripes of .5 pitch, whose global light, from elsewhere, is not as dark as their direct."""
    stripes = np.s_[:, 40:80:16], np.s_[:, 41:80:16], np.s_[30:38, 88:]
    direct, indirect = scene()
    for stripe in stripes:
        direct[stripe] *= part
        indirect[stripe] *= 0.3 + 0.7 * part
    found = separate(circle(COVERING, noise=150.0, lit=(direct, indirect)))
    for stripe in stripes:
        assert flagged(found, UNKNOWN)[stripe].mean() < 0.06  # without time, nearly all
        assert np.nanmean(np.abs(found.direct - direct)[stripe]) < 150.0
    assert found.facts["coverage"] > 0.995


def test_islands_next_to_print_are_still_flagged() -> None:
    direct, indirect = scene()
    print_ = np.s_[:, 48:64]
    direct[print_] *= 0.05
    indirect[print_] *= 0.3
    frames = circle(SHORT, noise=150.0, lit=(direct, indirect))
    span = np.max(circle(SHORT), axis=0).astype(float) - np.min(circle(SHORT), axis=0)
    missed = span < 0.6 * scene()[0]
    missed[:, 40:72] = False
    assert flagged(separate(frames), Quality.NEVER_LIT)[missed].mean() > 0.9


def test_a_shadow_narrower_than_the_pitch_is_no_island() -> None:
    direct, indirect = scene()
    narrow = np.s_[4:50, 30:38]
    direct[narrow] = 0.0
    found = separate(circle(COVERING, noise=150.0, lit=(direct, indirect)))
    assert not flagged(found, UNKNOWN)[narrow].any()
    assert flagged(found, Quality.LOW_MODULATION)[narrow].mean() > 0.9
    assert found.facts["coverage"] > 0.995


def test_where_the_circle_is_known_light_may_come_and_go_little_by_little() -> None:
    """Wax before the wall: what the mesh does to its light is smooth, and stays at no end."""
    direct, indirect = scene()
    wax = np.s_[8:88, 48:72]
    frames = circle(COVERING, noise=100.0)
    smooth = circle(COVERING, noise=100.0, lit=(0.6 * direct, 2 * indirect), scattered=3.0)
    for frame, inside in zip(frames, smooth, strict=True):
        frame[wax] = inside[wax]
    turn = circle_of(Mesh(10.0, 16.0), COVERING * PITCH, 0.1)
    known = separate(frames, least=min(turn.lit, turn.unlit))
    guessed = separate(frames)
    few, many = (flagged(found, UNKNOWN)[wax].mean() for found in (known, guessed))
    assert few < 0.5 * many
    assert known.facts["coverage"] > guessed.facts["coverage"] + 0.01


def test_the_scenes_own_shadow_is_measured_not_flagged() -> None:
    found = separate(circle(COVERING, noise=200.0))
    inside = np.s_[24:48, 84:116]
    assert flagged(found, UNKNOWN)[inside].mean() < 0.02
    assert flagged(found, Quality.LOW_MODULATION)[inside].mean() > 0.9
    _, indirect = scene()
    np.testing.assert_allclose(
        np.nanmean(found.global_[inside]), indirect[inside].mean(), rtol=0.08
    )


def test_an_ambient_frame_is_removed() -> None:
    ambient = np.full((HEIGHT, WIDTH), AMBIENT)
    frames = circle(COVERING, ambient=AMBIENT)
    wrong = errors(separate(frames))
    assert wrong[1] > 0.9 * AMBIENT / MESH.hole_fraction
    found = separate(frames, references={Lighting.AMBIENT: ambient})
    assert max(errors(found)) < 60.0
    assert found.facts["ambient_from"] == "ambient frame"


def test_an_open_frame_tells_ambient_and_global_apart() -> None:
    direct, indirect = scene()
    frames = circle(COVERING, ambient=AMBIENT)
    found = separate(frames, references={Lighting.OPEN: direct + indirect + AMBIENT})
    assert max(errors(found)) < 60.0
    assert found.facts["ambient_from"] == "open frame"


def test_with_an_open_and_an_ambient_frame_it_matters_not_what_the_mesh_left_unshaded() -> None:
    """Of the global light a third comes from places beyond the mesh's shadow."""
    direct, indirect = scene()
    beyond = 3000.0
    frames = circle(COVERING, noise=100.0, ambient=AMBIENT + beyond)
    whole = direct + indirect + AMBIENT + beyond
    references = {Lighting.AMBIENT: np.full((HEIGHT, WIDTH), AMBIENT), Lighting.OPEN: whole}
    alone = separate(frames, references={Lighting.AMBIENT: references[Lighting.AMBIENT]})
    assert np.nanmedian(alone.global_ - indirect) > beyond / MESH.hole_fraction
    for beta in (MESH.hole_fraction, 0.6):
        found = separate(frames, beta, references)
        assert np.nanmedian(found.global_ - indirect) == pytest.approx(beyond, abs=100.0)
        assert found.facts["ambient_from"] == "open and ambient frames"


def test_where_an_open_frame_is_saturated_it_tells_nothing() -> None:
    direct, indirect = scene()
    whole = direct + indirect + AMBIENT
    spot = np.s_[10:20, 10:20]
    whole[spot] = 65535.0
    ambient = np.full((HEIGHT, WIDTH), AMBIENT)
    frames = circle(COVERING, ambient=AMBIENT)
    found = separate(frames, references={Lighting.AMBIENT: ambient, Lighting.OPEN: whole})
    assert max(errors(found)) < 60.0


@pytest.mark.parametrize("noise", [100.0, 1000.0])
def test_what_noise_leaves_in_the_components_is_stated(noise: float) -> None:
    frames = circle(COVERING)
    rng = np.random.default_rng(6)
    scans = [
        separate([counts(f + rng.normal(0, noise, f.shape)) for f in frames]) for _ in range(5)
    ]
    lit = scene()[0] > 0
    for name, plane in (("direct", "direct_std"), ("global_", "global_std")):
        real = np.std([getattr(scan, name) for scan in scans], axis=0, ddof=1)[lit]
        stated = np.mean([scan.planes[plane] for scan in scans], axis=0)[lit]
        assert 0.8 < np.nanmedian(stated) / (np.nanmedian(real) / 0.833) < 1.25
    assert "direct_std" not in separate(frames, averaged=False).planes


def test_the_hole_fraction_is_the_part_of_the_time_that_places_are_lit() -> None:
    found = separate(circle(COVERING, ambient=AMBIENT), None)
    assert found.facts["hole_fraction"] == pytest.approx(MESH.hole_fraction, rel=0.03)
    assert found.facts["hole_fraction_from"] == "frames"


def test_frames_that_are_not_this_meshs_are_told_by_how_long_places_are_lit() -> None:
    def told(frames: Sequence[NDArray[Any]], beta: float) -> bool:
        lines = separate(frames, beta).facts["advice"]
        return any(line.startswith("places are lit for") for line in lines)

    mesh = circle(COVERING, noise=300.0)
    assert not told(mesh, MESH.hole_fraction)
    assert told(mesh, 0.5)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    direct, indirect = scene()
    checkers = [
        counts((((y + 3 * i) // 8 + (x + 3 * j) // 8) % 2) * direct + indirect / 2)
        for i, j in np.ndindex(5, 5)
    ]
    stick = [counts(direct * (np.abs(x - k) > 6) + indirect) for k in range(0, WIDTH, 4)]
    for others in (checkers, stick):
        assert told(others, MESH.hole_fraction)


def test_a_still_mesh_covers_nothing() -> None:
    found = separate([circle(COVERING)[0]] * 4)
    assert found.facts["coverage"] == 0.0
    assert np.isnan(found.direct).all()


def test_one_flash_of_light_is_kept_and_flagged() -> None:
    frames = circle(COVERING, noise=50.0)
    dark = np.min(frames, axis=0)
    spot = np.s_[30:36, 40:46]
    for k, frame in enumerate(frames):
        if k != 20:
            frame[spot] = np.minimum(frame[spot], dark[spot] + 200)
        else:
            frame[spot] = dark[spot] + 24000
    found = separate(frames)
    assert flagged(found, Quality.SINGLE)[spot].mean() > 0.9
    assert (found.planes["coverage"][spot] == 1).mean() > 0.9
    assert flagged(found, Quality.SINGLE).mean() < 0.01


def test_coverage_grows_to_its_end() -> None:
    estimator = MeshOccluder(DEEP, hole_fraction=MESH.hole_fraction)
    seen = []
    for frame in circle(COVERING, noise=100.0):
        estimator.update(frame, Observation())
        seen.append(estimator.summary()["coverage"])
    assert seen[0] == 0.0
    assert seen[20] < 0.9
    assert seen[-1] > 0.97


def test_colour_mosaic_and_tone() -> None:
    frames = circle(COVERING)
    colour = separate([np.repeat(f[..., None], 3, axis=2) for f in frames])
    assert colour.direct.shape == (HEIGHT, WIDTH, 3)
    raw = separate(frames, response=Response(full_scale=65535, bayer="RG"))
    assert raw.direct.shape == (HEIGHT, WIDTH, 3)
    gamma = Response(full_scale=65535, tone="gamma:2.2")
    encoded = [np.rint(65535 * (f / 65535.0) ** (1 / 2.2)).astype(np.uint16) for f in frames]
    assert max(errors(separate(encoded, response=gamma))) < 400.0


def test_a_mosaics_colours_are_judged_among_their_own() -> None:
    """A colour in which noise is large, next to one in which it is not, is no island."""
    of_colour = np.ones((HEIGHT, WIDTH))
    of_colour[1::2, 1::2], of_colour[::2, ::2] = 0.1, 0.4
    rng = np.random.default_rng(5)
    frames = []
    for frame in circle(COVERING):
        light = frame * of_colour
        frames.append(counts(light + rng.normal(0, 1, light.shape) * np.sqrt(20.0 * light)))
    estimator = MeshOccluder(
        Response(full_scale=65535, bayer="RG"), hole_fraction=MESH.hole_fraction
    )
    for frame in frames:
        estimator.update(frame, Observation())
    found = estimator.result()
    assert flagged(found, Quality.NEVER_LIT | Quality.NEVER_UNLIT).mean() < 0.02
    assert found.facts["coverage"] == pytest.approx(estimator.summary()["coverage"], abs=0.02)


def test_without_an_ambient_frame_it_says_what_global_holds() -> None:
    frames = circle(COVERING, noise=650.0, ambient=AMBIENT)
    found = separate(frames)
    assert found.facts["ambient_in_global"] == pytest.approx(1 / MESH.hole_fraction, abs=0.01)
    assert "--references ambient" in found.facts["advice"][0]
    known = separate(frames, references={Lighting.AMBIENT: np.full((HEIGHT, WIDTH), AMBIENT)})
    assert "ambient_in_global" not in known.facts
    assert not any("--references ambient" in line for line in known.facts["advice"])


def test_what_noise_takes_of_direct_is_bounded() -> None:
    noisy = separate(circle(COVERING, noise=1300.0))
    direct, indirect = scene()
    lit = direct > 0
    short = 1 - np.nanmedian(noisy.direct[lit] / direct[lit])
    more = np.nanmedian(noisy.global_[lit] / indirect[lit]) - 1
    pull = noisy.facts["noise_pulls_at_most"]
    assert short < pull["direct"] < 0.12
    assert more < pull["global"] < 0.4
    assert any("may make direct up to" in line for line in noisy.facts["advice"])
    assert not any("may make direct" in line for line in separate(circle(COVERING)).facts["advice"])


@pytest.mark.parametrize("step", [1, 4])  # frames of 5 and 20 degrees
def test_noise_is_the_cameras_however_far_the_mesh_goes_between_frames(step: int) -> None:
    still = StillPlaces(DEEP)
    for frame in circle(COVERING, noise=300.0)[::step]:
        still.add(frame)
    noise = still.noise()
    assert noise is not None
    ratio = noise.deviation(np.array([3000, 9000, 15000])) / 300.0
    assert 0.85 < ratio.min() <= ratio.max() < 1.35


def test_fast_motion_takes_nothing_of_direct() -> None:
    """A mesh that goes far from frame to frame is not noise that a band must be wide for."""
    direct, indirect = scene()
    lit = direct > 0
    found = separate(circle(COVERING, noise=300.0)[::4])
    assert np.nanmedian(found.direct[lit] / direct[lit]) == pytest.approx(1.0, abs=0.01)
    assert np.nanmedian(found.global_[lit] / indirect[lit]) == pytest.approx(1.0, abs=0.02)


def test_the_umbra_is_not_taken_at_its_darkest_moment() -> None:
    """Light of the rest of the scene goes up and down by some per cent as the mesh moves."""
    _, indirect = scene()
    frames = circle(COVERING)
    going = 0.06 * np.sin(np.arange(len(frames)) * 2.4)
    moved = [
        counts(f + g * MESH.hole_fraction * indirect) for f, g in zip(frames, going, strict=True)
    ]
    errors_of = [errors(separate(moved, averaged=a)) for a in (True, False)]
    assert errors_of[0][1] < 0.75 * errors_of[1][1]


def test_the_same_observations_give_the_same_bits() -> None:
    frames = circle(COVERING, noise=300.0)
    one, other = (MeshOccluder(DEEP, hole_fraction=0.3) for _ in range(2))
    for k, frame in enumerate(frames):
        one.update(frame, Observation())
        one.summary()
        if k % 10 == 5:
            one.result()
    for frame in frames:
        other.update(frame.copy(), Observation())
    a, b = one.result(), other.result()
    assert a.direct.tobytes() == b.direct.tobytes()
    assert a.global_.tobytes() == b.global_.tobytes()
    assert a.quality.tobytes() == b.quality.tobytes()
