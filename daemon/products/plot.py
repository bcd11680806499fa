"""Plots as SVG and as CSV: curves of a `Measurement`, for eyes and for spreadsheets."""

from __future__ import annotations

import csv
import io
import math
from html import escape

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Curve, Plot

WIDTH, HEIGHT = 640, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 14, 10, 44
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#6b6b6b")
_MARKED = 64  # a curve of more points is a line only


def as_csv(plot: Plot) -> str:
    """One line a point: the curve's name, x, y, and the standard deviation ("" where unknown)."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(["curve", plot.x, plot.y, "standard deviation"])
    for curve in plot.curves:
        deviations = [""] * len(curve.x) if curve.sd is None else [_g(sd) for sd in curve.sd]
        for x, y, sd in zip(curve.x, curve.y, deviations, strict=True):
            out.writerow([curve.name, _g(float(x)), _g(float(y)), sd])
    return text.getvalue()


def as_svg(plot: Plot) -> str:
    """The plot with axes, error bars of one standard deviation, and a legend; coloured for both
    light and dark pages. NaN leaves a gap."""
    x_axis = _Axis(_spread([c.x for c in plot.curves]), _LEFT, WIDTH - _RIGHT, plot.log_x)
    lows = [c.y - (c.sd if c.sd is not None else 0) for c in plot.curves]
    highs = [c.y + (c.sd if c.sd is not None else 0) for c in plot.curves]
    low, high = _spread([*lows, *highs])
    if plot.from_zero:
        low, high = min(0.0, low), max(0.0, high)
    pad = 0.06 * (high - low or 1.0)
    low = low if plot.from_zero and low == 0 else low - pad
    y_axis = _Axis((low, high + pad), HEIGHT - _BOTTOM, _TOP)
    parts = [_grid(x_axis, y_axis)]
    for index, curve in enumerate(plot.curves):
        parts.append(_drawn(curve, _COLOURS[index % len(_COLOURS)], x_axis, y_axis))
    middle = (_TOP + HEIGHT - _BOTTOM) / 2
    labels = (
        f'<text x="{(_LEFT + WIDTH - _RIGHT) / 2}" y="{HEIGHT - 6}" text-anchor="middle">'
        f"{escape(plot.x)}</text>"
        f'<text transform="translate(13 {middle}) rotate(-90)" text-anchor="middle">'
        f"{escape(plot.y)}</text>"
    )
    return (
        f'<figure class="plot"><figcaption>{escape(plot.title)}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(plot.title)}">'
        f"{''.join(parts)}{labels}</svg>{_legend(plot)}</figure>"
    )


class _Axis:
    """From values to places on the page."""

    def __init__(
        self, ends: tuple[float, float], start: float, stop: float, log: bool = False
    ) -> None:
        low, high = ends
        self.log = log and low > 0
        if not high > low:
            low, high = (low / 2, low * 2) if self.log else (low - 0.5, low + 0.5)
        self.low, self.high, self.start, self.stop = low, high, start, stop

    def at(self, value: float) -> float:
        if self.log:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.stop - self.start)

    def ticks(self) -> list[float]:
        if self.log:
            found = [
                m * 10.0**e
                for e in range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)))
                for m in (1, 2, 5)
            ]
            return [t for t in [*found, self.high] if self.low <= t <= self.high]
        rough = (self.high - self.low) / 5
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
        first = math.ceil(self.low / step - 1e-9)
        return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]


def _grid(x: _Axis, y: _Axis) -> str:
    parts = []
    for tick in x.ticks():
        at = x.at(tick)
        parts.append(
            f'<line x1="{at:.1f}" y1="{_TOP}" x2="{at:.1f}" y2="{HEIGHT - _BOTTOM}"/>'
            f'<text x="{at:.1f}" y="{HEIGHT - _BOTTOM + 15}" text-anchor="middle">{_g(tick)}</text>'
        )
    for tick in y.ticks():
        at = y.at(tick)
        parts.append(
            f'<line x1="{_LEFT}" y1="{at:.1f}" x2="{WIDTH - _RIGHT}" y2="{at:.1f}"/>'
            f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{_g(tick)}</text>'
        )
    return f'<g class="axis">{"".join(parts)}</g>'


def _drawn(curve: Curve, colour: str, x: _Axis, y: _Axis) -> str:
    places = [
        (x.at(float(a)), y.at(float(b))) if math.isfinite(b) else None
        for a, b in zip(curve.x, curve.y, strict=True)
    ]
    parts = []
    if curve.line is not None:
        offset, slope = curve.line
        ends = (float(curve.x.min()), float(curve.x.max()))
        (x1, y1), (x2, y2) = ((x.at(e), y.at(offset + slope * e)) for e in ends)
        parts.append(
            f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" '
            f'stroke="{colour}" stroke-width="1.2" opacity=".6"/>'
        )
    else:
        for piece in _pieces(places):
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in piece)
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.4"/>'
            )
    if len(places) <= _MARKED:
        for k, place in enumerate(places):
            if place is None:
                continue
            px, py = place
            if curve.sd is not None and math.isfinite(curve.sd[k]):
                reach = abs(y.at(float(curve.y[k] + curve.sd[k])) - py)
                parts.append(
                    f'<line x1="{px:.1f}" y1="{py - reach:.1f}" x2="{px:.1f}" '
                    f'y2="{py + reach:.1f}" stroke="{colour}" stroke-width="1"/>'
                )
            parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="2.6" fill="{colour}"/>')
    return "".join(parts)


def _pieces(
    places: list[tuple[float, float] | None],
) -> list[list[tuple[float, float]]]:
    """Runs of places without a gap."""
    found: list[list[tuple[float, float]]] = [[]]
    for place in places:
        if place is None:
            found.append([])
        else:
            found[-1].append(place)
    return [piece for piece in found if len(piece) > 1]


def _legend(plot: Plot) -> str:
    if len(plot.curves) < 2:
        return ""
    keys = "".join(
        f'<span class="key"><i style="background:{_COLOURS[i % len(_COLOURS)]}"></i>'
        f"{escape(curve.name)}</span>"
        for i, curve in enumerate(plot.curves)
    )
    return f'<p class="keys">{keys}</p>'


def _spread(arrays: list[NDArray[np.float64]]) -> tuple[float, float]:
    values = np.concatenate([np.atleast_1d(a) for a in arrays]) if arrays else np.zeros(1)
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def _g(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else ""
