"""What a measurement leaves: its figures, its curves, its planes, and a report.

calibration.json or measurement.json   the figures; of a calibration what applies is `values`
PLOT.csv                               the curves of a plot
PLANE.tiff                             planes
report.html                            for eyes
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from daemon.products.plot import as_csv
from daemon.products.report.measurement import render
from daemon.separation.estimator import Measurement
from daemon.storage.durable import Damaged
from daemon.storage.frames import FrameRecord
from daemon.storage.runfolder import RunFolder
from daemon.storage.staging import Staging, as_json, tiff
from protocol.messages.runs import Product

FACTS = ("calibration", "measurement")


def write(
    folder: RunFolder,
    measurement: Measurement,
    *,
    records: Sequence[FrameRecord] = (),
    timings: Mapping[str, float] | None = None,
) -> tuple[Product, ...]:
    """Write all products of a measurement, durably; earlier ones of the same names are replaced.

    Raises StorageError; then the run has the products that it had.
    """
    staging = Staging(folder.path)
    facts = {**measurement.facts, "calibration": folder.file.calibration or {}}
    try:
        name = measurement.name
        staging.add(name, "facts", f"{name}.json", as_json(facts))
        for name, plot in measurement.plots.items():
            staging.add(name, "curves", f"{name}.csv", as_csv(plot).encode())
        for name, plane in measurement.planes.items():
            staging.add(name, "image", f"{name}.tiff", tiff(plane))
        page = render(folder.file, measurement, records, tuple(staging.products), timings or {})
        staging.add("report", "report", "report.html", page.encode())
        staging.publish()
    finally:
        staging.clear()
    return tuple(staging.products)


def read(folder: RunFolder) -> Measurement | None:
    """The figures of a run that has ended, without curves and planes; None if it measured nothing.

    Raises Damaged for a file that is no longer what was written.
    """
    name = next((p.name for p in folder.file.products if p.name in FACTS), None)
    if name is None:
        return None
    path = folder.product(name)
    try:
        return Measurement(msgspec.json.decode(path.read_bytes(), type=dict[str, Any]), name=name)
    except msgspec.DecodeError as error:
        raise Damaged(f"{path} cannot be read ({error}); measure again") from error
