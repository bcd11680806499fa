"""What black and white frames say of a scan taken after them: did the scene or the source change?

Half of the source, whichever half, lights a pixel on average with ½(W + K), ambient light and
leakage included: the middle of a checkerboard's extremes, a sinusoid's mean, a pattern with its
inverse. Blur moves none of them. So a pixel that has another mean moved, and a picture that has one
all over had another source, or a tone curve that is not the one given.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import Lighting, Quality
from daemon.separation.finish import bits
from daemon.separation.radiometry import Plane
from daemon.separation.references import References
from daemon.separation.sampling import thinned

HALF = 0.02
"""Lit fractions so near to a half are one."""

_DEVIATIONS = 6.0  # of noise, and ...
_PART = 0.1  # of the light: less is a bend of a tone curve, or light that was not smooth
_OFF = 0.02  # of the light, all over the picture
_WHOLLY_OFF = 0.1  # from here nothing is said of single pixels
_OVER = 0.005  # leakage above what the black frame allows
_NOTED = 0.01  # of direct light, by which leakage may be wrong: it is said
_PLAIN = 0.05  # relative spread of K/W below which it is no room's light
_SPECK = 3  # pixels a side: what is smaller is noise
_CALM = 9  # pixels a side over which light is averaged


def compare(
    references: References, half: Plane, deviation: Plane, leakage: float, *, ranked: bool = False
) -> tuple[NDArray[np.uint16] | None, dict[str, Any], list[str]]:
    """MOVED bits (H, W), facts, and advice, of `half` the source's light at each sample and the
    deviation of its noise; `ranked` light may be off by one. None and {} without black and white
    frames.

    Facts: `mean_ratio`, the median of half/½(W + K), 1 where all is well.
    """
    black, white = references.mean(Lighting.BLACK), references.mean(Lighting.WHITE)
    clipped = references.white_saturated
    if black is None or white is None or clipped is None:
        return None, {}, []
    expected = (white + black) * np.float32(0.5)
    good = _good(black, white, clipped)
    if not thinned(good).any():
        return None, {}, []
    some = thinned(good)
    usual = np.maximum(thinned(expected)[some], np.float32(1e-6))
    ratio = float(np.median(thinned(half)[some] / usual))
    facts = {"mean_ratio": round(ratio, 4)}
    lines: list[str] = []
    noisy = float(np.median(thinned(deviation)[some] / usual))
    if abs(ratio - 1.0) >= max(_OFF, noisy if ranked else 0.0):
        lines.append(
            f"under half of the source the scene has {ratio:.2f} of half the light of white and "
            "black, not 1: the projector's or the camera's tone curve is not linear, or the source "
            "drifted, and global is wrong by as much: run `umbra calibrate tone`, give the "
            "camera's curve with --tone, or let the lamp warm up"
        )
    else:  # a wrong tone curve makes any K/W
        lines += leaks(references, leakage)
    if abs(ratio - 1.0) >= _WHOLLY_OFF:
        return None, facts, lines
    limit = np.maximum(np.float32(_DEVIATIONS) * deviation, np.float32(_PART) * np.abs(expected))
    off = (np.abs(half - np.float32(ratio) * expected) > limit) & ~clipped
    moved = off if off.ndim == 2 else np.asarray(np.logical_or.reduce(off, axis=2))
    kernel = np.ones((_SPECK, _SPECK), np.uint8)
    opened = cv2.morphologyEx(moved.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    return bits(np.asarray(opened) > 0, Quality.MOVED), facts, lines


def _good(black: Plane, white: Plane, clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Samples that the source lights."""
    lit = white - black
    return ~clipped & (lit > np.float32(0.1 * float(np.quantile(thinned(lit), 0.99))))


def _calm(plane: Plane) -> Plane:
    """With less noise."""
    return np.asarray(cv2.blur(plane, (_CALM, _CALM)), dtype=np.float32).reshape(plane.shape)


def leaks(references: References, leakage: float) -> list[str]:
    """What K/W says of the leakage b: with ambient light it is b or more, everywhere; less a frame
    with the source off, (K - A)/(W - A), it is b. Lines of advice; [] without black and white
    frames."""
    dark, lit = references.mean(Lighting.BLACK), references.mean(Lighting.WHITE)
    off, clipped = references.mean(Lighting.AMBIENT), references.white_saturated
    if dark is None or lit is None or clipped is None:
        return []
    good = _good(dark, lit, clipped)
    if not thinned(good).any():
        return []
    some = thinned(good)
    black, white = thinned(_calm(dark))[some], thinned(_calm(lit))[some]
    middle = float(np.median(black / white))
    if middle < -_OVER:
        return [
            f"black frames are below black, by {-middle:.3f} of the light of white ones: the black "
            "level that was given is too high (--black, `umbra calibrate dark`)"
        ]
    if off is not None:
        room = thinned(_calm(off))[some]
        return _measured((black - room) / (white - room), leakage)
    return _bounded(black / white, white, leakage)


def _bounded(ratio: Plane, white: Plane, leakage: float) -> list[str]:
    """What K/W, a bound of the leakage, says of the one given."""
    least, low, middle, high, most = _quantiles(ratio, 0.05, 0.25, 0.5, 0.75, 0.95)
    if leakage > middle + _OVER:
        return [
            f"the leakage {leakage:g} cannot be: black frames have {middle:.3f} of the light of "
            "white ones, ambient light included: measure it with `umbra calibrate leak`, or give "
            f"--leakage {max(middle, 0.0):.3f} at most"
        ]
    dim, typical, bright = _quantiles(white, 0.25, 0.5, 0.75)
    scatter = (high - low) / max(middle - leakage, 1e-6)
    contrast = (bright - dim) / max(typical, 1e-6)
    # an even light would make K/W differ as much as W does
    if middle > leakage + _NOTED and scatter < min(_PLAIN, 0.5 * contrast):
        return [
            f"black frames have {middle:.3f} of the light of white ones all over the picture, as "
            f"leakage does and a room's light seldom, but it is taken as {leakage:g}: "
            f"give --leakage {middle:.3f}, or measure it with `umbra calibrate leak`"
        ]
    if leakage == 0.0 and most > _NOTED:
        return [
            f"leakage is taken as none, and black frames have {max(least, 0.0):.3f} to {most:.3f} "
            "of the light of white ones, the room's light included: where that is leakage direct "
            f"is too small by as much, up to {most:.1%} (by {max(least, 0.0):.1%} at most if it "
            "is alike all over), and global too large: run `umbra calibrate leak`, or add a frame "
            "with the source off (--ambient-frame), which tells leakage from the room's light"
        ]
    return []


def _measured(found: Plane, leakage: float) -> list[str]:
    """What the leakage, as black, white and source-off frames have it, says of the one given."""
    low, middle, high = _quantiles(found, 0.05, 0.5, 0.95)
    if max(abs(low - leakage), abs(high - leakage)) <= _NOTED:
        return []
    return [
        f"black, white and source-off frames have a leakage of {middle:.3f} ({low:.3f} to "
        f"{high:.3f} over the picture), but it is taken as {leakage:g}: direct is wrong by the "
        f"difference, up to {max(abs(low - leakage), abs(high - leakage)):.1%} of it: give "
        f"--leakage {max(middle, 0.0):.3f}, or measure it with `umbra calibrate leak`"
    ]


def _quantiles(values: Plane, *at: float) -> list[float]:
    return [float(q) for q in np.quantile(values, at)]
