"""What a measurement leaves: its figures, its curves, its planes, and a report.

calibration.json or measurement.json   the figures; of a calibration what applies is `values`
PLOT.csv                               the curves of a plot
PLANE.tiff                             planes
report.html                            for eyes
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from string import Template
from typing import Any

import msgspec

from daemon import report
from daemon.durable import Damaged
from daemon.plot import as_csv, as_svg
from daemon.separation.estimator import Measurement
from daemon.staging import Staging, as_json, tiff
from daemon.store import RunFile, RunFolder
from protocol.messages.runs import Product

FACTS = ("calibration", "measurement")


def write(
    folder: RunFolder,
    measurement: Measurement,
    *,
    records: report.Records = (),
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


def render(
    file: RunFile,
    measurement: Measurement,
    records: report.Records,
    products: tuple[Product, ...],
    timings: Mapping[str, float],
) -> str:
    """The report as HTML."""
    facts = measurement.facts
    figures = "".join(
        f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>"
        for name, value in facts.get("figures", ())
    )
    shown = {
        key: value
        for key, value in facts.items()
        if key not in {"figures", "advice", "criteria", "commands"}
    }
    body = Template(report.template("report_measurement.html")).substitute(
        advice="".join(f"<li>{escape(line)}</li>" for line in _advice(file, facts)),
        commands=_commands(facts),
        plots="".join(f"<section>{as_svg(plot)}</section>" for plot in measurement.plots.values()),
        criteria=_criteria(facts),
        facts=report.table(report.flat(_short(shown))),
        calibration=report.calibration(file),
        missing=report.missing(records),
        timings=report.table(report.timed(file, timings)),
        files=report.files(products),
        rig=report.table(report.flat(file.rig)),
        versions=report.table(file.versions.items()),
        settings=report.table([*report.asked(file), *report.in_step(file)]),
    )
    return report.page(file, figures, body, "Every point of the plots is in the CSV files.")


def _advice(file: RunFile, facts: Mapping[str, Any]) -> list[str]:
    lines = [*facts.get("advice", ()), *report.calibration_advice(file)]
    return lines or ["Nothing to mend."]


def _commands(facts: Mapping[str, Any]) -> str:
    lines = "".join(f"<pre>{escape(command)}</pre>" for command in facts.get("commands", ()))
    return f"<section><h2>Ready to run</h2>{lines}</section>" if lines else ""


def _criteria(facts: Mapping[str, Any]) -> str:
    rows = "".join(
        f'<tr class="{"met" if c["met"] else "unmet"}"><th>{escape(c["criterion"])}</th>'
        f"<td>{escape(c['measured'])}</td><td>{'met' if c['met'] else 'not met'}</td></tr>"
        for c in facts.get("criteria", ())
    )
    if not rows:
        return ""
    return f'<section><h2>Criteria</h2><table class="criteria">{rows}</table></section>'


def _short(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Figures without long lists, which are in the files."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            found[key] = _short(value)
        elif isinstance(value, list | tuple) and (len(value) > 16 or _tabular(value)):
            found[key] = f"{len(value)} values, see the files"
        else:
            found[key] = value
    return found


def _tabular(value: list[Any] | tuple[Any, ...]) -> bool:
    return any(isinstance(item, Mapping | list | tuple) for item in value)


__all__ = ["FACTS", "read", "render", "write"]
