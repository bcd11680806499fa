"""What a source of a size leaves of an occluder's shadow: a penumbra, and less umbra or none.

Lengths are in mm in the occluder's own plane, where the source seen from the scene is a disc as
wide as the penumbra.
"""

from __future__ import annotations

import math


def penumbra_mm(scene_mm: float, *, source_deg: float) -> float:
    """Its width, of a source of an angular diameter as seen from the scene, which lies `scene_mm`
    behind the occluder."""
    return scene_mm * 2.0 * math.tan(math.radians(source_deg) / 2.0)


def beside_a_stick(width_mm: float, penumbra: float) -> float:
    """Leakage b: the part of the source that a straight stick leaves where it hides the most, 0 if
    it is as wide as the penumbra. A stripe through the middle of the disc is what it hides."""
    hidden = min(width_mm / penumbra, 1.0) if penumbra > 0 else 1.0
    return 1.0 - (math.asin(hidden) + hidden * math.sqrt(1.0 - hidden**2)) * 2.0 / math.pi
