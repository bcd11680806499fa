"""A projector's response: the light of each of its levels, and the levels that make it linear."""

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
from daemon.separation.references import References
from daemon.separation.sampling import Mask, Turns, bright, ratio

_LEVELS = 255  # the projector's highest
_DRIFT = 0.02  # of the lamp's light, from the first white to the last: worth a line of advice


class ToneCurve:
    """Frames of uniform levels -> response, gamma, and its inverse (256 levels).

    White and black come first and white comes last: what light did in between is told by the two
    whites. Pattern k is of level `levels[k]`. Memory: five planes.
    """

    def __init__(self, response: Response, levels: tuple[float, ...]) -> None:
        self._levels = levels
        self._references = References(response)
        self._mean = FrameMean(response)
        self._turns = Turns()
        self._planes: tuple[Plane, Plane, Mask] | None = None
        self._found: dict[int, tuple[float, float]] = {}

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        if observation.lighting is not Lighting.PATTERN:
            if observation.used:
                self._references.add(pixels, observation.lighting)
            return
        if (overdue := self._turns.overdue(observation)) is not None:
            self._close(overdue)
        if observation.used:
            self._mean.add(pixels)
        if observation.last:
            self._close(observation.pattern)

    def _close(self, pattern: int) -> None:
        if not self._mean.frames:
            return
        if self._planes is None:
            black, white = (self._references.mean(k) for k in (Lighting.BLACK, Lighting.WHITE))
            saturated = self._references.white_saturated
            if black is None or white is None or saturated is None:
                raise ValueError("levels are measured against black and white, which come first")
            self._planes = black, white - black, bright(black, white, saturated)
        black, whole, good = self._planes
        self._found[pattern] = ratio(self._mean.value() - black, whole, good)
        self._mean.clear()

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet before all levels are in."""
        if len(self._found) < len(self._levels):
            raise NotYet(f"{len(self._found)} of {len(self._levels)} levels have been taken")
        *inner, drift = (self._found[k] for k in range(len(self._levels)))
        levels = np.asarray([0.0, *self._levels[:-1], 1.0])
        light = np.asarray([0.0, *(value for value, _ in inner), 1.0])
        sd = np.asarray([0.0, *(sd for _, sd in inner), 0.0])
        inverse = inverted(levels, light)
        told = (light > 0.01) & (levels > 0) & (levels < 1)
        gamma = float(
            np.sum(np.log(light[told]) * np.log(levels[told])) / np.sum(np.log(levels[told]) ** 2)
        )
        residual = float(np.max(np.abs(light - levels**gamma)))
        curvature = float(np.max(np.abs(light - levels)))
        advice = []
        if abs(drift[0] - 1.0) > _DRIFT:
            advice.append(
                f"White changed by {drift[0] - 1.0:+.1%} during the run: let the lamp warm up, "
                "then calibrate again."
            )
        if np.any(np.diff(light) < -3 * np.nan_to_num(sd[1:]) - 0.005):
            advice.append("The response falls with the level somewhere: is an automatic on?")
        facts = {
            "values": {"tone": inverse, "gamma": round(gamma, 4)},
            "gamma": round(gamma, 4),
            "departure_from_gamma": round(residual, 4),
            "departure_from_linear": round(curvature, 4),
            "white_drift": round(drift[0] - 1.0, 5),
            "figures": [
                ["gamma", f"{gamma:.3f}"],
                ["largest departure from linear", f"{curvature:.1%} of white"],
                ["change of white during the run", f"{drift[0] - 1.0:+.2%}"],
            ],
            "advice": advice,
        }
        grid = np.linspace(0.0, 1.0, _LEVELS + 1)
        drawn = np.interp(np.asarray(inverse) / _LEVELS, levels, light)
        plot = Plot(
            "Response of the projector",
            "level (of the largest)",
            "light (of white, black removed)",
            (
                Curve("measured", levels, light, sd),
                Curve("through the inverse", grid, drawn),
                Curve("gamma fitted", grid, grid**gamma),
            ),
        )
        return Measurement(facts, {"tone": plot}, name="calibration")

    def summary(self) -> dict[str, float]:
        """Levels so far."""
        return {"levels": float(len(self._found))}


def inverted(levels: NDArray[np.float64], light: NDArray[np.float64]) -> list[int]:
    """The level (0 to 255) that gives each of 256 evenly spaced amounts of light.

    `levels` ascend from 0 to 1, `light` (0 to 1) is made to ascend with them.
    """
    rising = np.maximum.accumulate(np.clip(light, 0.0, 1.0))
    rising = rising + np.arange(rising.size) * 1e-9  # np.interp wants it to ascend strictly
    wanted = np.linspace(0.0, 1.0, _LEVELS + 1)
    found = np.rint(np.interp(wanted, rising / rising[-1], levels) * _LEVELS)
    return [int(v) for v in found]
