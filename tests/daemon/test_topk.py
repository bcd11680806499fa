"""Separation by the k brightest and darkest samples."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.scans.method import Unsuitable
from daemon.separation.deviation import of_noise
from daemon.separation.estimator import NotYet, Observation
from daemon.separation.extremes import Extremes
from daemon.separation.order_estimate import KEEP
from daemon.separation.order_model import BLURS, RATIOS, OrderModels
from daemon.separation.radiometry import Response
from protocol.scans.anyscan import AnyScan
from protocol.scans.projected import Checkerboard, RandomBinary
from protocol.scans.spec import Radiometry
from tests.daemon.scene import FULL, Scene

NONE: tuple[()] = ()


def plain(blur: float) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """Twelve patterns that light a place in the first six, without edges."""
    del blur
    return np.repeat(np.arange(12)[:, None] < 6, 400, axis=1).astype(np.float32)


def ranking(response: Response) -> Extremes:
    """The five brightest and darkest of `plain` patterns, less their bias."""
    return Extremes(response, lit_fraction=0.5, leakage=0.0, keep=KEEP, unbiased=True, levels=plain)


def bias(spec: AnyScan, scene: Scene) -> tuple[float, float, float]:
    """Mean and scatter of the error of direct, and mean of that of global, by full scale; borders
    left out, where the small scene is lit unevenly."""
    found = scene.scan(spec)
    inside = np.s_[8:-8, 8:-8]
    direct = ((found.direct - scene.direct) / FULL)[inside]
    indirect = ((found.global_ - scene.indirect) / FULL)[inside]
    return float(direct.mean()), float(direct.std()), float(indirect.mean())


@pytest.mark.parametrize("sigma", [0.005, 0.02])
@pytest.mark.parametrize("kind", [Checkerboard, RandomBinary])
def test_the_bias_of_max_min_is_gone(
    kind: type[Checkerboard] | type[RandomBinary], sigma: float
) -> None:
    scene = Scene(sigma=sigma)
    paper = bias(kind(estimator="maxmin", references=NONE), scene)
    ranked = bias(kind(estimator="topk", references=NONE), scene)
    assert paper[0] > 2.5 * sigma
    assert abs(ranked[0]) < 0.3 * sigma
    assert abs(ranked[2]) < 0.35 * sigma
    assert ranked[1] < paper[1]


@pytest.mark.parametrize("sigma", [0.002, 0.005])
def test_a_black_background_whose_noise_is_cut_off_says_nothing_of_noise(sigma: float) -> None:
    scene = Scene(sigma=sigma, leakage=0.06)
    y, x = np.mgrid[: scene.height, : scene.width]
    thing = ((y - 48) / 44.0) ** 2 + ((x - 64) / 56.0) ** 2 < 1
    scene.albedo_direct = scene.albedo_direct * thing * 0.7
    scene.albedo_global = scene.albedo_global * thing * 0.7
    spec = Checkerboard(references=NONE, radiometry=Radiometry(leakage=0.06))
    error = ((scene.scan(spec).direct - scene.direct) / FULL)[thing]
    assert abs(float(error.mean())) < 0.2 * sigma


def test_what_blur_takes_is_given_back() -> None:
    scene = Scene(sigma=0.003, blur=1.4)
    paper = bias(Checkerboard(estimator="maxmin", references=NONE), scene)
    ranked = bias(Checkerboard(estimator="topk", references=NONE), scene)
    assert paper[0] < -0.01
    assert abs(ranked[0]) < 0.008


def test_the_stated_deviation_is_that_of_repeated_scans() -> None:
    scene = Scene(sigma=0.01, ambient=0.05)
    spec = Checkerboard(references=NONE, average=2)
    runs = [scene.scan(spec, seed=seed) for seed in range(8)]
    for name in ("direct", "global"):
        values = np.stack([r.direct if name == "direct" else r.global_ for r in runs])
        spread = float(np.sqrt(values.var(axis=0, ddof=1).mean()))
        stated = float(np.sqrt((of_noise(runs[0].planes, f"{name}_std") ** 2).mean()))
        assert stated == pytest.approx(spread, rel=0.2), name


def test_black_where_every_count_is_zero_stays_black() -> None:
    estimator = ranking(Response(full_scale=255))
    rng = np.random.default_rng(1)
    for index in range(12):
        frame = np.zeros((96, 128), dtype=np.uint8)
        frame[:, :64] = np.clip(rng.normal(40 + 120 * (index < 6), 4, (96, 64)), 0, 255)
        estimator.update(frame, Observation(pattern=index))
    found = estimator.result()
    assert (found.direct[:, 72:] == 0).all()
    assert (found.global_[:, 72:] == 0).all()
    assert float(found.direct[:, :56].mean()) == pytest.approx(120, abs=1.0)
    assert not (found.direct < 0).any()


def test_blur_is_told_where_noise_is_known() -> None:
    def levels(blur: float) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
        edge = np.random.default_rng(2).uniform(0.0, 6.0, (24, 800))
        lit = np.arange(24)[:, None] < 12
        soft = 0.5 + 0.5 * np.tanh(edge / max(blur, 1e-3))
        return np.where(lit, soft, 1 - soft).astype(np.float32)

    models = OrderModels(levels, KEEP)
    for blur, at in ((0.0, 5), (1.4, 3)):
        model = models._models[BLURS.index(blur)]
        gaps = np.stack([model.gaps[at]] * 4)
        seen = np.full((4, 2), RATIOS[at] / model.step[at])
        place, amount = models.fit(gaps, seen)
        assert models.at(place)[0] == pytest.approx(blur, abs=0.3)
        assert amount == 1.0


def test_before_there_are_ranks_the_extremes_stand() -> None:
    estimator = ranking(Response(full_scale=255))
    estimator.update(np.full((4, 4), 30, dtype=np.uint8), Observation(pattern=0))
    with pytest.raises(NotYet, match="1 came"):
        estimator.result()
    for index in range(1, 2 * KEEP - 1):
        frame = np.full((4, 4), 30 + 90 * (index % 2), dtype=np.uint8)
        estimator.update(frame, Observation(pattern=index))
    found = estimator.result()
    assert (found.direct == 90).all()
    assert (found.global_ == 60).all()


def test_a_resumed_ranking_gives_the_same_bits() -> None:
    rng = np.random.default_rng(3)
    frames = rng.integers(0, 65536, (12, 40, 48), dtype=np.uint16)
    one, other = (ranking(Response(full_scale=65535)) for _ in range(2))
    for index, frame in enumerate(frames):
        one.update(frame, Observation(pattern=index))
        other.update(frame.copy(), Observation(pattern=index))
        if index == 10:
            one.result()
    a, b = one.result(), other.result()
    assert a.direct.tobytes() == b.direct.tobytes()
    assert a.global_.tobytes() == b.global_.tobytes()
    assert a.planes["direct_std"].tobytes() == b.planes["direct_std"].tobytes()


@pytest.mark.parametrize("patterns", [2, 3, 4])
def test_a_few_patterns_are_compared_without_deviations(patterns: int) -> None:
    """Fewer than four have no order to know of: once a crash."""
    scene = Scene(sigma=0.003)
    found = scene.scan(RandomBinary(patterns=patterns, references=NONE))
    assert found.facts["estimator"] == "maxmin"
    assert ("direct_std" in found.planes) is (patterns >= 4)
    with pytest.raises(Unsuitable, match="takes 4 patterns"):
        scene.scan(RandomBinary(patterns=min(patterns, 3), estimator="maxmin-unbiased"))
