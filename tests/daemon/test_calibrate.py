"""Calibrations recover what synthetic frames were made with, within the deviation stated."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.calibrate_leak import checkers
from daemon.separation.dark import Dark
from daemon.separation.estimator import Lighting, Measurement, NotYet, Observation
from daemon.separation.latency import Latency
from daemon.separation.leak import Leak
from daemon.separation.radiometry import Response
from daemon.separation.tone_curve import ToneCurve, inverted
from daemon.separation.transfer import PhotonTransfer
from protocol.patterns import BLACK, WHITE

BLACK_LEVEL, GAIN, READ = 64.0, 2.5, 1.5  # counts, e- a count, counts
RESPONSE = Response(full_scale=4095, black=BLACK_LEVEL)
SHAPE = (96, 128)
RNG = np.random.default_rng(7)
X = np.linspace(0.2, 1.0, SHAPE[1], dtype=np.float32)[None, :]
SCENE = np.asarray(np.repeat(X, SHAPE[0], axis=0) * 3000, dtype=np.float32)  # counts under white


def shot(light: NDArray[Any]) -> NDArray[np.uint16]:
    """A frame of a camera with these counts of light."""
    electrons = RNG.poisson(np.maximum(light, 0) * GAIN)
    counts = electrons / GAIN + RNG.normal(BLACK_LEVEL, READ, light.shape)
    return np.asarray(np.clip(np.rint(counts), 0, 4095), dtype=np.uint16)


def test_dark_finds_black_level_read_noise_and_hot_pixels() -> None:
    estimator = Dark(4095, 4)
    warm = np.zeros(SHAPE)
    warm[5, 7], warm[40, 90] = 40.0, 25.0  # counts at the longest exposure
    for exposure in (2000.0, 4000.0, 8000.0, 16000.0):
        for n in range(8):
            frame = np.rint(RNG.normal(BLACK_LEVEL + warm * exposure / 16000, READ)).astype(
                np.uint16
            )
            seen = Observation(last=n == 7, exposure_us=exposure)
            estimator.update(frame, seen)
    measured = estimator.result()
    assert measured.facts["black_counts"] == pytest.approx(BLACK_LEVEL, abs=0.05)
    assert measured.facts["read_noise_counts"] == pytest.approx((READ**2 + 1 / 12) ** 0.5, rel=0.02)
    assert measured.facts["hot_pixels"] == 2
    assert measured.planes["hot"][5, 7] == measured.planes["hot"][40, 90] == 1


def test_dark_tells_the_black_level_from_light_that_still_arrives() -> None:
    estimator = Dark(4095, 3)
    for exposure in (4000.0, 8000.0, 16000.0):
        for n in range(6):
            seen = Observation(last=n == 5, exposure_us=exposure)
            estimator.update(shot(SCENE * exposure / 16000 * 0.02), seen)
    measured = estimator.result()
    assert measured.facts["black_counts"] == pytest.approx(BLACK_LEVEL, abs=0.1)
    assert measured.facts["read_noise_counts"] == pytest.approx(READ, rel=0.05)
    assert measured.facts["hot_pixels"] is None
    assert "cover the lens" in measured.facts["advice"][0]


def test_a_camera_that_does_not_expose_as_told_is_named() -> None:
    estimator = Dark(4095, 3)
    for _ in range(3):
        for n in range(4):
            estimator.update(shot(SCENE), Observation(last=n == 3, exposure_us=10_000.0))
    with pytest.raises(NotYet, match="it exposed for 10 ms each time, whatever it was told"):
        estimator.result()


def test_photon_transfer_finds_gain_and_read_noise() -> None:
    estimator = PhotonTransfer(RESPONSE)
    for level in range(1, 7):
        for n in range(9):
            estimator.update(shot(SCENE * level / 6), Observation(pattern=level, last=n == 8))
    facts = estimator.result().facts
    assert abs(facts["gain_e_per_count"] - GAIN) < 4 * facts["gain_sd"]
    assert facts["gain_sd"] < 0.03
    assert abs(facts["read_noise_counts"] - READ) < 4 * facts["read_noise_sd_counts"]
    assert facts["values"]["noise"]["counts_per_e"] == pytest.approx(1 / GAIN, rel=0.02)


def test_photon_transfer_of_one_level_is_refused() -> None:
    estimator = PhotonTransfer(RESPONSE)
    for _ in range(3):
        estimator.update(shot(np.full(SHAPE, 900.0)), Observation(pattern=0))
    with pytest.raises(NotYet, match="--exposure"):
        estimator.result()


def leak_run(b: float, blur: float, average: int = 2) -> Measurement:
    """A flat scene, half direct and half global, a projector that leaks and is out of focus."""
    sizes = (16, 8, 6, 3, 1)
    sets = [checkers(size) for size in sizes]
    estimator = Leak(RESPONSE, sizes, tuple(len(one) for one in sets))
    direct, others, ambient = 0.6 * SCENE, 0.4 * SCENE, 0.03 * SCENE

    def seen(pattern: Any) -> NDArray[np.uint16]:
        image = patterns.render(pattern, SHAPE[1], SHAPE[0]) / np.float32(255)
        sent = np.asarray(b + (1 - b) * image, dtype=np.float32)
        if blur:
            blurred = cv2.GaussianBlur(sent, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
            sent = np.asarray(blurred, dtype=np.float32)
        return shot(direct * sent + others * sent.mean() + ambient)

    for _ in range(8):
        estimator.update(shot(ambient), Observation(lighting=Lighting.AMBIENT))
        estimator.update(seen(BLACK), Observation(lighting=Lighting.BLACK))
        estimator.update(seen(WHITE), Observation(lighting=Lighting.WHITE))
    for index, pattern in enumerate(p for one in sets for p in one):
        for n in range(average):
            estimator.update(seen(pattern), Observation(pattern=index, last=n == average - 1))
    return estimator.result()


def test_leak_is_found_within_its_stated_deviation() -> None:
    facts = leak_run(0.06, blur=0.8).facts
    assert abs(facts["leakage"] - 0.06) < 3 * facts["leakage_sd"]
    assert facts["leakage_sd"] < 0.002
    by_size = {row["size"]: row for row in facts["by_size"]}
    assert not by_size[1]["measurable"]  # 1-pixel patches: §3.5
    assert by_size[8]["leakage"] == pytest.approx(0.06, abs=0.01)
    assert by_size[3]["leakage"] > by_size[6]["leakage"] > 0.06
    assert all(size != 1 for size, *_ in facts["values"]["leakage_by_size"])


def test_a_sharp_projector_leaks_alike_at_every_size() -> None:
    facts = leak_run(0.1, blur=0.0).facts
    for row in facts["by_size"]:
        assert row["leakage"] == pytest.approx(0.1, abs=0.02)
        assert row["measurable"]


def test_tone_finds_a_gamma_and_its_inverse() -> None:
    levels = (*(k / 32 for k in range(1, 32)), 1.0)
    estimator = ToneCurve(RESPONSE, levels)

    def seen(level: float) -> NDArray[np.uint16]:
        return shot(SCENE * (0.04 + 0.96 * level**2.2))

    for lighting, level in ((Lighting.WHITE, 1.0), (Lighting.BLACK, 0.0)):
        for _ in range(4):
            estimator.update(seen(level), Observation(lighting=lighting))
    for index, level in enumerate(levels):
        estimator.update(seen(level), Observation(pattern=index))
    measured = estimator.result()
    assert measured.facts["gamma"] == pytest.approx(2.2, abs=0.01)
    tone = measured.facts["values"]["tone"]
    assert len(tone) == 256
    assert (tone[0], tone[255]) == (0, 255)
    ramp = np.arange(256, dtype=np.uint8)[None, :]
    light = (patterns.predistorted(ramp, tone)[0] / 255.0) ** 2.2
    assert np.abs(light - np.linspace(0, 1, 256)).max() < 0.006  # the projector's own 256 levels


def test_a_level_whose_last_frame_is_missing_is_measured_by_the_others() -> None:
    levels = (0.25, 0.5, 0.75, 1.0)
    estimator = ToneCurve(RESPONSE, levels)
    for lighting, level in ((Lighting.WHITE, 1.0), (Lighting.BLACK, 0.0)):
        estimator.update(shot(SCENE * level), Observation(lighting=lighting))
    for index, level in enumerate(levels):
        for sub in range(1 if index == 1 else 2):  # the second of the second level never comes
            seen = Observation(pattern=index, last=sub == 1)
            estimator.update(shot(SCENE * level), seen)
    assert estimator.result().facts["departure_from_linear"] < 0.005


def test_a_response_that_is_flat_somewhere_has_an_inverse() -> None:
    levels = np.linspace(0, 1, 5)
    tone = inverted(levels, np.asarray([0.0, 0.3, 0.3, 0.29, 1.0]))
    assert tone == sorted(tone)
    assert (tone[0], tone[255]) == (0, 255)


def flashes(latency_us: float, jitter_us: float = 0.0, exposure: float = 8000.0) -> Latency:
    """Flashes seen by a camera whose projector is late."""
    estimator = Latency(RESPONSE, 50_000.0)
    estimator.update(shot(SCENE * 0.05), Observation(lighting=Lighting.BLACK))
    estimator.update(shot(SCENE), Observation(lighting=Lighting.WHITE))
    for n, delay in enumerate(np.linspace(0, 50_000, 60)):
        change = latency_us + RNG.normal(0, jitter_us) if jitter_us else latency_us
        part = float(np.clip((delay + exposure - change) / exposure, 0, 1))
        seen = Observation(pattern=2 * n + 1, delay_us=float(delay), exposure_us=exposure)
        estimator.update(shot(SCENE * (0.05 + 0.95 * part)), seen)
    return estimator


def test_latency_is_found_with_its_spread() -> None:
    facts = flashes(21_300.0, jitter_us=400.0).result().facts
    assert facts["latency_ms"] == pytest.approx(21.3, abs=0.5)
    assert 0.15 < facts["spread_ms"] < 0.8
    assert facts["values"]["latency_s"] > facts["latency_ms"] / 1e3


def test_a_projector_that_is_on_time_is_not_waited_for() -> None:
    facts = flashes(0.0).result().facts
    assert facts["values"]["latency_s"] == 0.0
    assert "before the first exposure" in facts["from"]


def test_a_change_before_the_first_exposure_is_a_bound_and_no_measurement() -> None:
    estimator = Latency(RESPONSE, 50_000.0)
    estimator.update(shot(SCENE * 0.05), Observation(lighting=Lighting.BLACK))
    estimator.update(shot(SCENE), Observation(lighting=Lighting.WHITE))
    for n, delay in enumerate((900.0, 534.0, 20_000.0)):
        seen = Observation(pattern=2 * n + 1, delay_us=delay, exposure_us=8000.0)
        estimator.update(shot(SCENE), seen)
    facts = estimator.result().facts
    unknown = ("latency_ms", "spread_ms", "least_ms", "greatest_ms")
    assert [facts[name] for name in unknown] == [None] * 4
    assert facts["at_most_ms"] == facts["wait_ms"] == 0.534
    assert facts["values"] == {"latency_s": 0.000534}  # safe: it had come by then
    figures = dict(facts["figures"])
    assert figures["later than the driver says"] == "at most 0.534 ms"
    assert figures["spread"] == "unknown"
    (line,) = facts["advice"]
    assert "not measured" in line
    assert "Later scans wait for that bound (0.534 ms)" in line
    measured = flashes(21_300.0).result().facts
    assert measured["at_most_ms"] is None


def test_a_flash_that_never_comes_is_said() -> None:
    with pytest.raises(NotYet, match="--longest-ms"):
        flashes(1e9).result()
