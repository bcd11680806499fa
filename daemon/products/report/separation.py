"""The report of a run that separates."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from string import Template
from typing import Any

import cv2
import numpy as np

from daemon.pictures.display import Picture
from daemon.products.quality import BITS, Bit
from daemon.products.report.figures import histogram, pace
from daemon.products.report.page import (
    calibration,
    calibration_advice,
    files,
    flat,
    in_step,
    missing,
    of_recording,
    page,
    table,
    template,
    timed,
    told,
)
from daemon.products.report.words import frames, percent
from daemon.storage.frames import FrameRecord
from daemon.storage.runfolder import RunFile
from protocol.messages.runs import Product
from protocol.scans.occluded import OccluderScan
from protocol.scans.projected import PatternScan

_ADVISED_FROM = 0.005  # of the pixels: a bit on fewer is not worth a word of advice
_DIM_BELOW = 0.25  # of full scale: a scene that uses less than this is under-exposed
_MANY_LOST = 0.1  # of a video's frames
_OF_A_RIG = {"auto_exposure", "coverage", "frame_rate_hz", "sweeps", "time_limit_s"}
"""Of a scan: how photographs were taken does not follow from it."""
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
    body = Template(template("separation.html")).substitute(
        advice="".join(f"<li>{escape(line)}</li>" for line in advice(subject)),
        viewer=_viewer(subject),
        legend=_legend(subject.facts),
        histogram=histogram(subject.facts.get("exposure_histogram")),
        exposure=escape(_exposure(subject)),
        pace="" if of_recording(file) else pace(subject.records),
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
            else f"{frames(file.missing)} missing: see below why, then scan again."
        )
    if file.rejected:
        lines.append(f"{frames(file.rejected)} recorded but not used: see below why.")
    lines += map(_sentence, facts.get("advice", ()))  # the estimator's own
    flagged = [bit for bit in _seen(facts) if _share(facts, bit.name) >= _ADVISED_FROM]
    if flagged:
        named = ", ".join(f"{_name(bit)} {percent(_share(facts, bit.name))}" for bit in flagged)
        lines.append(f"Flags of the pixels, explained under Quality: {named}.")
    top = subject.white / subject.full_scale
    bracketed = isinstance(file.spec, PatternScan) and file.spec.bracket is not None
    if top < _DIM_BELOW and not bracketed and _share(facts, "saturated") < _ADVISED_FROM:
        lines.append(
            f"The scene uses {percent(top)} of the camera's scale: "
            f"an exposure about {0.8 / top:.0f} times as long would lower the noise."
        )
    lines += (file.sequencing or {}).get("warnings", [])
    lines += calibration_advice(file)
    return lines or ["Nothing to mend: well exposed, all frames taken, few pixels flagged."]


def _sentence(line: str) -> str:
    """A line that the command says after a colon."""
    return f"{line[0].upper()}{line[1:].removesuffix('.')}."


def _figures(subject: Subject) -> str:
    file, facts = subject.file, subject.facts
    planned = f" of {file.planned}" if file.planned else ""
    found = [("frames", f"{file.recorded}{planned}", "")]
    if file.missing or file.rejected:
        found.append(("missing · rejected", f"{file.missing} · {file.rejected}", "warn"))
    found.append(("pixels without a flag", percent(facts.get("good", {}).get("fraction")), ""))
    rate = subject.timings.get("rate_hz")
    if rate and not of_recording(file):
        found.append(("pace", f"{rate:.3g} frames/s", ""))
    truth = facts.get("truth")
    if truth:
        for name in ("direct", "global"):
            error = percent(truth[f"rmse_{name}"])
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
        f'<span class="key"><i style="background:{bit.colour}"></i>{_name(bit)}</span>'
        for bit in _seen(facts)
    )


def _legend(facts: Mapping[str, Any]) -> str:
    seen = _seen(facts)
    rows = "".join(
        f'<li><i style="background:{bit.colour}"></i><div><b>{_name(bit)}</b>'
        f"<em>{escape(percent(_share(facts, bit.name)))}</em><p>{escape(bit.meaning)}</p>"
        f'<p class="do">{escape(bit.remedy)}</p></div></li>'
        for bit in seen
    )
    absent = ", ".join(_name(bit) for bit in BITS if bit not in seen)
    legend = f'<ul class="legend">{rows}</ul>' if rows else "<p>No pixel is flagged.</p>"
    return legend + (f'<p class="quiet">On no pixel: {absent}.</p>' if absent else "")


def _exposure(subject: Subject) -> str:
    saturated = _share(subject.facts, "saturated")
    ending = f"{percent(saturated)} saturated" if saturated else "none saturated"
    return (
        "The brightest sample of each pixel over all frames, in linear counts; "
        f"bar height: square root of the number. {ending.capitalize()}."
    )


def _settings(subject: Subject) -> Iterable[tuple[str, Any]]:
    photographs = of_recording(subject.file)
    first = next((r for r in subject.records if not r.missing), None)
    if first:
        if first.exposure_us:
            own_us = first.exposure_us / first.observation.exposure
            yield "exposure", f"{own_us / 1e3:.4g} ms"
        if not photographs:
            yield "gain", f"{first.gain:g}"
    for key in ("estimator", "lit_fraction", "leakage", "black_level", "tone", "full_scale"):
        if key in subject.facts:
            yield key, subject.facts[key]
    yield from in_step(subject.file)
    known = {"method", "note", "exposure_us", "gain", "lit_fraction", "estimator", "radiometry"}
    known |= {"mode"} | (_OF_A_RIG if photographs else set())
    yield from ((key, value) for key, value in told(subject.file.spec) if key not in known)
    yield "pictures show as white", f"{subject.white:.4g} counts"


def _plain_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    shown_elsewhere = {"advice", "exposure_histogram", "quality", "units", "good"}
    return {k: v for k, v in facts.items() if k not in shown_elsewhere}


def _share(facts: Mapping[str, Any], name: str) -> float:
    found = facts.get("quality", {}).get(name, {})
    return float(found.get("fraction", 0.0))


def _seen(facts: Mapping[str, Any]) -> list[Bit]:
    """Bits on any pixel, the most frequent first."""
    seen = [bit for bit in BITS if _share(facts, bit.name) > 0]
    return sorted(seen, key=lambda bit: -_share(facts, bit.name))


def _name(bit: Bit) -> str:
    return bit.name.replace("_", " ")


def _data_uri(picture: Picture) -> str:
    """JPEG with colour at full resolution: the overlay's lone coloured pixels must not fade."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 92]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)
    if not done:
        raise ValueError(f"a picture of {picture.shape} cannot be encoded")
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
