"""Reference frames: what black, white and source-off pictures say of ambient light (§3.3)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Lighting
from daemon.separation.radiometry import FrameMean, Plane, Response


class References:
    """Frames that are not of the pattern set, averaged by their kind in constant memory."""

    def __init__(self, response: Response) -> None:
        self._response = response
        self._means: dict[Lighting, FrameMean] = {}
        self._white_saturated: NDArray[np.bool_] | None = None

    def add(self, pixels: NDArray[Any], lighting: Lighting) -> None:
        """Take in a frame of one of the kinds ambient, black, white."""
        self._means.setdefault(lighting, FrameMean(self._response)).add(pixels)
        if lighting is Lighting.WHITE:
            saturated = pixels >= self._response.saturated_from
            if self._white_saturated is None:
                self._white_saturated = saturated
            else:
                self._white_saturated |= saturated

    def mean(self, lighting: Lighting) -> Plane | None:
        """The mean of a kind in linear light, or None without such frames."""
        mean = self._means.get(lighting)
        return mean.value() if mean else None

    def frames(self, lighting: Lighting) -> int:
        """How many frames of a kind came."""
        mean = self._means.get(lighting)
        return mean.frames if mean else 0

    def facts(self, ambient_from: str) -> dict[str, Any]:
        """Which reference frames there were and what ambient light was taken from."""
        frames = {kind.value: mean.frames for kind, mean in self._means.items()}
        return {"ambient_from": ambient_from, "reference_frames": frames}

    def ambient(
        self, brightest: Plane, darkest: Plane, lit_fraction: float, leakage: float
    ) -> tuple[Plane | None, str]:
        """Light that is not the source's, and from what it is known; None where nothing tells.

        A source-off frame says it outright. A black frame holds its leakage as well, which a white
        frame (where it is not saturated) or the extremes take out.
        """
        off = self.mean(Lighting.AMBIENT)
        if off is not None:
            return off, "ambient frame"
        black = self.mean(Lighting.BLACK)
        if black is None:
            return None, "none"
        ambient = light_model.ambient_from_black(black, brightest, darkest, lit_fraction, leakage)
        white = self.mean(Lighting.WHITE)
        if white is None or self._white_saturated is None or leakage == 0.0:
            return ambient, "black frame"
        measured = light_model.ambient_from_black_and_white(black, white, leakage)
        return np.where(self._white_saturated, ambient, measured), "black and white frames"
