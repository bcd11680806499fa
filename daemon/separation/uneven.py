"""Where light is not the same under patterns of one lit fraction: scattered, or reflected, over
less than a patch of theirs, or by gloss.

Samples of a pixel that all are wholly lit differ by noise, and those that are wholly unlit; with
blur some are neither, by where the pixel lies in the pattern. Where light is not smooth they differ
by it as well, and so does the result: no step from unlit to lit is direct light alone.
"""

from __future__ import annotations

from statistics import NormalDist

import cv2
import numpy as np

from daemon.separation.radiometry import Plane
from daemon.separation.sampling import thinned
from daemon.separation.unsmooth import Unsmooth

_BOX = 9  # pixels across that a spread is averaged over: noise moves their mean by 3 % ...
_SURE = 1.1  # ... and by more than three times that hardly ever
_PATCHES = 25  # pixels across: edges of random patches are blurred, and must be in each mean
_CALM = 0.25  # of the bright pixels have no larger spread by blur and place ...
_USUAL = 2.2  # ... and hardly any has so many times theirs
_BRIGHT = 0.2  # of the largest steps: where the usual spread is looked for
_ERROR = 2.0  # of components, over the spread beyond all that: 1.6 in creases, 2.5 in milk
_TINY = np.float32(1e-6)
_SAID = (
    "in {:.1%} of the pixels light is not the same under patterns of one lit fraction, and direct "
    "may be off, most of all too large, by about the stated deviation: light is scattered or "
    "reflected over less than a checker or patch there (finer patterns tell: --checker, --patch), "
    "or the projector is out of focus, or something moved"
)


def unevenness(
    low: Plane,
    high: Plane,
    noise: Plane,
    known: Plane,
    patterns: int,
    *,
    shifted: bool,
) -> Unsmooth:
    """What the ranks of samples differ by beyond noise and what is usual in the scene.

    `low`, `high` (K, H, W[, 3]): the light of the darkest and brightest samples of so many
    patterns, the most extreme first; `noise` (H, W[, 3]): the deviation of a sample; `known`: the
    larger of those of the components by noise. All float32. `shifted`: each pixel has been at every
    place of one pattern; under random patches blur moves those at edges, and not the others.
    """
    error = _error(low, high, noise, patterns, _BOX if shifted else _PATCHES)
    return Unsmooth.judged(error, known, high[0], _SAID)


def _error(low: Plane, high: Plane, noise: Plane, patterns: int, across: int) -> Plane:
    step = np.maximum(high[0] - low[0], _TINY)
    around = _mean(step, across)
    spread = np.square(_mean((high[0] - high[-1]) + (low[-1] - low[0]), across))
    of_noise = np.square(
        _mean(noise, across) * np.float32(2.0 * _distance(len(low), patterns // 2))
    )
    bright = thinned(step)
    share = thinned(np.maximum(spread - of_noise, 0) / np.square(around))
    lit = bright >= np.float32(_BRIGHT) * np.quantile(bright, 0.99)
    usual = np.float32(_USUAL**2 * np.quantile(share[lit], _CALM))
    spread -= np.float32(_SURE**2) * of_noise + usual * np.square(around)
    # as a part of the step: the colours of a mosaic differ in light
    part = np.sqrt(np.maximum(spread, 0, out=spread)) / around
    return np.asarray(np.float32(_ERROR) * part * step, dtype=np.float32)


def _mean(plane: Plane, across: int) -> Plane:
    mean = cv2.blur(plane, (across, across), borderType=cv2.BORDER_REFLECT)
    return np.asarray(mean, dtype=np.float32)


def _distance(keep: int, samples: int) -> float:
    """The largest of so many samples of deviation 1 less the keep-th largest, on the average (by
    Blom's places)."""
    samples = max(samples, keep)
    first, last = (
        NormalDist().inv_cdf(1.0 - (rank - 0.375) / (samples + 0.25)) for rank in (1, keep)
    )
    return first - last
