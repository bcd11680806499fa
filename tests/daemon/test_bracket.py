"""Exposures merged: exact without noise, without what saturated; and the plan that takes them."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from daemon.scans import catalog
from daemon.scans.method import Bench, Expose, Taken, Unsuitable
from daemon.scans.pattern_scan import PatternMethod
from daemon.separation import mosaic
from daemon.separation.bracket import Bracketed, merge
from daemon.separation.deviation import of_noise
from daemon.separation.estimator import Components, Lighting, NotYet, Observation, Quality
from daemon.separation.exposure_noise import ExposureNoise, Sample, Sensor
from daemon.separation.pair import ComplementPair
from daemon.separation.radiometry import FrameMean, Response
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.scans.anyscan import AnySeparation
from protocol.scans.projected import (
    Checkerboard,
    GrayCode,
    PatternScan,
    RandomBinary,
    RandomPhase,
    SingleImage,
    Sinusoid,
    TwoImage,
)
from protocol.scans.spec import Radiometry, Reference
from tests.daemon.scene import OWN_US
from tests.daemon.virtual_scene import BLACK, FULL, VirtualScene

BRACKET = (0.25, 1.0, 4.0)
UNSURE = Quality.SATURATED | Quality.DARK | Quality.LOW_MODULATION | Quality.RESIDUE

# ---------------------------------------------------------------- the merge


def exposed(light: NDArray[np.float64], factor: float, full: float = 1000.0) -> Sample:
    counts = np.minimum(light * factor, full)
    return Sample(factor, counts.astype(np.float32), counts >= full)


LIGHT = np.geomspace(0.5, 3900.0, 40).reshape(5, 8)


def test_without_noise_the_light_comes_back_over_the_whole_range() -> None:
    merged, saturated, used = merge([exposed(LIGHT, f) for f in (4.0, 0.25, 1.0)], 10.0)
    assert np.allclose(merged, LIGHT, rtol=1e-6)
    assert not saturated.any()
    assert used.tolist() == [40, (LIGHT < 1000).sum(), (LIGHT < 250).sum()]


def test_a_saturated_sample_has_no_say_whatever_it_holds() -> None:
    short, long = exposed(LIGHT, 0.25), exposed(LIGHT, 1.0)
    spilled = Sample(1.0, np.where(long.saturated, np.float32(7.0), long.light), long.saturated)
    assert np.array_equal(merge([short, spilled], 10.0)[0], merge([short, long], 10.0)[0])


def test_only_what_saturates_the_shortest_is_saturated() -> None:
    merged, saturated, _ = merge([exposed(LIGHT, f) for f in (1.0, 4.0)], 10.0)
    assert np.array_equal(saturated, LIGHT >= 1000)
    assert (merged[saturated] == 1000).all()
    assert np.allclose(merged[~saturated], LIGHT[~saturated], rtol=1e-6)


def test_an_rgb_pixel_is_left_out_whole_and_mosaics_sample_by_sample() -> None:
    saturated = np.array([[[True, False, False], [False, False, False]]])
    long = Sample(4.0, np.full((1, 2, 3), 80.0, np.float32), saturated)
    short = Sample(1.0, np.full((1, 2, 3), 10.0, np.float32), np.zeros_like(saturated))
    merged, _, _ = merge([short, long], 1.0)
    assert (merged[0, 0] == 10).all()
    assert (merged[0, 1] > 10).all()
    flat = merge(
        [Sample(s.factor, s.light[..., 0], s.saturated[..., 0]) for s in (short, long)], 1.0
    )
    assert flat[0][0, 0] == 10
    assert flat[0][0, 1] > 10


@pytest.mark.parametrize(
    ("read", "shot", "level"), [(0.5, 0.0, 0.5), (0.5, 0.02, 30.0), (0.3, 0.5, 30.0)]
)
def test_the_merge_has_nearly_the_least_noise_that_there_is(
    read: float, shot: float, level: float
) -> None:
    rng = np.random.default_rng(3)
    light, factors = np.full((300, 300), level), (1.0, 4.0, 16.0)
    samples = []
    for f in factors:
        noisy = light * f + rng.standard_normal(light.shape) * np.sqrt(read**2 + shot * light * f)
        samples.append(Sample(f, noisy.astype(np.float32), np.zeros(light.shape, bool)))
    merged, _, _ = merge(samples, 10.0)
    least = sum(f**2 / (read**2 + shot * level * f) for f in factors) ** -0.5
    assert merged.std() < 1.1 * least
    assert abs(merged.mean() - level) < 0.02 * least


def test_frames_of_one_exposure_count_as_many() -> None:
    one = Sample(1.0, np.array([[10.0]], np.float32), np.array([[False]]), frames=1)
    three = Sample(1.0 + 1e-9, np.array([[14.0]], np.float32), np.array([[False]]), frames=3)
    assert merge([one, three], 1.0)[0][0, 0] == pytest.approx(13.0, rel=1e-4)


# ---------------------------------------------------------------- what exposures tell


@pytest.mark.parametrize(("read", "shot"), [(1.5, 0.02), (0.8, 0.4), (6.0, 0.0)])
def test_two_exposures_tell_the_sensors_noise_and_their_ratio(read: float, shot: float) -> None:
    rng = np.random.default_rng(1)
    response = Response(full_scale=4095, black=64)
    light = np.linspace(5, 900, 160 * 240).reshape(160, 240)
    noise = ExposureNoise(response)
    samples: list[Sample] = []
    for factor, real in ((1.0, 1.0), (4.0, 3.8)):  # the longer one is 5 % shorter than it says
        lit = light * real
        noisy = lit + 64 + rng.standard_normal(light.shape) * np.sqrt(read**2 + shot * lit)
        counts = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
        mean = FrameMean(response)
        mean.add(counts)
        samples.append(Sample(factor, mean.value(), counts >= 4095))
    noise.add(samples[0], samples[1], (1.0, 4.0))
    found = noise.sensor()
    for level in (10.0, 300.0, 3000.0):
        real_sd = np.sqrt(read**2 + 1 / 12 + shot * level)
        assert np.sqrt(found.read + found.shot * level) == pytest.approx(real_sd, rel=0.1)
    assert noise.ratios()[1.0, 4.0] == pytest.approx(3.8, rel=0.005)
    assert noise.source == "exposures compared"


def test_a_calibrated_sensor_is_believed() -> None:
    noise = ExposureNoise(Response(full_scale=255), Sensor(2.0, 0.1))
    assert noise.sensor() == Sensor(2.0, 0.1)
    assert noise.source == "calibration"


# ---------------------------------------------------------------- before an estimator


def pair(average: int = 1, response: Response | None = None) -> Bracketed:
    return Bracketed(
        response or Response(full_scale=255),
        lambda merged: ComplementPair(merged, lit_fraction=0.5, leakage=0.0),
        factors=(1.0, 4.0),
        average=average,
    )


def seen(pattern: int, exposure: float, last: bool, **more: object) -> Observation:
    return Observation(pattern=pattern, exposure=exposure, last=last, **more)  # type: ignore[arg-type]


def counts(level: int) -> NDArray[np.uint8]:
    return np.full((6, 8), level, np.uint8)


def test_a_pattern_counts_once_when_all_its_exposures_are_in() -> None:
    estimator = pair()
    estimator.update(counts(40), seen(0, 1.0, last=False))
    estimator.update(counts(160), seen(0, 4.0, last=True))
    assert estimator.summary()["frames"] == 1
    estimator.update(counts(40), seen(1, 4.0, last=False))  # to and fro
    estimator.update(counts(10), seen(1, 1.0, last=True))
    found = estimator.result()
    assert isinstance(found, Components)
    assert np.allclose(found.direct, 30)
    assert np.allclose(found.global_, 20)
    assert found.facts["bracket"]["used"] == {"1": 1.0, "4": 1.0}


def test_a_lost_frame_costs_one_exposure_and_not_the_pattern() -> None:
    estimator = pair()
    estimator.update(counts(40), seen(0, 1.0, last=False))
    with pytest.raises(NotYet):  # the long one is missing; the next pattern closes it
        estimator.result()
    estimator.update(counts(40), seen(1, 4.0, last=False))
    before = estimator.summary()
    found = estimator.result()  # of the last pattern nothing closes it: what there is must do
    assert isinstance(found, Components)
    assert np.allclose(found.direct, 30)
    assert estimator.summary() == before  # asking changes nothing


def test_exposures_are_as_long_as_the_camera_says() -> None:
    estimator = Bracketed(
        Response(full_scale=255),
        lambda merged: ComplementPair(merged, lit_fraction=0.5, leakage=0.0),
        factors=(1.0, 4.0),
        own_us=1000.0,
    )
    for pattern, level in enumerate((40, 10)):
        estimator.update(counts(level), seen(pattern, 1.0, last=False, exposure_us=1000.0))
        estimator.update(counts(3 * level), seen(pattern, 4.0, last=True, exposure_us=3000.0))
    found = estimator.result()
    assert isinstance(found, Components)
    assert np.allclose(found.direct, 30)


def test_what_cannot_be_merged_is_refused() -> None:
    with pytest.raises(ValueError, match="no exposure 2"):
        pair().update(counts(1), seen(0, 2.0, last=True))
    with pytest.raises(ValueError, match="no warp"):
        pair().update(counts(1), seen(0, 1.0, last=True, strength=0.5))


def test_encoded_counts_are_merged_as_light() -> None:
    response = Response(full_scale=255, tone="srgb")
    estimator = pair(response=response)
    light = np.array([4.0, 60.0])
    for pattern, scale in enumerate((1.0, 0.25)):
        for exposure in (1.0, 4.0):
            encoded = response.counts((light * scale * exposure).astype(np.float32))
            pixels = np.rint(np.clip(encoded, 0, 255)).astype(np.uint8)
            estimator.update(
                np.repeat(pixels[None], 4, 0), seen(pattern, exposure, last=exposure == 4.0)
            )
    found = estimator.result()
    assert isinstance(found, Components)
    assert np.allclose(found.direct[0], light * 0.75, rtol=0.03)


# ---------------------------------------------------------------- the plan


def plan(spec: PatternScan, bench: Bench) -> list[Expose]:
    method = catalog.method_for(spec, bench)  # type: ignore[arg-type]
    steps: list[Expose] = []
    while (step := method.step(len(steps), {})) is not None:
        assert isinstance(step, Expose)
        steps.append(step)
    return steps


def live(low: float = 1.0, high: float = 1e9) -> Bench:
    camera = CameraInfo(64, 48, PixelFormat.MONO8, exposure_range_us=(low, high))
    return Bench(camera, ProjectorInfo(64, 48, 60.0), exposure_us=OWN_US)


def recorded(count: int) -> Bench:
    return Bench(CameraInfo(64, 48, PixelFormat.MONO8, recorded=True, frame_count=count))


def test_a_live_scan_goes_to_and_fro_and_takes_each_pattern_in_one_go() -> None:
    steps = plan(TwoImage(bracket=BRACKET, average=2), live())
    assert [s.exposure for s in steps] == [0.25, 1, 4, 4, 1, 0.25] * 2
    assert [s.lighting for s in steps[:6:3]] == [Lighting.BLACK, Lighting.WHITE]
    assert [s.index for s in steps[6:]] == [0, 0, 0, 1, 1, 1]
    assert [s.exposure_us for s in steps[:3]] == [2500.0, None, 40_000.0]
    assert all(s.frames == 2 for s in steps)


def test_a_recording_has_each_patterns_images_in_the_brackets_order() -> None:
    spec = TwoImage(bracket=(4.0, 1.0), references=(Reference.BLACK,), average=2)
    steps = plan(spec, recorded(2 + 8))
    assert [(s.lighting, s.index, s.exposure, s.frames) for s in steps] == [
        (Lighting.BLACK, 0, 4.0, 1),
        (Lighting.BLACK, 0, 1.0, 1),
        (Lighting.PATTERN, 0, 4.0, 2),
        (Lighting.PATTERN, 0, 1.0, 2),
        (Lighting.PATTERN, 1, 4.0, 2),
        (Lighting.PATTERN, 1, 1.0, 2),
    ]
    assert all(s.exposure_us is None for s in steps)
    with pytest.raises(Unsuitable, match=r"has 5 images; .* each at the 2 exposures 4, 1 .*need 4"):
        plan(TwoImage(bracket=(4.0, 1.0)), recorded(5))


def test_the_last_frame_of_a_pattern_is_that_of_its_last_exposure() -> None:
    method = catalog.method_for(TwoImage(bracket=(1.0, 4.0), references=(), average=2), live())
    last = []
    for index in range(4):
        step = method.step(index, {})
        assert isinstance(step, Expose)
        for sub in range(2):
            last.append(method.observe(step, Taken(index, sub, incomplete=False)).last)
    assert last == [False, False, False, True] * 2


@pytest.mark.parametrize(
    ("bracket", "bench", "match"),
    [
        ((1.0, 16.0), live(high=100_000), r"16 times 10000 us is beyond .* 0.0001 to 10 \(--br"),
        ((0.1, 1.0), live(low=5_000), r"0.1 times 10000 us"),
        ((1.0, 1.0), live(), "named once"),
    ],
)
def test_exposures_that_cannot_be_are_refused_with_the_remedy(
    bracket: tuple[float, ...], bench: Bench, match: str
) -> None:
    with pytest.raises(Unsuitable, match=match) as refused:
        plan(TwoImage(bracket=bracket), bench)
    assert refused.value.where == "$.bracket"


# ---------------------------------------------------------------- every method, on a scene

LEVEL = 1.6
"""Of the camera's scale: what reflects most is far beyond it at the run's own exposure."""

SCENE = VirtualScene(width=160, height=120, level=LEVEL)
LEAK = Radiometry(leakage=0.02)


def truth() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    whole = SCENE.operator.light(np.ones((SCENE.height, SCENE.width), np.float32))
    direct, others = SCENE.operator.render(whole, "RG")
    scale = np.float32(LEVEL * (FULL - BLACK))
    return direct * scale, others * scale


METHODS: list[AnySeparation] = [
    Checkerboard(estimator="maxmin"),
    Checkerboard(),
    TwoImage(average=2),
    Sinusoid(phases=8),
    RandomPhase(phases=4),
    RandomBinary(),
    GrayCode(),
    SingleImage(stripe=2, reduce=2),
]


def with_bracket(spec: AnySeparation, bracket: tuple[float, ...] | None) -> AnySeparation:
    return replace(spec, bracket=bracket, radiometry=LEAK)


@pytest.mark.parametrize("spec", METHODS, ids=lambda s: f"{type(s).__name__}-{s.average}")
def test_highlights_come_back_with_every_method(spec: AnySeparation) -> None:
    alone = SCENE.scan(with_bracket(spec, None))
    found = SCENE.scan(with_bracket(spec, BRACKET))
    clipped = (alone.quality & np.uint16(Quality.SATURATED)) != 0
    assert clipped.mean() > 0.05
    assert (found.quality & np.uint16(Quality.SATURATED) != 0).mean() < 0.002
    whole, lost = found.direct + found.global_, alone.direct + alone.global_
    assert np.nanmax(whole) > 1.05 * (FULL - BLACK)  # beyond the scale of the run's own exposure
    bright = clipped & np.isfinite(whole).all(axis=-1) & np.isfinite(lost).all(axis=-1)
    if not isinstance(spec, SingleImage):
        direct, others = truth()
        true = mosaic.demosaic(direct, "RG") + mosaic.demosaic(others, "RG")
        off, was = (np.sqrt(np.mean(np.square((w - true)[bright]))) for w in (whole, lost))
        assert off < 0.04 * np.median(true[bright])
        assert off < 0.35 * was


def test_a_dim_scene_has_less_noise() -> None:
    dim = VirtualScene(width=160, height=120, level=0.1)
    spec = TwoImage(radiometry=LEAK)
    spreads = []
    for bracket in (None, (1.0, 4.0)):
        scans = [dim.scan(with_bracket(spec, bracket), seed=seed) for seed in range(4)]
        stack = np.stack([scan.direct for scan in scans])
        spreads.append(float(np.median(stack.std(axis=0, ddof=1))))
    assert spreads[1] < 0.55 * spreads[0]  # five times the light


@pytest.mark.parametrize(
    "spec",
    [TwoImage(), Sinusoid(phases=8), GrayCode(), RandomPhase(phases=4)],
    ids=lambda s: type(s).__name__,
)
def test_the_stated_deviation_is_the_real_one(spec: AnySeparation) -> None:
    count = 6
    scans = [SCENE.scan(with_bracket(spec, BRACKET), seed=seed) for seed in range(count)]
    assert scans[0].facts["noise_from"] == "exposures compared"
    good = np.all([(scan.quality & np.uint16(UNSURE)) == 0 for scan in scans], axis=0)
    light = np.mean([scan.direct + scan.global_ for scan in scans], axis=0)[good]
    third, twothirds = np.quantile(light, [1 / 3, 2 / 3])
    for name, plane in (("direct", "direct_std"), ("global_", "global_std")):
        real = np.stack([getattr(scan, name) for scan in scans]).var(axis=0, ddof=1)[good]
        stated = np.stack([of_noise(scan.planes, plane) for scan in scans]).mean(axis=0)[good]
        for part in (light < third, light >= twothirds):  # few exposures there, many here
            mean = np.median(real[part]) / (1 - 2 / (9 * (count - 1))) ** 3
            assert 0.8 < np.median(stated[part]) / np.sqrt(mean) < 1.25, name


def test_a_fresh_estimator_has_nothing_of_the_one_before() -> None:
    method = catalog.method_for(TwoImage(bracket=BRACKET), SCENE.bench())
    assert isinstance(method, PatternMethod)
    first, second = method.estimator(), method.estimator()
    step = method.step(0, {})
    assert isinstance(step, Expose)
    seen_once = method.observe(step, Taken(0, 0, incomplete=False))
    first.update(SCENE.frame(step, np.random.default_rng(1)), seen_once)
    assert second.summary() == method.estimator().summary()
