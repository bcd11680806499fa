"""The products of a measurement: figures, curves, planes, and a report with plots."""

from __future__ import annotations

import csv
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from daemon.products import measured
from daemon.products.plot import as_csv, as_svg
from daemon.separation.estimator import Curve, Measurement, Plot
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.scans.calibrations import CalibrateLeak

X = np.asarray([1.0, 2.0, 4.0, 8.0])
PLOT = Plot(
    "Leakage <of> patches",
    "side (px)",
    "b",
    (
        Curve("A", X, np.asarray([0.9, np.nan, 0.1, 0.06]), np.full(4, 0.01)),
        Curve("B", X, 0.05 * X, line=(0.0, 0.05)),
    ),
    log_x=True,
)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunFolder]:
    with Store(tmp_path, reserve_bytes=0) as store:
        yield store.create(CalibrateLeak(note="dusty <lens>"), {})


def test_all_products_are_written_and_can_be_read(run: RunFolder) -> None:
    plane = np.arange(12, dtype=np.float32).reshape(3, 4)
    facts = {
        "values": {"leakage": np.float32(0.5)},
        "figures": [["leakage b", "0.06 ± 0.01"]],
        "criteria": [{"criterion": "b < 1", "measured": "2", "met": False}],
        "advice": ["Focus the projector."],
        "commands": ["umbra scan checkerboard --checker 8"],
    }
    measurement = Measurement(facts, {"leakage": PLOT}, {"dark": plane}, name="calibration")
    run.add_products(measured.write(run, measurement))
    names = {p.name: p.kind for p in run.file.products}
    assert names == {
        "calibration": "facts", "leakage": "curves", "dark": "image", "report": "report"
    }  # fmt: skip
    written = msgspec.json.decode((run.path / "calibration.json").read_bytes())
    assert written["values"] == {"leakage": 0.5}
    kept = np.asarray(cv2.imread(str(run.path / "dark.tiff"), cv2.IMREAD_UNCHANGED))
    assert np.array_equal(kept, plane)
    again = measured.read(run)
    assert again is not None
    assert again.facts == written
    page = (run.path / "report.html").read_text()
    for text in ("dusty &lt;lens&gt;", "0.06 ± 0.01", "not met", "Focus the projector.",
                 "--checker 8", "<svg", "leakage.csv"):  # fmt: skip
        assert text in page
    assert "$" not in page.split("</style>")[1]


def test_a_run_without_a_measurement_has_none(run: RunFolder) -> None:
    assert measured.read(run) is None


def test_curves_as_csv() -> None:
    rows = list(csv.reader(as_csv(PLOT).splitlines()))
    assert rows[0] == ["curve", "side (px)", "b", "standard deviation"]
    assert rows[1] == ["A", "1", "0.9", "0.01"]
    assert rows[2] == ["A", "2", "", "0.01"]  # not measured
    assert rows[5] == ["B", "1", "0.05", ""]
    assert len(rows) == 9


def test_a_plot_is_well_formed_and_within_its_frame() -> None:
    figure = ET.fromstring(as_svg(PLOT))
    svg = figure.find("svg")
    assert svg is not None
    circles = svg.findall("circle")
    assert len(circles) == 7  # NaN leaves a gap
    for circle in circles:
        assert 0 <= float(circle.attrib["cx"]) <= 640
        assert 0 <= float(circle.attrib["cy"]) <= 300
    assert {"1", "2", "5", "8"} <= {t.text for t in svg.iter("text")}


@pytest.mark.parametrize("y", [[0.0, 0.0], [5.0, 5.0], [-3.0, 2.0], [np.nan, np.nan]])
def test_a_plot_of_nothing_much_can_be_drawn(y: list[float]) -> None:
    curve = Curve("a", np.asarray([1.0, 1.0]), np.asarray(y))
    assert "nan" not in as_svg(Plot("t", "x", "y", (curve,))).lower()
