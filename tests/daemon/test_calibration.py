"""Which calibrations apply: the newest of the same devices and settings, and not too old."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from daemon.products import measured
from daemon.runs.calibration import Calibrations
from daemon.separation.estimator import Measurement
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.messages.runs import RunState
from protocol.scans.anyscan import AnyScan
from protocol.scans.calibrations import (
    CalibrateDark,
    CalibrateLatency,
    CalibrateLeak,
    CalibrateTone,
)
from protocol.scans.projected import Checkerboard

RIG: dict[str, Any] = {
    "camera": {"driver": "virtual", "model": "C", "serial": "1"},
    "projector": {"driver": "virtual", "model": "P", "serial": "2"},
}
SETTINGS = {"exposure_us": 1000.0, "gain": 0.0, "pixel_format": "Mono12"}


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path, reserve_bytes=0) as store:
        yield store


def made(
    store: Store, spec: AnyScan, values: dict[str, Any], *, days: float = 0.0, **rig: Any
) -> RunFolder:
    """A calibration run that ended some days ago."""
    run = store.create(spec, {**RIG, "settings": SETTINGS, **rig})
    run.add_products(measured.write(run, Measurement({"values": values}, name="calibration")))
    ended = (datetime.now(UTC) - timedelta(days=days)).isoformat()
    run.update(state=RunState.DONE, ended=ended, submitted=ended)
    return run


def test_the_newest_of_each_kind_applies(store: Store) -> None:
    made(store, CalibrateLeak(), {"leakage": 0.05}, days=3)
    newer = made(store, CalibrateLeak(), {"leakage": 0.06}, days=1)
    made(store, CalibrateDark(), {"black": 63.5})
    found = Calibrations(store, 30).of(RIG, SETTINGS)
    assert found["values"] == {"leakage": 0.06, "black": 63.5}
    assert found["sources"]["leak"]["run"] == newer.id
    assert found["sources"]["leak"]["age_days"] == pytest.approx(1, abs=0.01)
    assert found["ignored"] == []


def test_an_old_one_is_left_out_with_the_reason(store: Store) -> None:
    run = made(store, CalibrateLeak(), {"leakage": 0.05}, days=31)
    found = Calibrations(store, 30).of(RIG, SETTINGS)
    assert found["values"] == {}
    [ignored] = found["ignored"]
    assert (ignored["kind"], ignored["run"]) == ("leak", run.id)
    assert "31.0 days old (calibration.max_age_days: 30)" in ignored["why"]


@pytest.mark.parametrize(
    ("rig", "settings", "why"),
    [
        ({"camera": {**RIG["camera"], "serial": "9"}}, SETTINGS, "another camera: C 1"),
        ({}, {**SETTINGS, "gain": 6.0}, "made with gain 0.0, not 6.0"),
        ({}, {**SETTINGS, "pixel_format": "Mono8"}, "made with pixel format Mono12, not Mono8"),
    ],
)
def test_another_device_or_gain_is_another_calibration(
    store: Store, rig: dict[str, Any], settings: dict[str, Any], why: str
) -> None:
    made(store, CalibrateDark(), {"black": 63.5})
    found = Calibrations(store, 30).of({**RIG, **rig}, settings)
    assert found["values"] == {}
    assert why in found["ignored"][0]["why"]


def test_an_older_one_that_fits_is_taken_before_a_newer_one_that_does_not(store: Store) -> None:
    made(store, CalibrateDark(), {"black": 60.0}, days=2)
    made(store, CalibrateDark(), {"black": 70.0}, settings={**SETTINGS, "gain": 12.0})
    found = Calibrations(store, 30).of(RIG, SETTINGS)
    assert found["values"] == {"black": 60.0}
    assert found["ignored"] == []


def test_what_a_run_measures_is_not_applied_to_it(store: Store) -> None:
    made(store, CalibrateTone(), {"tone": [0, 255]})
    made(store, CalibrateLeak(), {"leakage": 0.05})
    found = Calibrations(store, 30).of(RIG, SETTINGS, CalibrateTone())
    assert found["values"] == {"leakage": 0.05}


def test_a_run_that_failed_or_was_damaged_calibrates_nothing(store: Store) -> None:
    failed = made(store, CalibrateLeak(), {"leakage": 0.05})
    failed.update(state=RunState.FAILED)
    spoilt = made(store, CalibrateDark(), {"black": 60.0})
    (spoilt.path / "calibration.json").write_text("{")
    found = Calibrations(store, 30).of(RIG, SETTINGS)
    assert found["values"] == {}
    assert [one["why"] for one in found["ignored"]] == ["it cannot be read"]


def test_until_a_latency_is_measured_what_the_projector_assumes_is_waited_for(
    store: Store,
) -> None:
    rig = {**RIG, "projector": {**RIG["projector"], "facts": {"assumed_latency_s": 0.1}}}
    calibrations = Calibrations(store, 30)
    found = calibrations.of(rig, SETTINGS, Checkerboard())
    assert found["values"] == {"latency_s": 0.1}
    [told] = found["ignored"]
    assert told["why"] == "never measured; 100 ms are waited for after each flip"
    assert "latency_s" not in calibrations.of(rig, SETTINGS, CalibrateLatency())["values"]
    assert calibrations.of(RIG, SETTINGS, Checkerboard())["values"] == {}
    made(store, CalibrateLatency(), {"latency_s": 0.02})
    found = calibrations.of(rig, SETTINGS, Checkerboard())
    assert found["values"] == {"latency_s": 0.02}
    assert found["ignored"] == []
