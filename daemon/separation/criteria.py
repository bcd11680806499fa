"""What the verification experiments of §3.5 come to: curves, and the paper's findings beside them.

The paper's own findings are quoted as criteria; where it gives no figure (`straight`, `robust`) the
limit is ours and is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from daemon.separation.estimator import Curve, Measurement, Plot
from daemon.separation.sampling import line
from daemon.separation.verification import Reading

Rows = list[list[Reading]]
Points = list[dict[str, Any]]

LIMIT = 0.10
"""The paper's: less than 10 % variation."""


def patch_size(sizes: Sequence[int], rows: Rows, points: Points) -> Measurement:
    """Figure 4(b): L_g(p) / L_g(3) stays within 10 % for p in 3..11."""
    x = np.asarray(sizes, dtype=np.float64)
    reference = int(np.argmin(np.abs(x - 3)))
    within = (x >= 3) & (x <= 11)
    curves, criteria = [], []
    for row, point in zip(rows, points, strict=True):
        light, sd = _values(row)
        unit = light[reference] if abs(light[reference]) > 0 else np.nan
        curves.append(Curve(point["name"], x, light / unit, sd / abs(unit)))
        variation = float(np.max(np.abs(light / unit - 1.0)[within]))
        noise = float(np.max((sd / abs(unit))[within]))
        point |= {"global": _list(light), "sd": _list(sd), "variation": round(variation, 4)}
        criteria.append(
            _criterion(
                f"{point['name']}: L_g varies by less than 10 % for p in 3..11",
                f"{variation:.1%} (noise {noise:.1%})",
                variation < LIMIT,
            )
        )
    plot = Plot(
        "Global component against the size of the unlit patch (Fig. 4b)",
        "p, side of the unlit patch (projector px)",
        f"L_g(p) / L_g({sizes[reference]})",
        tuple(curves),
    )
    local = [p["name"] for p in points if p["variation"] >= LIMIT]
    advice = [
        f"{', '.join(local)}: global light changes within a few pixels, as in dense marble: there "
        "it must be sampled more finely than these patches do, and a separation counts a part of "
        "it as direct."
    ] if local else []  # fmt: skip
    return _measured(rows, points, {"patch_size": plot}, criteria, advice)


def random_patterns(rows: Rows, points: Points) -> Measurement:
    """Figure 4(c): the global component does not depend on which patches are lit."""
    criteria = []
    means, spreads = [], []
    for row, point in zip(rows, points, strict=True):
        light, sd = _values(row)
        mean, spread = float(light.mean()), float(light.std(ddof=1))
        means.append(mean)
        spreads.append(spread)
        point |= {"global": round(mean, 4), "deviation": round(spread, 4)}
        criteria.append(
            _criterion(
                f"{point['name']}: deviation over patterns below 10 % of the mean (limit: ours)",
                f"{spread / mean:.1%} (noise {float(np.mean(sd)) / mean:.1%})",
                spread < LIMIT * mean,
            )
        )
    number = np.arange(1.0, len(points) + 1)
    summary = Plot(
        f"Mean and deviation over {len(rows[0])} random patterns (Fig. 4c)",
        "point, in the order " + ", ".join(p["name"] for p in points),
        "L_g (linear counts)",
        (Curve("mean", number, np.asarray(means), np.asarray(spreads)),),
    )
    x = np.arange(1.0, len(rows[0]) + 1)
    each = Plot(
        "Each pattern",
        "pattern",
        "L_g (linear counts)",
        tuple(Curve(p["name"], x, *_values(row)) for row, p in zip(rows, points, strict=True)),
    )
    plots = {"random_patterns": summary, "each_pattern": each}
    return _measured(rows, points, plots, criteria, [])


def lit_fraction(draws: int, rows: Rows, points: Points) -> Measurement:
    """Figure 4(d): α L_g is a straight line in α, through 0. Readings come in groups of `draws`
    random patterns of one fraction, whose mean counts."""
    curves, criteria = [], []
    for row, point in zip(rows, points, strict=True):
        light, sd = _values(row)
        drawn = np.asarray([reading.lit_fraction for reading in row])
        y = (drawn * light).reshape(-1, draws).mean(axis=1)
        y_sd = np.sqrt(np.square(drawn * sd).reshape(-1, draws).mean(axis=1) / draws)
        alpha = drawn.reshape(-1, draws).mean(axis=1)
        (offset, slope), _ = line(alpha, y, np.maximum(y_sd, 1e-6 * np.abs(y).max() + 1e-12))
        off = float(np.max(np.abs(y - offset - slope * alpha))) / float(np.max(np.abs(y)))
        at_zero = abs(offset) / float(np.max(np.abs(y)))
        curves.append(Curve(point["name"], alpha, y, y_sd, (offset, slope)))
        point |= {
            "global": _list(y / alpha),
            "slope": round(slope, 4),
            "offset": round(offset, 4),
            "departure": round(off, 4),
        }
        criteria.append(
            _criterion(
                f"{point['name']}: α L_g departs from a line by less than 5 % of its largest "
                "(limit: ours)",
                f"{off:.1%}; at α = 0 the line is at {at_zero:.1%}",
                off < 0.05,
            )
        )
    plot = Plot(
        "α L_g against the lit fraction (Fig. 4d)",
        "α, lit fraction",
        "α L_g (linear counts)",
        tuple(curves),
    )
    return _measured(rows, points, {"lit_fraction": plot}, criteria, [])


def checker_size(sizes: Sequence[int], rows: Rows, points: Points) -> Measurement:
    """Figure 4(e): L_g is flat for q in 4..16."""
    x = np.asarray(sizes, dtype=np.float64)
    within = (x >= 4) & (x <= 16)
    curves, criteria = [], []
    for row, point in zip(rows, points, strict=True):
        light, sd = _values(row)
        mean = float(light[within].mean()) if within.any() else float("nan")
        variation = float(np.max(np.abs(light[within] / mean - 1.0))) if within.any() else np.nan
        curves.append(Curve(point["name"], x, light, sd))
        point |= {"global": _list(light), "sd": _list(sd), "variation": round(variation, 4)}
        criteria.append(
            _criterion(
                f"{point['name']}: L_g is constant within 10 % for q in 4..16",
                f"{variation:.1%} (noise {float(sd[within].max()) / abs(mean):.1%})",
                variation < LIMIT,
            )
        )
    plot = Plot(
        "Global component against the size of the checkers (Fig. 4e)",
        "q, side of a checker (projector px)",
        "L_g (linear counts)",
        tuple(curves),
    )
    return _measured(rows, points, {"checker_size": plot}, criteria, [])


def _measured(
    rows: Rows,
    points: Points,
    plots: dict[str, Plot],
    criteria: list[dict[str, Any]],
    advice: list[str],
) -> Measurement:
    met = sum(c["met"] for c in criteria)
    bright = [p["name"] for p in points if p["saturated"]]
    if bright:
        advice = [
            f"{', '.join(bright)}: saturated under white: expose more briefly (--exposure).",
            *advice,
        ]
    noisy = [
        p["name"]
        for row, p in zip(rows, points, strict=True)
        if np.nanmedian([r.sd / max(abs(r.light), 1e-9) for r in row]) > LIMIT / 3
    ]
    if noisy:
        advice.append(
            f"{', '.join(noisy)}: noise hides what is measured: average more (--average)."
        )
    facts = {
        "points": points,
        "criteria": criteria,
        "figures": [["criteria met", f"{met} of {len(criteria)}"], ["points", str(len(points))]],
        "advice": advice,
    }
    return Measurement(facts, plots)


def _values(row: list[Reading]) -> tuple[Any, Any]:
    return np.asarray([r.light for r in row]), np.asarray([r.sd for r in row])


def _list(values: Any) -> list[float]:
    return [round(float(v), 4) for v in values]


def _criterion(criterion: str, measured: str, met: Any) -> dict[str, Any]:
    return {"criterion": criterion, "measured": measured, "met": bool(met)}
