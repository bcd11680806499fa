"""How finely a pattern lies in the picture: a curved mirror shows it smaller than surfaces do.

Where a camera and a projector stand at similar distances from a scene, a patch of the projector is
about as large in the picture wherever it falls, and a slanted surface makes it narrower one way
only. A convex mirror (the paper's Fig. 8) makes all that it shows smaller, both ways. So where the
pattern changes from pixel to pixel much more often than in most of the picture, along rows and
along columns, its light came by way of a mirror. This needs no order of shifts and no coordinate:
it is all that a pair of images or random patterns tell of mirrors. A flat one stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from daemon.separation.handedness import Wave
from daemon.separation.radiometry import Plane
from daemon.separation.sampling import Mask, thinned

FINER = 2.2
"""How many times the picture's own rate of change, each way, is a mirror's."""

_RESOLVED = 0.45  # typical change from pixel to pixel from which a finer pattern is not told apart
_PERIODS = 2.0  # changes of the pattern across a window
_LEAST, _MOST = 9, 65  # pixels of a window
_FADE = np.float32(2.5)  # deviations of noise below which a sign fades
_AROUND = 5  # pixels over which a pattern must be strong
_TINY = np.float32(1e-6)
_STRONG = 4.0  # mean strength there
_TRUSTED = 0.5  # of the noise that is stated is surely there: one picture gives an upper bound
_FILLED = 0.3  # of a window's steps must be between strong pixels
_STRIPES = 11  # pixels of a window on stripes
_ASTRAY = 0.7  # change from pixel to pixel along stripes, of 1 for light without order
_ENOUGH = 400  # steps that make a picture's own rate


def finer_pattern(wave: Wave, strength: Plane, *, smooth: bool = False) -> Mask | None:
    """Where the pattern is finer than in most of the picture: (H, W) bool; None where the camera
    resolves the pattern too badly, or sees too little of it, to tell.

    `wave` (H, W), real or complex: what a pattern (or a weighted sum of patterns) of mean 0 gives
    at each pixel, of which the sign or the phase counts; `strength` (H, W): its amplitude in
    standard deviations of its noise.
    """
    sign = _faded(wave, strength)
    steps = [_steps(sign, axis) for axis in (1, 0)]
    if min(np.count_nonzero(both) for _, both in steps) < _ENOUGH:
        return None
    # a faded sign changes by less: by as much as its square
    rates = [float(change.sum() / sign.power[both].sum()) for change, both in steps]
    if max(rates) > _RESOLVED or min(rates) <= 0.0:
        return None
    per_step = np.sqrt(min(rates)) if smooth else min(rates)
    size = int(np.clip(round(_PERIODS / per_step), _LEAST, _MOST)) | 1
    ratios = []
    around = np.maximum(cv2.blur(sign.power, (size, size)), np.float32(1e-3))
    for change, both in steps:
        filled = cv2.blur(both.astype(np.float32), (size, size)) > np.float32(_FILLED)
        local = cv2.blur(change, (size, size)) / around
        usable = local[both & filled]
        if usable.size < _ENOUGH:
            return None
        typical = float(np.median(thinned(usable)))
        ratios.append(local * filled * np.float32(1.0 / max(typical, 1e-3)))
    # a step of a smooth wave grows with its frequency, and so does its square
    dense = np.minimum.reduce(ratios) > np.float32(FINER**2 if smooth else FINER)
    kernel = np.ones((size // 2 | 1,) * 2, np.uint8)
    wide = np.asarray(cv2.morphologyEx(dense.astype(np.uint8), cv2.MORPH_OPEN, kernel)) > 0
    return np.asarray(wide)


def _steps(of: _Sign, axis: int) -> tuple[Plane, Mask]:
    """Half the squared change from each pixel to the next along an axis, and where both are strong;
    a frame's shape, the last row or column none."""
    change = np.zeros(of.noise.shape, dtype=np.float32)
    both = np.zeros(of.noise.shape, dtype=np.bool_)
    first, second = (
        (by, slice(None)) if axis == 0 else (slice(None), by)
        for by in (slice(None, -1), slice(1, None))
    )
    both[first] = of.strong[first] & of.strong[second]
    turned = -of.noise[first] - of.noise[second]
    for part in of.parts:
        turned += np.square(part[second] - part[first])
    np.multiply(turned, both[first] * np.float32(0.5), out=change[first])
    return change, both


def astray(wave: Plane, strength: Plane, across: str) -> Mask | None:
    """Where stripes run another way than in most of the picture, or are too fine for the camera:
    (H, W) bool; None where there are too few stripes to tell.

    `wave` (H, W) from -1 unlit to 1 lit of stripes across the axis `across`, texture taken out;
    `strength` as for `finer_pattern`. Along a stripe, light changes slowly, however it is bent.
    """
    sign = _faded(wave.astype(np.complex64), strength)
    change, both = _steps(sign, 0 if across == "x" else 1)
    if np.count_nonzero(both) < _ENOUGH:
        return None
    around = cv2.blur(sign.power, (_STRIPES, _STRIPES))
    local = cv2.blur(change, (_STRIPES, _STRIPES)) / np.maximum(around, np.float32(1e-3))
    part = cv2.blur(both.astype(np.float32), (_STRIPES, _STRIPES))
    if float(np.median(local[part > _FILLED])) > 0.5 * _ASTRAY:
        return None
    kernel = np.ones((_AROUND, _AROUND), np.uint8)
    found = ((part > _FILLED) & (local > np.float32(_ASTRAY))).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(found, cv2.MORPH_OPEN, kernel)) > 0


@dataclass(frozen=True, slots=True)
class _Sign:
    """The sign or phase of a wave, its real and imaginary part; the noise in its square, its square
    without it, and where it is strong. It fades near 0, where noise would make it change to and
    fro, and is 0 where it is not strong."""

    parts: tuple[Plane, Plane]
    noise: Plane
    power: Plane
    strong: Mask


def _faded(wave: Wave, strength: Plane) -> _Sign:
    strong = np.asarray(cv2.blur(strength, (_AROUND, _AROUND))) > np.float32(_STRONG)
    real, imaginary = (np.ascontiguousarray(part) for part in (wave.real, wave.imag))
    squared = np.square(strength) + np.float32(_FADE**2)
    share = strong.astype(np.float32) / squared
    size = np.asarray(cv2.magnitude(real, imaginary), dtype=np.float32)
    scale = np.sqrt(share) * strength / np.maximum(size, _TINY)
    noise: Plane = share * np.float32(_TRUSTED)
    power = share * np.square(strength) - noise
    return _Sign((real * scale, imaginary * scale), noise, power, strong)
