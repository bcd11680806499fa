"""The equations: what is seen under high-frequency light, solved for direct and global (§3.3).

Symbols are the paper's: α lit fraction of the source, b leakage (brightness of an unlit source
element as a fraction of a lit one). All light is linear, float32, any shape; α and b are scalars.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]


def global_weight(lit_fraction: float, leakage: float = 0.0) -> float:
    """g = α + b(1 - α): the part of the global component that a pattern excites (Eq. 8)."""
    return lit_fraction + leakage * (1.0 - lit_fraction)


def from_extremes(
    brightest: Plane, darkest: Plane, lit_fraction: float, leakage: float = 0.0
) -> tuple[Plane, Plane]:
    """Direct and global from L_max and L_min over images of the same lit fraction (Eq. 8, 9).

    L_max = L_d + g L_g and L_min = b L_d + g L_g give L_d = (L_max - L_min)/(1 - b) and
    L_g = (L_min - b L_max)/((1 - b) g). A stick is α = 1, b = 0; a mesh α = β, b = 0 (§4.2).
    """
    g = global_weight(lit_fraction, leakage)
    direct = (brightest - darkest) * np.float32(1.0 / (1.0 - leakage))
    if leakage == 0.0:
        return direct, darkest * np.float32(1.0 / g)
    indirect = darkest - np.float32(leakage) * brightest
    indirect *= np.float32(1.0 / ((1.0 - leakage) * g))
    return direct, indirect


def from_complement_pair(
    first: Plane, second: Plane, lit_fraction: float, leakage: float = 0.0
) -> tuple[Plane, Plane]:
    """Direct and global from a pattern of lit fraction α and its complement (Eq. 8).

    The images excite g = α + b(1 - α) and h = (1 - α) + bα of the global component, so a pixel was
    lit in the first one where h I_1 > g I_2; with p the weight of the image in which it was lit
    and q the other's, I_lit = L_d + p L_g and I_unlit = b L_d + q L_g.
    Raises ValueError where this is singular (`complement_determinants`).
    """
    g = global_weight(lit_fraction, leakage)
    h = global_weight(1.0 - lit_fraction, leakage)
    if min(complement_determinants(lit_fraction, leakage)) <= 0.0:
        raise ValueError(f"a complement pair cannot be separated with α = {lit_fraction:g}")
    in_first = np.float32(h) * first > np.float32(g) * second
    lit = np.where(in_first, first, second)
    unlit = np.where(in_first, second, first)
    p = np.where(in_first, np.float32(g), np.float32(h))
    q = np.where(in_first, np.float32(h), np.float32(g))
    determinant = q - np.float32(leakage) * p
    direct: Plane = (q * lit - p * unlit) / determinant
    indirect: Plane = (unlit - np.float32(leakage) * lit) / determinant
    return direct, indirect


def complement_determinants(lit_fraction: float, leakage: float = 0.0) -> tuple[float, float]:
    """Determinants of Eq. 8 for pixels lit in the first and in the second image.

    Both must be above 0: (1 - α)(1 - b²) and α(1 - b²), so α = 1 is singular.
    """
    g = global_weight(lit_fraction, leakage)
    h = global_weight(1.0 - lit_fraction, leakage)
    return h - leakage * g, g - leakage * h


def from_mesh_and_open(
    brightest: Plane, darkest: Plane, unoccluded: Plane, hole_fraction: float
) -> tuple[Plane, Plane, Plane]:
    """Direct, global and ambient of a scene behind a moving mesh, with a frame without it (§4.2).

    L_max = L_d + β L_g + A, L_min = β L_g + A, L_open = L_d + L_g + A, so
    L_g = (L_open - L_max)/(1 - β) and A = L_min - β L_g. Raises ValueError for β = 1.
    """
    if not 0.0 < hole_fraction < 1.0:
        raise ValueError(f"a mesh has a hole fraction between 0 and 1, not {hole_fraction:g}")
    direct = brightest - darkest
    indirect = (unoccluded - brightest) * np.float32(1.0 / (1.0 - hole_fraction))
    return direct, indirect, darkest - np.float32(hole_fraction) * indirect


def ambient_from_black_and_white(black: Plane, white: Plane, leakage: float) -> Plane:
    """A = (K - bW)/(1 - b): light that is not the source's, from a black and a white frame.

    K = A + b(L_d + L_g) and W = A + L_d + L_g, the source showing black and white.
    """
    ambient: Plane = (black - np.float32(leakage) * white) * np.float32(1.0 / (1.0 - leakage))
    return ambient


def ambient_from_black(
    black: Plane, brightest: Plane, darkest: Plane, lit_fraction: float, leakage: float
) -> Plane:
    """A from a black frame and the extremes: K takes its leakage with it.

    L - K = (1 - b)(lit L_d + α L_g) is the light model without leakage, so L_d and L_g follow from
    the extremes less K, and A = K - b(L_d + L_g). With b = 0 this is K.
    """
    if leakage == 0.0:
        return black
    total: Plane = (brightest - darkest) + (darkest - black) * np.float32(1.0 / lit_fraction)
    ambient: Plane = black - total * np.float32(leakage / (1.0 - leakage))
    return ambient
