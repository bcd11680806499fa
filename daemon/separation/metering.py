"""How bright the camera sees the scene, and the exposure that follows from it.

The level of a picture is that of its brightest thousandth, in the mosaic's brightest colour: high
enough that next to nothing saturates, and not the few pixels of a highlight or a hot pixel. As
light is linear in the exposure, one picture that is neither dark nor saturated tells the exposure
for any level; the next one only confirms it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation.exposure import BRIGHTEST, TARGET, Limits
from daemon.separation.radiometry import Response

_TOLERANCE = 0.05  # part of the target by which the level may be off
_LOOKS = 10  # pictures, at most
_CUT = 4.0  # a saturated picture does not say by how much: try a quarter
_GROW = 16.0  # a dark one is mostly noise: believe it no further


@dataclass(frozen=True, slots=True)
class Level:
    """What a picture says. `share` of full scale, black removed, in linear light; `clipped`: it is
    saturated, and the light may be any amount above; `saturated`: share of saturated samples in
    the colour that has most of them."""

    share: float
    saturated: float
    clipped: bool
    exposure_us: float

    @property
    def light(self) -> float:
        """What does not depend on the exposure: share of full scale a second."""
        return self.share / max(self.exposure_us, 1e-3) * 1e6


def level_of(pixels: NDArray[Any], response: Response, exposure_us: float) -> Level:
    """The level of a picture (H, W) or (H, W, 3), uint8 or uint16, of this response."""
    table = response.table()
    limit = min(math.ceil(response.saturated_from), response.full_scale)
    top, worst = 0, 0.0
    for samples in _colours(pixels, response.bayer):
        counts = np.bincount(samples.ravel(), minlength=response.full_scale + 1)
        upto = np.cumsum(counts)
        top = max(top, int(np.searchsorted(upto, (1.0 - BRIGHTEST) * samples.size)))
        worst = max(worst, float(counts[limit:].sum() / samples.size))
    top = min(top, response.full_scale)
    return Level(
        share=float(table[top] / table[limit]),
        saturated=worst,
        clipped=top >= limit,
        exposure_us=exposure_us,
    )


def _colours(pixels: NDArray[Any], bayer: str) -> Iterator[NDArray[Any]]:
    """The samples of each colour of a mosaic, of RGB, or of a grey picture."""
    if pixels.ndim == 3:
        yield from (pixels[..., k] for k in range(pixels.shape[2]))
    elif bayer:
        yield from (pixels[y::2, x::2] for y in range(2) for x in range(2))
    else:
        yield pixels


@dataclass(frozen=True, slots=True)
class Exposure:
    """The exposure that was chosen, and what it was chosen by. `problem`: why the level is not
    where it should be, with the remedy; "" if it is."""

    level: Level
    looks: int
    problem: str = ""

    @property
    def exposure_us(self) -> float:
        """As the camera took it."""
        return self.level.exposure_us

    def facts(self) -> dict[str, Any]:
        """As run.json and quality.json have it."""
        return {
            "exposure_us": self.exposure_us,
            "brightest": round(self.level.share, 4),
            "wanted": TARGET,
            "saturated": round(self.level.saturated, 6),
            "looks": self.looks,
            **({"problem": self.problem} if self.problem else {}),
        }


def choose(look: Callable[[float], Level], start_us: float, limits: Limits) -> Exposure:
    """The exposure that puts the level at TARGET, within 5 %, or as near below as the limits let.

    `look` takes a picture at an exposure in µs; what it raises passes through. Never more than ten
    looks: three under a steady light, unless it begins far off.
    """
    exposure = limits.allowed(start_us)
    for number in range(1, _LOOKS + 1):
        level = look(exposure)
        if level.clipped:
            wanted = exposure / _CUT
        else:
            wanted = exposure * min(TARGET / max(level.share, TARGET / _GROW), _GROW)
            if abs(level.share / TARGET - 1.0) <= _TOLERANCE:
                return Exposure(level, number)
        better = limits.allowed(wanted)
        if math.isclose(better, exposure, rel_tol=1e-6):
            return Exposure(level, number, _limited(level, wanted > limits.longest_us))
        exposure = better
    return Exposure(
        level, _LOOKS, f"the light does not keep still: {_LOOKS} looks agree on no exposure"
    )


def _limited(level: Level, wants_longer: bool) -> str:
    """What is wrong at an exposure that the limits don't let improve."""
    exposure = f"{level.exposure_us:.0f} µs"
    if level.clipped:
        return (
            f"saturated at the shortest exposure that may be chosen ({exposure}): less light, a "
            "smaller aperture, or less gain"
        )
    if wants_longer:
        return (
            f"too dark at the longest exposure that may be chosen ({exposure}): the brightest "
            f"thousandth is at {level.share:.1%} of full scale, not {TARGET:.0%}: more light, a "
            "larger aperture, or more gain"
        )
    return ""
