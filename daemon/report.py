"""report.html: one file that shows a run to a person. Nothing is loaded from anywhere."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import resources
from string import Template
from typing import Any
from urllib.parse import quote

import cv2
import msgspec
import numpy as np

from daemon.display import Picture
from daemon.frames import FrameRecord
from daemon.quality import BITS, Bit
from daemon.separation.finish import ADVICE
from daemon.store import RunFile
from protocol.messages.runs import Product
from protocol.scans import AnyScan, OccluderScan, PatternScan

_ADVISED_FROM = 0.005  # of the pixels: a bit on fewer is not worth a line of advice
_DIM_BELOW = 0.25  # of full scale: a scene that uses less than this is under-exposed
_MOST_BARS = 240
_MANY_LOST = 0.1  # of a video's frames
_FOOTER = (
    "Pictures are for eyes: sRGB, all at one scale, clipped. The measurements are in the TIFF "
    "files: linear, float32, NaN where nothing was measured."
)
_TITLES = {
    "frame": "as the camera saw the scene",
    "direct": "light that came straight from the source",
    "global": "light that came by way of the scene",
    "quality": "flagged pixels in colour",
}


Records = Sequence[FrameRecord]


@dataclass(frozen=True, slots=True)
class Subject:
    """What a report is about. `pictures`: sRGB, from frame, direct, global, quality; `facts`: of
    quality.json; `white`: linear counts that the pictures show as white."""

    file: RunFile
    facts: Mapping[str, Any]
    pictures: Mapping[str, Picture]
    records: Sequence[FrameRecord] = ()
    products: Sequence[Product] = ()
    white: float = 1.0
    full_scale: float = 1.0
    timings: Mapping[str, float] = field(default_factory=dict)


def render(subject: Subject) -> str:
    """The page, as HTML."""
    file = subject.file
    body = Template(template("report_separation.html")).substitute(
        advice="".join(f"<li>{escape(line)}</li>" for line in advice(subject)),
        viewer=_viewer(subject),
        legend=_legend(subject.facts),
        histogram=_histogram(subject),
        exposure=escape(_exposure(subject)),
        pace=_pace(subject.records),
        settings=table(_settings(subject)),
        calibration=calibration(file),
        timings=table(timed(file, subject.timings)),
        missing=missing(subject.records),
        rig=table(flat(file.rig)),
        versions=table(file.versions.items()),
        facts=table(flat(_plain_facts(subject.facts))),
        files=files(subject.products),
    )
    return page(file, _figures(subject), body, _FOOTER)


def page(file: RunFile, figures: str, body: str, footer: str) -> str:
    """A run's page around its body; `figures` and `body` are HTML."""
    return Template(template("report.html")).substitute(
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
    return resources.files("daemon").joinpath(name).read_text("utf-8")


def advice(subject: Subject) -> list[str]:
    """What to do for a better result, the most important first; never empty."""
    file, facts = subject.file, subject.facts
    lines = []
    if file.planned and file.recorded + file.missing < file.planned:
        lines.append(
            f"Only {file.recorded} of {file.planned} frames were taken: "
            "resume the run, or scan again."
        )
    if file.missing:
        total = file.recorded + file.missing
        slower = isinstance(file.spec, OccluderScan) and file.missing > _MANY_LOST * total
        lines.append(
            f"{file.missing} of {total} frames were lost, and what they would have covered with "
            "them: scan again at a lower --frame-rate-hz, or on a machine with less to do."
            if slower
            else f"{_frames(file.missing)} missing: see below why, then scan again."
        )
    if file.rejected:
        lines.append(f"{_frames(file.rejected)} recorded but not used: see below why.")
    lines += facts.get("advice", [])  # the estimator's own
    for bit in _seen(facts):
        share = _share(facts, bit.name)
        said = ADVICE[bit.flag][1] if bit.flag in ADVICE else None
        if share >= _ADVISED_FROM and not (said and any(said in line for line in lines)):
            lines.append(f"{_percent(share)} of the pixels: {_lower(bit.meaning)} {bit.remedy}")
    top = subject.white / subject.full_scale
    bracketed = isinstance(file.spec, PatternScan) and file.spec.bracket is not None
    if top < _DIM_BELOW and not bracketed and _share(facts, "saturated") < _ADVISED_FROM:
        lines.append(
            f"The scene uses {_percent(top)} of the camera's scale: "
            f"an exposure about {0.8 / top:.0f} times as long would lower the noise."
        )
    lines += (file.sequencing or {}).get("warnings", [])
    lines += calibration_advice(file)
    return lines or ["Nothing to mend: well exposed, all frames taken, few pixels flagged."]


# ---------------------------------------------------------------- parts


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


def _figures(subject: Subject) -> str:
    file, facts = subject.file, subject.facts
    planned = f" of {file.planned}" if file.planned else ""
    found = [("frames", f"{file.recorded}{planned}", "")]
    if file.missing or file.rejected:
        found.append(("missing · rejected", f"{file.missing} · {file.rejected}", "warn"))
    found.append(("pixels without a flag", _percent(facts.get("good", {}).get("fraction")), ""))
    rate = subject.timings.get("rate_hz")
    if rate:
        found.append(("pace", f"{rate:.3g} frames/s", ""))
    truth = facts.get("truth")
    if truth:
        for name in ("direct", "global"):
            error = _percent(truth[f"rmse_{name}"])
            also = " with ambient light" if name == "global" and "global_holds" in truth else ""
            found.append((f"of full scale: RMS error of {name}{also}", error, ""))
    return "".join(
        f'<div class="{kind}"><b>{escape(value)}</b><span>{escape(name)}</span></div>'
        for name, value, kind in found
    )


def _viewer(subject: Subject) -> str:
    shown = [name for name in _TITLES if name in subject.pictures]
    views = {"compare": "Direct | global"} | {name: name.capitalize() for name in shown}
    inputs = "".join(
        f'<input type="radio" name="v" id="v-{name}"{" checked" if name == "compare" else ""}>'
        for name in views
    )
    tabs = "".join(f'<label for="v-{name}">{title}</label>' for name, title in views.items())
    figures = "".join(
        f'<figure class="{name}">'
        f'<img src="{_data_uri(subject.pictures[name])}" alt="{name}: {_TITLES[name]}">'
        f"<figcaption><b>{name.capitalize()}</b><span>{_TITLES[name]}</span>"
        f"{_key(subject.facts) if name == 'quality' else ''}</figcaption></figure>"
        for name in shown
    )
    height, width = subject.pictures["direct"].shape[:2]
    return (
        f'<div class="viewer">{inputs}<div class="tabs">{tabs}</div>'
        f'<div class="screen" style="aspect-ratio:{width}/{height}">{figures}</div></div>'
    )


def _key(facts: Mapping[str, Any]) -> str:
    """The colours in the overlay, the most frequent first."""
    return "".join(
        f'<span class="key"><i style="background:{bit.hex}"></i>{_name(bit)}</span>'
        for bit in _seen(facts)
    )


def _legend(facts: Mapping[str, Any]) -> str:
    seen = _seen(facts)
    rows = "".join(
        f'<li><i style="background:{bit.hex}"></i><div><b>{_name(bit)}</b>'
        f"<em>{_percent(_share(facts, bit.name))}</em><p>{escape(bit.meaning)}</p>"
        f'<p class="do">{escape(bit.remedy)}</p></div></li>'
        for bit in seen
    )
    absent = ", ".join(_name(bit) for bit in BITS if bit not in seen)
    legend = f'<ul class="legend">{rows}</ul>' if rows else "<p>No pixel is flagged.</p>"
    return legend + (f'<p class="quiet">On no pixel: {absent}.</p>' if absent else "")


def _histogram(subject: Subject) -> str:
    """Bars of the square root of counts, over the camera's scale."""
    shown = subject.facts.get("exposure_histogram")
    if not shown or not any(shown["counts"]):
        return '<p class="quiet">There is no histogram.</p>'
    counts = np.sqrt(np.asarray(shown["counts"], dtype=np.float64))
    heights = 120 * counts / counts.max()
    step = 640 / len(heights)
    bars = "".join(
        f'<rect class="{"hot" if i == len(heights) - 1 else "bar"}" x="{i * step + 0.5:.1f}" '
        f'y="{120 - h:.1f}" width="{step - 1:.1f}" height="{h:.1f}"/>'
        for i, h in enumerate(heights)
        if h > 0
    )
    ticks = "".join(
        f'<line x1="{640 * q}" y1="0" x2="{640 * q}" y2="124"/>'
        f'<text x="{640 * q}" y="139" text-anchor="{anchor}">{shown["to"] * q:.0f}</text>'
        for q, anchor in ((0, "start"), (0.25, "middle"), (0.5, "middle"), (0.75, "middle"),
                          (1, "end"))
    )  # fmt: skip
    return (
        '<svg viewBox="-2 -2 644 146" role="img" aria-label="Histogram of the exposure">'
        f'<g class="axis">{ticks}</g><g class="bars">{bars}</g></svg>'
    )


def _exposure(subject: Subject) -> str:
    saturated = _share(subject.facts, "saturated")
    ending = f"{_percent(saturated)} saturated" if saturated else "none saturated"
    return (
        "The brightest sample of each pixel over all frames, in linear counts; "
        f"bar height: square root of the number. {ending.capitalize()}."
    )


def _pace(records: Sequence[FrameRecord]) -> str:
    """Intervals between exposures, as bars; what is missing in red."""
    taken = [r for r in records if not r.missing and r.start_ns]
    if len(taken) < 3:
        return ""
    starts = np.array([r.start_ns for r in taken], dtype=np.int64)
    between = np.diff(starts) / 1e6
    between = between[between > 0]
    if not between.size:
        return ""
    groups = np.array_split(between, min(_MOST_BARS, len(between)))
    heights = np.array([g.max() for g in groups])
    top = max(float(heights.max()), 1e-9)
    step = 640 / len(heights)
    bars = "".join(
        f'<rect x="{i * step:.1f}" y="{60 - 60 * h / top:.1f}" width="{max(step - 1, 0.6):.1f}" '
        f'height="{60 * h / top:.1f}"/>'
        for i, h in enumerate(heights)
    )
    middle, late = np.percentile(between, [50, 95])
    return (
        "<h3>Pace</h3>"
        '<svg viewBox="0 0 640 62" role="img" aria-label="Time between frames">'
        f'<g class="bars">{bars}</g></svg>'
        f'<p class="quiet">Time from one frame to the next, in order: median {middle:.1f} ms, '
        f"95 % within {late:.1f} ms, longest {top:.1f} ms.</p>"
    )


def _settings(subject: Subject) -> Iterable[tuple[str, Any]]:
    first = next((r for r in subject.records if not r.missing), None)
    if first:
        if first.exposure_us:
            own_us = first.exposure_us / first.observation.exposure
            yield "exposure", f"{own_us / 1e3:.4g} ms"
        yield "gain", f"{first.gain:g}"
    for key in ("estimator", "lit_fraction", "leakage", "black_level", "tone", "full_scale"):
        if key in subject.facts:
            yield key, subject.facts[key]
    yield from in_step(subject.file)
    known = {"method", "note", "exposure_us", "gain", "lit_fraction", "estimator", "radiometry"}
    known.add("mode")
    yield from ((key, value) for key, value in _told(subject.file.spec) if key not in known)
    yield "pictures show as white", f"{subject.white:.4g} counts"


def _told(spec: AnyScan) -> Iterable[tuple[str, Any]]:
    """A spec's fields that have a value; of what has fields of its own, those that were given."""
    for key, value in msgspec.to_builtins(spec).items():
        if isinstance(value, dict) and key != "radiometry":
            unchanged = msgspec.to_builtins(type(getattr(spec, key))())
            yield from (
                (f"{key}: {name}", part) for name, part in value.items() if part != unchanged[name]
            )
        elif value is not None:
            yield key, value


def in_step(file: RunFile) -> Iterable[tuple[str, Any]]:
    """How exposures were kept in step with patterns."""
    if file.sequencing is not None:
        yield "mode", f"{file.sequencing['mode']}: {file.sequencing['why']}"
        for name, count in file.sequencing["counts"].items():
            yield f"exposures {name}", count


def asked(file: RunFile) -> Iterable[tuple[str, Any]]:
    """What a run was told."""
    unsaid = {"method", "note", "points"}
    yield from ((key, value) for key, value in _told(file.spec) if key not in unsaid)
    yield from file.rig.get("settings", {}).items()


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


def timed(file: RunFile, timings: Mapping[str, float]) -> Iterable[tuple[str, str]]:
    """Timings in words."""
    for name, value in {**file.timings, **timings}.items():
        if name.endswith("_s"):
            yield name[:-2], f"{value:.3f} s" if value >= 1 else f"{value * 1e3:.1f} ms"
        elif name.endswith("_hz"):
            yield name[:-3], f"{value:.4g} a second"
        else:
            yield name, f"{value:g}"


def missing(records: Records) -> str:
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
        f"<em>{_frames(len(where))}</em>"
        f'<p class="do">{escape(_ranges(where))}</p></li>'
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


def files(products: Sequence[Product]) -> str:
    """Links to the products."""
    return "".join(
        f'<li><a href="./{quote(p.file)}">{escape(p.file)}</a>'
        f"<span>{_size(p.bytes)}{f' · {escape(p.unit)}' if p.unit else ''}</span></li>"
        for p in products
    )


# ---------------------------------------------------------------- words and numbers


def table(rows: Iterable[tuple[str, Any]]) -> str:
    """Names and values."""
    made = "".join(
        f"<tr><th>{escape(str(k).replace('_', ' '))}</th><td>{escape(_value(v))}</td></tr>"
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


def _plain_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    shown_elsewhere = {"exposure_histogram", "quality", "units", "good"}
    return {k: v for k, v in facts.items() if k not in shown_elsewhere}


def _value(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(_value(v) for v in value)
    return str(value)


def _share(facts: Mapping[str, Any], name: str) -> float:
    found = facts.get("quality", {}).get(name, {})
    return float(found.get("fraction", 0.0))


def _seen(facts: Mapping[str, Any]) -> list[Bit]:
    """Bits on any pixel, the most frequent first."""
    seen = [bit for bit in BITS if _share(facts, bit.name) > 0]
    return sorted(seen, key=lambda bit: -_share(facts, bit.name))


def _name(bit: Bit) -> str:
    return bit.name.replace("_", " ")


def _percent(share: float | None) -> str:
    if share is None or not math.isfinite(share):
        return "unknown"
    if 0 < share < 0.0001:
        return "< 0.01 %"
    return f"{100 * share:.3g} %" if share < 0.9995 or share == 1 else "> 99.9 %"


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _frames(number: int) -> str:
    return "1 frame" if number == 1 else f"{number} frames"


def _lower(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:]


def _ranges(numbers: Sequence[int]) -> str:
    """3, 7–9, 12"""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    shown = [str(a) if a == b else f"{a}–{b}" for a, b in runs[:12]]
    return ", ".join(shown) + (" …" if len(runs) > 12 else "")


def _data_uri(picture: Picture) -> str:
    """JPEG with colour at full resolution: the overlay's lone coloured pixels must not fade."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 92]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)
    if not done:
        raise ValueError(f"a picture of {picture.shape} cannot be encoded")
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
