"""The light of each pixel behind a moving occluder: in full light and in the umbra, how well it is
known, and direct and global from both (§4.2)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.separation import light_model
from daemon.separation.estimator import Lighting
from daemon.separation.noise import Noise
from daemon.separation.plateau import Part
from daemon.separation.radiometry import Plane, Response
from daemon.separation.references import References


@dataclass(frozen=True, slots=True)
class Levels:
    """Linear light in full light and in the umbra and its deviations (float32, a frame's shape),
    the samples that each rests on, and the part of all frames that told of each pixel (H, W)."""

    bright: Plane
    dark: Plane
    bright_std: Plane
    dark_std: Plane
    lit: NDArray[np.uint16]
    unlit: NDArray[np.uint16]
    told: Plane

    @classmethod
    def of_counts(
        cls,
        response: Response,
        noise: Noise | None,
        high: tuple[NDArray[Any], NDArray[np.uint16]],
        low: tuple[NDArray[Any], NDArray[np.uint16]],
        told: Plane,
        scatter: float = 1.0,
    ) -> Levels:
        """From the encoded counts of both levels and of how many samples each is a mean; `scatter`
        is its deviation over that of any so many samples' mean."""
        (bright, bright_std), (dark, dark_std) = (
            (
                response.linear_between(level.astype(np.float32)),
                response.deviation(noise, level) * np.sqrt(scatter**2 / count, dtype=np.float32),
            )
            for level, count in (high, low)
        )
        return cls(bright, dark, bright_std, dark_std, high[1], low[1], told)

    def of(self, part: Part) -> Levels:
        """Of a part of the picture."""
        return Levels(*(getattr(self, field.name)[part] for field in fields(self)))


@dataclass(frozen=True, slots=True)
class Split:
    """Direct and global light, their deviations, and light that is neither (float32); `source` says
    from what the last is known."""

    direct: Plane
    indirect: Plane
    direct_std: Plane
    global_std: Plane
    other: Plane
    source: str


def split_behind(
    levels: Levels, part: float, references: References, response: Response, noise: Noise | None
) -> Split:
    """Components behind an occluder that lets a part of the source pass: a mesh's β, a stick's α.

    With no reference frames light that is not the source's is taken for none. An ambient frame says
    how much it is; an open frame (no mesh) tells it apart; with both, what is in the open neither
    direct nor ambient is global, whatever β is and whatever the mesh left unshaded. Where the open
    frame is saturated it tells nothing.
    """

    def known(kind: Lighting) -> tuple[Plane, Plane] | None:
        light = references.mean(kind)
        if light is None:
            return None
        one = response.deviation(noise, response.counts(light))
        return light, one * np.float32(references.frames(kind) ** -0.5)

    direct: Plane = levels.bright - levels.dark
    direct_std: Plane = np.hypot(levels.bright_std, levels.dark_std)
    nothing = np.zeros_like(direct), np.zeros_like(direct)
    off, whole = known(Lighting.AMBIENT), known(Lighting.OPEN)
    ambient, ambient_std = off or nothing
    weight = np.float32(1.0 / part)
    indirect = (levels.dark - ambient) * weight
    global_std = np.hypot(levels.dark_std, ambient_std) * weight
    source = "none" if off is None else "ambient frame"
    clipped = references.open_saturated
    if whole is None or clipped is None:
        return Split(direct, indirect, direct_std, global_std, ambient, source)
    if off is None:
        _, told, other = light_model.from_mesh_and_open(levels.bright, levels.dark, whole[0], part)
        told_std = np.hypot(whole[1], levels.bright_std) * np.float32(1.0 / (1.0 - part))
        source = "open frame"
    else:
        told, other = whole[0] - ambient - direct, ambient
        told_std = np.hypot(np.hypot(whole[1], ambient_std), direct_std)
        source = "open and ambient frames"
    return Split(
        direct,
        np.where(clipped, indirect, told),
        direct_std,
        np.where(clipped, global_std, told_std),
        np.where(clipped, ambient, other),
        source,
    )
