"""Leakage: what an unlit part of the projector's image emits, of what a lit one does (§3.5)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import blur
from daemon.separation.contrast import CheckerSweep
from daemon.separation.estimator import (
    Curve,
    Lighting,
    Measurement,
    NotYet,
    Observation,
    Plot,
)
from daemon.separation.radiometry import Plane, Response
from daemon.separation.sampling import Mask, median_ratio, ratio

_RESOLVED = 0.5
"""A size whose contrast is less than this part of the largest's is not resolved."""
_DIRECT = 0.25
"""Of the light, at least this part must be direct where contrast is measured."""
_SURE = 0.05  # standard deviation of a size's leakage, at most, to call it measured
_USUAL = 4  # px: scans show no smaller patches, and that these blur is no news


class Leak:
    """References, then checkers of several sizes, the largest first -> b, and b of each size.

    Over the whole picture b = (K - A)/(W - A), from black, white and source-off frames: direct and
    global light leak alike. A patch of p x p pixels gets more, from its lit neighbours, by the
    blur of the optics. With C(p) the contrast of checkers and their complements, where over all
    shifts it is greatest, relative to that of the largest, which has (1 - b), a lit patch emits
    (1 + b + C)/2 and an unlit one (1 + b - C)/2, and their ratio is b(p).

    Patterns are numbered through; each is followed by its complement. Memory: ten planes.
    """

    def __init__(self, response: Response, sizes: tuple[int, ...], images: tuple[int, ...]) -> None:
        """`sizes` descend; `images` of each."""
        self._sizes = sizes
        self._sweep = CheckerSweep(response, images, self._close)
        self._references = self._sweep.references
        self._good: Mask | None = None
        self._largest: Plane | None = None
        self._contrast: dict[int, tuple[float, float]] = {}

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        self._sweep.update(pixels, observation)

    def _close(self, number: int, contrast: Plane) -> None:
        if self._largest is None:
            ambient, white, good = self._sweep.lit()
            self._good = good & (contrast > _DIRECT * (white - ambient))
            self._largest = contrast
            if np.count_nonzero(self._good) < 64:
                raise NotYet(
                    "hardly any pixel sees direct light: focus the projector on the scene, and "
                    "keep larger patches among the sizes (--sizes)"
                )
        assert self._good is not None
        self._contrast[self._sizes[number]] = median_ratio(contrast, self._largest, self._good)

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet before all sizes are in."""
        black = self._references.mean(Lighting.BLACK)
        if len(self._contrast) < len(self._sizes) or black is None:
            raise NotYet(f"{len(self._contrast)} of {len(self._sizes)} sizes have been taken")
        ambient, white, good = self._sweep.lit()
        b, b_sd = ratio(black - ambient, white - ambient, good)
        b_sd = float(np.hypot(np.nan_to_num(b_sd), self._uncertain_black(white - ambient, good)))
        rows = [self._of_size(size, b, b_sd) for size in sorted(self._sizes)]
        measured = [row for row in rows if row["measurable"]]
        plateau = next((row["size"] for row in measured if row["leakage"] - b < 0.02), None)
        contrast = {row["size"]: row["contrast"] for row in rows}
        of_image, of_optics = blur.of_image(contrast), blur.of_optics(contrast)
        advice = []
        lost = [str(row["size"]) for row in rows if not row["measurable"]]
        blurred = [row["size"] for row in rows if not row["measurable"] and row["size"] >= _USUAL]
        if blurred:
            advice.append(
                f"Patches of up to {max(blurred)} px are blurred with their neighbours by "
                "projector and camera: focus both, or scan with larger ones."
            )
        if plateau is None:
            advice.append("Even the largest patches leak: focus the projector.")
        if b > 0.2:
            advice.append("Unlit pixels leak a fifth of the light: lower the projector's black.")
        facts = {
            "values": {
                "leakage": round(max(b, 0.0), 5),
                "leakage_sd": round(b_sd, 5),
                "blur_px": of_image,
                "optics_blur_px": of_optics,
                "leakage_by_size": [[row["size"], row["leakage"], row["sd"]] for row in measured],
            },
            "leakage": round(b, 5),
            "leakage_sd": round(b_sd, 5),
            "blur_px": of_image,
            "optics_blur_px": of_optics,
            "by_size": rows,
            "plateau_from_px": plateau,
            "figures": [
                ["leakage b", f"{b:.4f} ± {b_sd:.4f}"],
                ["holds for patches from", "no size" if plateau is None else f"{plateau} px"],
                ["cannot be measured for", f"{', '.join(lost)} px" if lost else "none"],
                ["blur of the optics", f"{of_optics:.2f} px" if of_optics else "not seen"],
            ],
            "advice": advice,
        }
        sizes = np.asarray([row["size"] for row in rows], dtype=np.float64)
        known = [row["leakage"] if row["measurable"] else np.nan for row in rows]
        flat = Curve("whole picture", sizes, np.full(sizes.size, b), np.full(sizes.size, b_sd))
        by_size = Curve("patches", sizes, np.asarray(known), np.asarray([r["sd"] for r in rows]))
        plot = Plot(
            "Leakage of an unlit patch",
            "side of the patch (projector px)",
            "b",
            (by_size, flat),
            log_x=True,
        )
        return Measurement(facts, {"leakage": plot}, name="calibration")

    def _of_size(self, size: int, b: float, b_sd: float) -> dict[str, Any]:
        relative, spread = self._contrast[size]
        contrast = (1 - b) * relative
        leakage = (1 + b - contrast) / (1 + b + contrast)
        slope = 2 * (1 + b) / (1 + b + contrast) ** 2
        sd = float(np.hypot(b_sd, slope * (1 - b) * np.nan_to_num(spread)))
        return {
            "size": size,
            "leakage": round(leakage, 5),
            "sd": round(sd, 5),
            "contrast": round(relative, 5),
            "measurable": bool(relative >= _RESOLVED and sd <= _SURE),
        }

    def _uncertain_black(self, whole: Plane, good: Mask) -> float:
        """What the rounding of counts may do to b, where it is the same in all samples."""
        frames = max(1, self._references.frames(Lighting.BLACK))
        mean = float(whole[good].mean(dtype=np.float64))
        return 0.29 / mean / float(np.sqrt(frames))

    def summary(self) -> dict[str, float]:
        """Sizes so far."""
        return {"sizes": float(len(self._contrast))}
