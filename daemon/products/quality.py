"""What the quality bits mean to a person: a name, what is wrong, what to do, a colour."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.pictures.display import Picture, encode, fit
from daemon.separation.estimator import Quality

_DIMMED = 0.3


@dataclass(frozen=True, slots=True)
class Bit:
    """One quality bit, explained. `colour` is sRGB; `fatal` bits leave a component unknown."""

    flag: Quality
    meaning: str
    remedy: str
    colour: tuple[int, int, int]
    fatal: bool = False

    @property
    def name(self) -> str:
        """As in quality.json."""
        return (self.flag.name or "").lower()

    @property
    def hex(self) -> str:
        """The colour for CSS."""
        return "#{:02x}{:02x}{:02x}".format(*self.colour)


# In the order in which they are painted: the worse over the milder.
BITS: tuple[Bit, ...] = (
    Bit(
        Quality.EDGE,
        "An edge of the pattern lay here: the light is split as that of the pixels around.",
        "Natural in two images and random phases. A checkerboard's shifts show every pixel whole; "
        "larger checkers or patches have fewer edges.",
        (178, 190, 195),
    ),
    Bit(
        Quality.LOW_MODULATION,
        "Direct light is not told from noise here.",
        "Natural in shadow and in pure interreflection. Elsewhere: average more frames, expose "
        "longer, or focus the projector.",
        (86, 180, 233),
    ),
    Bit(
        Quality.DARK,
        "Hardly any light of the source arrives here.",
        "Natural in shadow. Elsewhere: expose longer, or average more frames.",
        (58, 96, 220),
    ),
    Bit(
        Quality.SINGLE,
        "One extreme rests on a single frame, so that noise or a fleck may pass for light.",
        "Take more patterns or frames, so that each pixel is lit and shaded more than once.",
        (201, 162, 126),
    ),
    Bit(
        Quality.NEGATIVE,
        "A component is below zero by more than noise.",
        "Check the black level, the leakage b and the lit fraction; take black and white frames.",
        (0, 184, 148),
    ),
    Bit(
        Quality.DISAGREE,
        "Patterns give different components here: global light varies within a patch or period.",
        "Direct may be too large. Of several frequencies the finer is the one to trust; of one, a "
        "finer pattern tells.",
        (255, 159, 28),
    ),
    Bit(
        Quality.RESIDUE,
        "The pattern came by way of a mirror or of glass: reversed, finer or bent.",
        "Don't trust it there: what is reflected counts as direct. Cover or powder the mirror.",
        (255, 221, 64),
    ),
    Bit(
        Quality.MOVED,
        "Scene, camera or source changed between frames.",
        "Keep everything still, let the lamp warm up, and scan again.",
        (123, 209, 59),
    ),
    Bit(
        Quality.SATURATED,
        "A sample reached the end of the camera's scale: both components are too small.",
        "Expose more briefly, or lower the gain.",
        (255, 84, 54),
    ),
    Bit(
        Quality.NEVER_UNLIT,
        "Never in shadow: direct and global cannot be told apart.",
        "Let the occluder or the pattern pass over this part too.",
        (176, 77, 255),
        fatal=True,
    ),
    Bit(
        Quality.NEVER_LIT,
        "Never seen with the source in full: direct is not known.",
        "Let the occluder or the pattern leave this part free for some frames.",
        (255, 0, 200),
        fatal=True,
    ),
)


def overlay(
    light: NDArray[np.float32], white: float, quality: NDArray[np.uint16], width: int | None = None
) -> Picture:
    """The scene in dim grey, its flagged pixels in their bits' colours.

    `light` (H, W[, 3]) linear, shown as white at `white`; `quality` (H, W). When reduced to `width`
    columns, a lone flagged pixel still tints its place.
    """
    height, width = fit(quality.shape[0], quality.shape[1], width)

    def small(plane: NDArray[np.float32]) -> NDArray[np.float32]:
        if plane.shape == (height, width):
            return plane
        return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_AREA))

    grey = np.nan_to_num(light if light.ndim == 2 else light.mean(axis=2))
    dim = encode(small(grey.astype(np.float32)) * np.float32(_DIMMED / white))
    painted = np.repeat(dim[..., None], 3, axis=2).astype(np.float32)
    for bit in BITS:
        flagged = (quality & np.uint16(bit.flag)) != 0
        if not flagged.any():
            continue
        opacity = np.sqrt(small(flagged.astype(np.float32)))[..., None] * np.float32(0.85)
        painted += (np.asarray(bit.colour, dtype=np.float32) - painted) * opacity
    return np.clip(painted, 0, 255).astype(np.uint8)
