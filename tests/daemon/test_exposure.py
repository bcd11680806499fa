"""Exposure and gain that fill the scale: gain is low wherever an exposure can be had instead."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daemon.separation.exposure import Settings, filling

REFRESH_US = 1e6 / 60
NOW = Settings(
    exposure_us=REFRESH_US,
    exposure_range_us=(10.0, 1e7),
    refresh_hz=60.0,
    gain=0.0,
    gain_range=(0.0, 24.0),
    gain_unit="dB",
)


def test_what_is_right_stays() -> None:
    setting = filling(NOW, 1.05)
    assert (setting.exposure_us, setting.gain, setting.level, setting.noise) == (None, None, 1, 1)


def test_a_dim_picture_is_exposed_for_whole_refreshes() -> None:
    setting = filling(NOW, 4.5)
    assert setting.exposure_us == pytest.approx(4 * REFRESH_US)
    assert setting.gain is None
    assert setting.level == pytest.approx(4.0)
    assert setting.noise == pytest.approx(2.0)  # shot noise: the root of the light


def test_gain_is_traded_for_exposure() -> None:
    setting = filling(replace(NOW, gain=12.0), 1.0)
    assert setting.gain == 0.0
    assert setting.exposure_us == pytest.approx(3 * REFRESH_US)  # 12 dB are a factor of 3.98
    assert setting.noise < 0.5


def test_gain_does_what_the_longest_exposure_leaves() -> None:
    setting = filling(NOW, 240.0)
    assert setting.exposure_us == pytest.approx(1e6)
    assert setting.gain == pytest.approx(12.04, abs=0.01)
    assert setting.level == pytest.approx(240.0, rel=1e-3)
    assert filling(NOW, 1e6).gain == 24.0  # and no more than there is


def test_speeds_are_linear() -> None:
    setting = filling(replace(NOW, gain=800.0, gain_range=(100.0, 6400.0), gain_unit="ISO"), 1.0)
    assert setting.gain == 100.0
    assert setting.exposure_us == pytest.approx(8 * REFRESH_US, rel=0.2)


def test_a_gain_in_unknown_steps_is_left_alone() -> None:
    setting = filling(replace(NOW, gain=200.0, gain_range=(0.0, 1023.0), gain_unit=""), 2.0)
    assert setting.gain is None
    assert setting.exposure_us == pytest.approx(2 * REFRESH_US)


def test_a_bright_picture_is_exposed_more_briefly() -> None:
    setting = filling(NOW, 0.5)
    assert setting.exposure_us == pytest.approx(REFRESH_US / 2)  # within one refresh: any length
    assert filling(replace(NOW, exposure_range_us=(15_000.0, 1e6)), 0.5).exposure_us == 15_000.0
