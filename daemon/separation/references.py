"""Reference frames: what black, white and source-off pictures say of ambient light (§3.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Lighting
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.scan_noise import Told


@dataclass(frozen=True, slots=True)
class Total:
    """L_d + L_g, and what the variance of light under half of the source and of one frame makes of
    its variance, as factors (one for all, or one a sample); `frames` are the references that it
    holds: their light and their factors."""

    light: Plane
    of_half: float | Plane
    of_frame: float | Plane
    source: str
    frames: tuple[tuple[Plane, float | Plane], ...] = ()

    def of_references(self, deviation: Callable[[Plane], Plane]) -> Plane:
        """The variance that the references bring, each with the noise of its own light:
        `deviation` is that of one frame at a level of light."""
        found = np.zeros_like(self.light)
        for light, factor in self.frames:
            found += np.square(deviation(light)) * np.asarray(factor, dtype=np.float32)
        return found


class References:
    """Frames that are not of the pattern set, averaged by their kind in constant memory."""

    def __init__(self, response: Response) -> None:
        self._response = response
        self._means: dict[Lighting, FrameMean] = {}
        self._saturated: dict[Lighting, NDArray[np.bool_]] = {}

    def add(self, pixels: NDArray[Any], lighting: Lighting) -> None:
        """Take in a frame of one of the kinds ambient, black, white, open."""
        self._means.setdefault(lighting, FrameMean(self._response)).add(pixels)
        if lighting in {Lighting.WHITE, Lighting.OPEN}:
            saturated = pixels >= self._response.saturated_from
            self._saturated[lighting] = saturated | self._saturated.get(lighting, False)

    def mean(self, lighting: Lighting) -> Plane | None:
        """The mean of a kind in linear light, or None without such frames."""
        mean = self._means.get(lighting)
        return mean.value() if mean else None

    def frames(self, lighting: Lighting) -> int:
        """How many frames of a kind came."""
        mean = self._means.get(lighting)
        return mean.frames if mean else 0

    def total(self, half: Plane, leakage: float) -> Total:
        """L_d + L_g from light under half of the source, A + ½(1 + b)(L_d + L_g), and references.

        With a black and a white frame (W - K)/(1 - b): half the light lies in the middle of the two
        and cannot better their slope. Where white is saturated or missing 2(half - K)/(1 - b); with
        a source-off frame 2(half - A)/(1 + b); with none ambient light is taken for none.
        """
        off, black = self.mean(Lighting.AMBIENT), self.mean(Lighting.BLACK)
        if off is not None:
            weight = 2.0 / (1.0 + leakage)
            share = weight**2 / self.frames(Lighting.AMBIENT)
            return Total(
                (half - off) * np.float32(weight),
                weight**2,
                share,
                "ambient frame",
                ((off, share),),
            )
        if black is None:
            weight = 2.0 / (1.0 + leakage)
            return Total(half * np.float32(weight), weight**2, 0.0, "none")
        weight = 2.0 / (1.0 - leakage)
        total: Plane = (half - black) * np.float32(weight)
        share = weight**2 / self.frames(Lighting.BLACK)
        whole = self.whole(leakage)
        clipped = self.white_saturated
        if whole is None or clipped is None:
            return Total(total, weight**2, share, "black frame", ((black, share),))
        if clipped.any():
            return Total(
                np.where(clipped, total, whole.light),
                np.where(clipped, np.float32(weight**2), np.float32(whole.of_half)),
                np.where(clipped, np.float32(share), np.float32(whole.of_frame)),
                whole.source,
                (
                    (black, np.where(clipped, share, whole.frames[0][1])),
                    (whole.frames[1][0], np.where(clipped, 0.0, whole.frames[1][1])),
                ),
            )
        return whole

    def whole(self, leakage: float) -> Total | None:
        """L_d + L_g = (W - K)/(1 - b), whatever the ambient light; None without both frames. Wrong
        where `white_saturated`."""
        black, white = self.mean(Lighting.BLACK), self.mean(Lighting.WHITE)
        if black is None or white is None:
            return None
        light: Plane = (white - black) * np.float32(1.0 / (1.0 - leakage))
        of_black, of_white = (
            1.0 / self.frames(kind) / (1.0 - leakage) ** 2
            for kind in (Lighting.BLACK, Lighting.WHITE)
        )
        frames = (black, of_black), (white, of_white)
        return Total(light, 0.0, of_black + of_white, "black and white frames", frames)

    def whole_variance(self, told: Told, leakage: float) -> Plane:
        """The variance of `whole`, each reference with the noise of its own light; `told` of frames
        averaged as a pattern's are."""
        parts: list[Plane] = []
        for kind in (Lighting.BLACK, Lighting.WHITE):
            mean = self.mean(kind)
            assert mean is not None, "asked for with both frames alone"
            share = told.average / self.frames(kind) / (1.0 - leakage) ** 2
            parts.append(np.square(told.deviation(mean)) * np.float32(share))
        return parts[0] + parts[1]

    @property
    def white_saturated(self) -> NDArray[np.bool_] | None:
        """Samples that were saturated in a white frame."""
        return self._saturated.get(Lighting.WHITE)

    @property
    def open_saturated(self) -> NDArray[np.bool_] | None:
        """Samples that were saturated in an open frame."""
        return self._saturated.get(Lighting.OPEN)

    def ambient_variance(self, told: Told) -> Plane | None:
        """The variance of `ambient`, to first order in the leakage; `told` as in `whole_variance`.
        None where nothing tells of ambient light."""
        for kind in (Lighting.AMBIENT, Lighting.BLACK):
            mean = self.mean(kind)
            if mean is not None:
                share = told.average / self.frames(kind)
                return np.square(told.deviation(mean)) * np.float32(share)
        return None

    def facts(self, ambient_from: str) -> dict[str, Any]:
        """Which reference frames there were and what ambient light was taken from."""
        frames = {kind.value: mean.frames for kind, mean in self._means.items()}
        return {"ambient_from": ambient_from, "reference_frames": frames}

    def ambient(
        self,
        brightest: Plane,
        darkest: Plane,
        lit_fraction: float,
        leakage: float,
        reduced: Callable[[Plane], Plane] = lambda plane: plane,
    ) -> tuple[Plane | None, str]:
        """Light that is not the source's, and from what it is known; None where nothing tells.

        A source-off frame says it outright. A black frame holds its leakage as well, which a white
        frame (where it is not saturated) or the extremes take out. `reduced` makes a frame's plane
        one of the extremes' size.
        """
        off = self.mean(Lighting.AMBIENT)
        if off is not None:
            return reduced(off), "ambient frame"
        black = self.mean(Lighting.BLACK)
        if black is None:
            return None, "none"
        black = reduced(black)
        ambient = light_model.ambient_from_black(black, brightest, darkest, lit_fraction, leakage)
        white = self.mean(Lighting.WHITE)
        clipped = self.white_saturated
        if white is None or clipped is None or leakage == 0.0:
            return ambient, "black frame"
        saturated = reduced(clipped.astype(np.float32)) > 0
        measured = light_model.ambient_from_black_and_white(black, reduced(white), leakage)
        return np.where(saturated, ambient, measured), "black and white frames"
