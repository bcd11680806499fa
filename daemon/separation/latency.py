"""When a projector's light really changes, from frames that saw a part of the change."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import (
    Curve,
    Lighting,
    Measurement,
    NotYet,
    Observation,
    Plot,
)
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.sampling import Mask, bright

_PARTLY = 0.03
"""A frame tells the moment of the change if it saw at least this part of both sides."""
_SAFE = 3.0
"""Deviations that the wait which is applied has beyond the mean."""
_LEAST = 5  # frames that saw the change, to tell its spread
_RESOLUTION_US = 100.0  # a shorter latency is none


class Latency:
    """Frames of flashes from black to white -> the delay of the light behind what was said.

    A frame that begins `delay` after the light was said to be white, and saw white for the part f
    of its exposure, tells that white came at delay + (1 - f) exposure. Memory: four planes.
    """

    def __init__(self, response: Response, longest_us: float) -> None:
        self._response = response
        self._longest_us = longest_us
        self._white, self._black = FrameMean(response), FrameMean(response)
        self._saturated: Mask | None = None
        self._planes: tuple[Plane, float, Mask] | None = None
        self._seen: list[tuple[float, float, float]] = []  # delay, exposure (µs), part f

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`: black and white, settled, come first; a flash is an odd pattern."""
        if not observation.used:
            return
        if observation.lighting is Lighting.WHITE:
            self._white.add(pixels)
            self._saturated = pixels >= self._response.saturated_from
        elif observation.lighting is Lighting.BLACK:
            self._black.add(pixels)
        elif observation.pattern % 2:
            self._flash(pixels, observation)

    def _flash(self, pixels: NDArray[Any], observation: Observation) -> None:
        if self._planes is None:
            if self._saturated is None or not self._black.frames:
                raise NotYet(
                    "flashes are measured against black and white, which came incomplete: "
                    "calibrate again"
                )
            black, white = self._black.value(), self._white.value()
            good = bright(black, white, self._saturated)
            self._planes = black, float((white - black)[good].sum(dtype=np.float64)), good
        black, whole, good = self._planes
        light = self._response.linear(pixels) - black
        part = float(light[good].sum(dtype=np.float64)) / whole
        self._seen.append((observation.delay_us, observation.exposure_us, part))

    def _told(self) -> NDArray[np.float64]:
        """The moments (µs) that frames tell which saw both sides."""
        return np.asarray(
            [d + (1 - f) * e for d, e, f in self._seen if _PARTLY < f < 1 - _PARTLY],
            dtype=np.float64,
        )

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet while the change has not been seen."""
        if not self._seen:
            raise NotYet("no flash has been seen yet")
        delays, _, parts = (np.asarray(c) for c in zip(*self._seen, strict=True))
        told = self._told()
        if told.size >= 1:
            mean = float(told.mean())
            spread = float(told.std(ddof=1)) if told.size > 1 else float("nan")
            how = f"{told.size} frames that saw the change"
        elif parts.min() >= 1 - _PARTLY:
            # It changed before the first frame: to wait for as long as that one did is enough. A
            # bound, and no measurement: the delay itself and its spread stay unknown.
            mean, spread = max(0.0, float(delays.min())), float("nan")
            how = (
                "no frame saw the change: it came before the first exposure, "
                f"{mean / 1e3:.3g} ms after the driver's moment"
            )
        else:
            raise NotYet(
                f"no flash was seen within {self._longest_us / 1e3:g} ms: is the camera looking "
                "at the projector's light? Else look longer (--longest-ms)"
            )
        wait = max(0.0, mean + _SAFE * (0.0 if np.isnan(spread) else spread))
        if wait < _RESOLUTION_US and mean < _RESOLUTION_US:
            wait = 0.0
        advice = []
        if not told.size:
            advice.append(
                "No exposure saw the light change: the latency is not measured, only bounded by "
                f"the first exposure, {mean / 1e3:.3f} ms after the driver's moment. Later scans "
                + (
                    f"wait for that bound ({wait / 1e3:.3f} ms), which is safe."
                    if wait
                    else "need not wait for so short a time."
                )
            )
        elif told.size < _LEAST:
            advice.append(
                f"Only {told.size} frames saw the change: more flashes (--flashes), or a longer "
                "exposure (--exposure), tell the spread better."
            )
        facts = {
            "values": {"latency_s": round(wait / 1e6, 9)},
            "latency_ms": round(mean / 1e3, 4) if told.size else None,
            "at_most_ms": None if told.size else round(mean / 1e3, 4),
            "spread_ms": None if np.isnan(spread) else round(spread / 1e3, 4),
            "least_ms": round(float(told.min()) / 1e3, 4) if told.size else None,
            "greatest_ms": round(float(told.max()) / 1e3, 4) if told.size else None,
            "wait_ms": round(wait / 1e3, 4),
            "from": how,
            "flashes": len(self._seen),
            "figures": [
                [
                    "later than the driver says",
                    f"{'' if told.size else 'at most '}{mean / 1e3:.3f} ms",
                ],
                ["spread", "unknown" if np.isnan(spread) else f"{spread / 1e3:.3f} ms"],
                ["waited before each exposure", f"{wait / 1e3:.3f} ms"],
            ],
            "advice": advice,
        }
        order = np.argsort(delays)
        curve = Curve("flashes", delays[order] / 1e3, parts[order])
        plot = Plot(
            "What frames saw of the change",
            "start of the exposure after the driver's moment (ms)",
            "part of the exposure that was lit",
            (curve,),
        )
        return Measurement(facts, {"flashes": plot}, name="calibration")

    def summary(self) -> dict[str, float]:
        """Flashes so far, and the delay (µs) once it is known."""
        told = self._told()
        found = {"flashes": float(len(self._seen))}
        return found | ({"latency_us": float(told.mean())} if told.size else {})
