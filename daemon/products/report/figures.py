"""Drawings of a separation's report: the exposure's histogram, and the pace of its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from daemon.storage.frames import FrameRecord

_MOST_BARS = 240


def histogram(shown: Mapping[str, Any] | None) -> str:
    """Bars of the square root of counts, over the camera's scale."""
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


def pace(records: Sequence[FrameRecord]) -> str:
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
        f"95% within {late:.1f} ms, longest {top:.1f} ms.</p>"
    )
