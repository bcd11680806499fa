"""A run's page around its body, and the parts that every kind of run shows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from string import Template
from typing import Any
from urllib.parse import quote

import msgspec

from daemon.products.report.words import frames, in_words, ranges, size
from daemon.storage.frames import FrameRecord
from daemon.storage.runfolder import RunFile
from protocol.messages.runs import Product
from protocol.scans.anyscan import AnyScan


def page(file: RunFile, figures: str, body: str, footer: str) -> str:
    """A run's page around its body; `figures` and `body` are HTML."""
    return Template(template("page.html")).substitute(
        title=escape(f"{file.id} · Umbra"),
        id=escape(file.id),
        method=escape(_method(file)),
        note=f'<p class="note">{escape(file.spec.note)}</p>' if file.spec.note else "",
        who=escape(_who(file)),
        figures=figures,
        body=body,
        footer=escape(footer),
    )


def template(name: str) -> str:
    """A page's template."""
    return resources.files("daemon.products.report").joinpath(name).read_text("utf-8")


def _method(file: RunFile) -> str:
    spec = msgspec.to_builtins(file.spec)
    match spec["method"]:
        case "checkerboard":
            return (
                f"Checkerboard: {spec['checker']} px checkers, {spec['shifts']} × "
                f"{spec['shifts']} shifts of {spec['shift']} px"
            )
        case "two-image":
            return f"Two images: a checkerboard of {spec['checker']} px and its complement"
        case "stick":
            return "Stick: an occluder swept over the scene"
        case other:
            return str(other).replace("-", " ").capitalize()


def _who(file: RunFile) -> str:
    when = (file.started or file.submitted)[:19].replace("T", " ") + " UTC"
    made = f"made from {', '.join(file.parents)}" if file.parents else ""
    return " · ".join(part for part in (when, file.by, made) if part)


def table(rows: Iterable[tuple[str, Any]]) -> str:
    """Names and values."""
    made = "".join(
        f"<tr><th>{escape(str(k).replace('_', ' '))}</th><td>{escape(in_words(v))}</td></tr>"
        for k, v in rows
    )
    return f"<table>{made}</table>" if made else '<p class="quiet">Nothing was noted.</p>'


def flat(tree: Mapping[str, Any], path: str = "") -> Iterable[tuple[str, Any]]:
    """A tree of facts as rows."""
    for key, value in tree.items():
        name = f"{path} · {key}" if path else str(key)
        if isinstance(value, Mapping):
            yield from flat(value, name)
        else:
            yield name, value


def files(products: Sequence[Product]) -> str:
    """Links to the products."""
    return "".join(
        f'<li><a href="./{quote(p.file)}">{escape(p.file)}</a>'
        f"<span>{size(p.bytes)}{f' · {escape(p.unit)}' if p.unit else ''}</span></li>"
        for p in products
    )


def of_recording(file: RunFile) -> bool:
    """Whether the frames are photographs or a video: when and with what they were taken is not
    known, and what the run has instead is how fast they were read."""
    return (file.sequencing or {}).get("mode") == "recorded"


def timed(file: RunFile, timings: Mapping[str, float]) -> Iterable[tuple[str, str]]:
    """Timings in words."""
    of_a_rig = {"waited_s", "rate_hz"} if of_recording(file) else set()
    for name, value in {**file.timings, **timings}.items():
        if name in of_a_rig:
            continue
        if name.endswith("_s"):
            yield name[:-2], f"{value:.3f} s" if value >= 1 else f"{value * 1e3:.1f} ms"
        elif name.endswith("_hz"):
            yield name[:-3], f"{value:.4g} a second"
        else:
            yield name, f"{value:g}"


def asked(file: RunFile) -> Iterable[tuple[str, Any]]:
    """What a run was told."""
    unsaid = {"method", "note", "points"}
    yield from ((key, value) for key, value in told(file.spec) if key not in unsaid)
    yield from file.rig.get("settings", {}).items()


def in_step(file: RunFile) -> Iterable[tuple[str, Any]]:
    """How exposures were kept in step with patterns."""
    if file.sequencing is not None and not of_recording(file):
        yield "mode", f"{file.sequencing['mode']}: {file.sequencing['why']}"
        for name, count in file.sequencing["counts"].items():
            yield f"exposures {name}", count


def told(spec: AnyScan) -> Iterable[tuple[str, Any]]:
    """A spec's fields that have a value; of what has fields of its own, those that were given."""
    for key, value in msgspec.to_builtins(spec).items():
        if isinstance(value, dict) and key != "radiometry":
            unchanged = msgspec.to_builtins(type(getattr(spec, key))())
            yield from (
                (f"{key}: {name}", part) for name, part in value.items() if part != unchanged[name]
            )
        elif value not in (None, (), []):
            yield key, value


def calibration(file: RunFile) -> str:
    """What calibration was applied, how old it was, and what was left out."""
    found = file.calibration or {}
    rows = [
        (kind, f"{source['run']}, {source['age_days']:.1f} days old")
        for kind, source in found.get("sources", {}).items()
    ]
    rows += [(kind["kind"], f"not applied: {kind['why']}") for kind in found.get("ignored", ())]
    return f"<section><h2>Calibration applied</h2>{table(rows)}</section>" if rows else ""


def calibration_advice(file: RunFile) -> list[str]:
    """A line for each calibration that could not be applied."""
    return [
        (
            f"The {one['kind']} calibration {one['run']} was not applied: {one['why']}"
            if one["run"]
            else f"The {one['kind']} was {one['why']}"
        )
        + f"; run `umbra calibrate {one['kind']}`."
        for one in (file.calibration or {}).get("ignored", ())
    ]


def missing(records: Sequence[FrameRecord]) -> str:
    """Frames that are missing or were not used, and why."""
    reasons: dict[tuple[str, str], list[int]] = {}
    strengths: dict[str, list[int]] = {}  # of the source, per cent, by what was said of it
    for r in records:
        if r.missing:
            reasons.setdefault(("Missing", r.missing), []).append(r.index)
        elif not r.observation.used:
            why, strength = _without_strength(r.observation.reason)
            reasons.setdefault(("Not used", why), []).append(r.index)
            if strength is not None:
                strengths.setdefault(why, []).append(strength)
    if not reasons:
        return ""
    rows = "".join(
        f"<li><b>{kind}: {escape(_with_range(why, strengths) or 'no reason given')}</b>"
        f"<em>{frames(len(where))}</em>"
        f'<p class="do">{escape(ranges(where))}</p></li>'
        for (kind, why), where in reasons.items()
    )
    return f'<section><h2>Missing and rejected</h2><ul class="missing">{rows}</ul></section>'


_STRENGTH = re.compile(r"source at (\d+)%: (.+)", re.DOTALL)


def _without_strength(reason: str) -> tuple[str, int | None]:
    """A reason, and the source's strength that it began with; None: it has none."""
    said = _STRENGTH.fullmatch(reason)
    return (said[2], int(said[1])) if said else (reason, None)


def _with_range(why: str, strengths: Mapping[str, list[int]]) -> str:
    """A reason with the range of the source's strengths that were grouped under it."""
    if why not in strengths:
        return why
    least, most = min(strengths[why]), max(strengths[why])
    return f"source at {least}{'' if least == most else f' to {most}'}%: {why}"
