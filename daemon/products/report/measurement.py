"""The report of a run that measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from string import Template
from typing import Any

from daemon.products.plot import as_svg
from daemon.products.report.page import (
    asked,
    calibration,
    calibration_advice,
    files,
    flat,
    in_step,
    missing,
    page,
    table,
    template,
    timed,
)
from daemon.separation.estimator import Measurement
from daemon.storage.frames import FrameRecord
from daemon.storage.runfolder import RunFile
from protocol.messages.runs import Product


def render(
    file: RunFile,
    measurement: Measurement,
    records: Sequence[FrameRecord],
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
    body = Template(template("measurement.html")).substitute(
        advice="".join(f"<li>{escape(line)}</li>" for line in _advice(file, facts)),
        commands=_commands(facts),
        plots="".join(f"<section>{as_svg(plot)}</section>" for plot in measurement.plots.values()),
        criteria=_criteria(facts),
        facts=table(flat(_short(shown))),
        calibration=calibration(file),
        missing=missing(records),
        timings=table(timed(file, timings)),
        files=files(products),
        rig=table(flat(file.rig)),
        versions=table(file.versions.items()),
        settings=table([*asked(file), *in_step(file)]),
    )
    return page(file, figures, body, "Every point of the plots is in the CSV files.")


def _advice(file: RunFile, facts: Mapping[str, Any]) -> list[str]:
    lines = [*facts.get("advice", ()), *calibration_advice(file)]
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
