"""The global component at points that are kept unlit, pattern after pattern (§3.5).

At a point whose projector pixels emit u of a lit one's light, in a picture whose mean is g, the
camera sees L = u L_d + g L_g + A; with white W = L_d + L_g + A this is one equation for L_g:

    L_g = ((L - A) - u (W - A)) / (g - u)

u is b where the pattern is unlit, and what the optics blur into it: the pattern is blurred as the
projector was found to blur, and looked up where each camera pixel was found to look.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon import patterns
from daemon.separation.estimator import Lighting, Measurement, NotYet, Observation
from daemon.separation.finish import SIGNIFICANT
from daemon.separation.graycode import Coded, GrayCodeDecoder
from daemon.separation.radiometry import FrameMean, Plane, Response
from daemon.separation.sampling import Moments, Turns
from protocol.patterns import AnyPattern

REACH = 8
"""Camera pixels around a point that are looked at, each way."""
_FITTED = 5  # camera pixels each way that the code is fitted over
_LEAST_FITTED = 12  # of them, to tell the point
_OUTLIER_PX = 1.5  # projector pixels from the fitted plane
_NEAR_PX = 0.5
"""Samples that look so near the middle of the patch are read; with the blur known, also ..."""
_NEAR_BLURRED_PX = 1.0
"""... those up to here: how much of the lit surroundings they get can then be told."""

Anchors = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Spot:
    """A point of interest, in camera pixels."""

    name: str
    x: int
    y: int


@dataclass(frozen=True, slots=True)
class Source:
    """The projector as it was calibrated: size, leakage b (None: measured by the run), and the
    blur of its image, a Gaussian's sigma in its pixels (0: not known)."""

    width: int
    height: int
    leakage: float | None = None
    blur_px: float = 0.0


@dataclass(frozen=True, slots=True)
class Reading:
    """The global component at one point under one pattern (linear counts): its deviation from
    noise, and the pattern's mean level α."""

    light: float
    sd: float
    lit_fraction: float


class _Place:
    """Where a point is on the projector, and which of its window's samples look at its middle."""

    def __init__(
        self, column: Plane, row: Plane, green: NDArray[np.bool_], reach_px: float
    ) -> None:
        """From the decoded coordinates of a window. Raises NotYet where they make no plane."""
        self.x, self.y = _plane(column), _plane(row)
        self.anchor = (round(float(self.x[REACH, REACH])), round(float(self.y[REACH, REACH])))
        away = np.maximum(np.abs(self.x - self.anchor[0]), np.abs(self.y - self.anchor[1]))
        near = green & (away <= reach_px)
        if not near.any():
            near = green & (away == away[green].min())
        self.near: NDArray[np.bool_] = near


class Verification:
    """References, a Gray code, then patterns -> `conclude` of the readings at each point.

    Patterns 0 ... are the code's `images`; then come `count` others, drawn by `pattern(k, anchors)`
    from the points' projector pixels. Memory: the windows, whatever the camera's size.
    """

    def __init__(
        self,
        response: Response,
        spots: Sequence[Spot],
        images: Sequence[Coded],
        source: Source,
        count: int,
        pattern: Callable[[int, Anchors], AnyPattern],
        conclude: Callable[[list[list[Reading]], list[dict[str, Any]]], Measurement],
    ) -> None:
        self._spots = tuple(spots)
        self._images = len(images)
        self._source = source
        self._count = count
        self._pattern = pattern
        self._finish = conclude
        self._bayer = response.bayer
        # Windows stand one below the other: a mosaic's order is lost, samples are as they are.
        self._response = replace(response, bayer="")
        self._decoder = GrayCodeDecoder(self._response, images=images, leakage=0.0)
        self._references = {kind: FrameMean(self._response) for kind in Lighting}
        self._white = Moments()  # its repeats tell noise, which a window's picture cannot
        self._mean = FrameMean(self._response)
        self._turns = Turns()
        self._shape: tuple[int, ...] = ()  # of a frame
        self._sums: list[list[float]] = [[] for _ in spots]
        self._variances: list[list[float]] = [[] for _ in spots]
        self._saturated = np.zeros(len(self._spots), dtype=np.bool_)
        self._places: list[_Place] | None = None
        self._lost: list[str] = []
        self._read: list[list[tuple[float, float, float, int]]] = [[] for _ in spots]

    # ------------------------------------------------------------ frames

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        patterned = observation.lighting is Lighting.PATTERN
        overdue = self._turns.overdue(observation) if patterned else None
        if overdue is not None:
            self._end(overdue)
        if observation.used:
            self._take(pixels, observation)
        if patterned and observation.last:
            self._end(observation.pattern)

    def _take(self, pixels: NDArray[Any], observation: Observation) -> None:
        windows = np.concatenate([self._window(pixels, spot) for spot in self._spots])
        if observation.lighting is not Lighting.PATTERN:
            self._references[observation.lighting].add(windows)
            if observation.lighting is Lighting.WHITE:
                self._white.add(self._response.linear(windows))
                for k in range(len(self._spots)):
                    middle = _cut(windows, k)[REACH - 1 : REACH + 2, REACH - 1 : REACH + 2]
                    self._saturated[k] |= bool((middle >= self._response.saturated_from).any())
        elif observation.pattern < self._images:
            self._shape = pixels.shape
            self._decoder.update(windows, observation)
        else:
            self._mean.add(windows)
            self._note(windows)

    def _end(self, pattern: int) -> None:
        if pattern == self._images - 1:
            self._locate()
        elif pattern >= self._images and self._mean.frames:
            self._close(pattern)

    def _window(self, pixels: NDArray[Any], spot: Spot) -> NDArray[Any]:
        cut = pixels[spot.y - REACH : spot.y + REACH + 1, spot.x - REACH : spot.x + REACH + 1]
        return cut[..., 1] if cut.ndim == 3 else cut  # the paper measures in the green channel

    def _locate(self) -> None:
        places = []
        variance = self._white.variance()
        for k, spot in enumerate(self._spots):
            noise = np.sqrt(_cut(variance, k).mean(), dtype=np.float32)
            planes = self._decoder.coordinates(np.full_like(variance, SIGNIFICANT * noise))
            green = _green(self._bayer, spot, self._shape)
            column, row = _cut(planes["column"], k), _cut(planes["row"], k)
            reach_px = _NEAR_BLURRED_PX if self._source.blur_px else _NEAR_PX
            try:
                places.append(_Place(column, row, green, reach_px))
            except NotYet:
                self._lost.append(spot.name)
        if not self._lost:
            self._places = places

    def _note(self, windows: NDArray[Any]) -> None:
        if self._places is None:
            return
        light = self._response.linear(windows)
        for k, place in enumerate(self._places):
            self._sums[k].append(float(_cut(light, k)[place.near].sum()))

    def _close(self, pattern: int) -> None:
        if self._places is None:
            raise NotYet("patterns came before the points were found on the projector")
        number = pattern - self._images
        image = patterns.render(
            self._pattern(number, self.anchors), self._source.width, self._source.height
        )
        ambient = self._references[Lighting.AMBIENT].value()
        white = self._references[Lighting.WHITE].value()
        b = self.leakage
        alpha = float(image.mean(dtype=np.float64)) / patterns.LEVELS
        g = b + (1 - b) * alpha
        light = self._mean.value() - ambient
        whole = white - ambient
        for k, place in enumerate(self._places):
            near = place.near
            emitted = b + (1 - b) * self._seen(image, place)
            weight = float((g - emitted).sum())
            found = float((_cut(light, k)[near] - emitted * _cut(whole, k)[near]).sum())
            self._read[k].append((found / weight, weight, alpha, self._mean.frames))
            if len(self._sums[k]) > 1:
                self._variances[k].append(float(np.var(self._sums[k], ddof=1)))
            self._sums[k].clear()
        self._mean.clear()

    def _seen(self, image: NDArray[np.uint8], place: _Place) -> Plane:
        """The part of a pattern that the samples near a place's middle see, 0 to 1."""
        half = REACH + 8
        x0, y0 = place.anchor[0] - half, place.anchor[1] - half
        padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REPLICATE)
        x1, y1 = max(x0 + half, 0), max(y0 + half, 0)
        cut = padded[y1 : y1 + 2 * half + 1, x1 : x1 + 2 * half + 1].astype(np.float32) / 255
        if self._source.blur_px:
            cut = np.asarray(
                cv2.GaussianBlur(cut, (0, 0), self._source.blur_px, borderType=cv2.BORDER_REPLICATE)
            )
        x = (place.x[place.near] - x0).astype(np.float32)[None, :]
        y = (place.y[place.near] - y0).astype(np.float32)[None, :]
        seen: Plane = np.asarray(cv2.remap(cut, x, y, cv2.INTER_LINEAR), dtype=np.float32)
        return seen.reshape(-1)

    # ------------------------------------------------------------ results

    @property
    def anchors(self) -> Anchors:
        """The points on the projector. Raises NotYet before the Gray code is in."""
        if self._places is None:
            raise NotYet("the points have not been found on the projector yet")
        return tuple(place.anchor for place in self._places)

    @property
    def leakage(self) -> float:
        """b: as given, else from the run's own black, white and source-off frames."""
        if self._source.leakage is not None:
            return self._source.leakage
        ambient, black, white = (
            self._references[kind].value()
            for kind in (Lighting.AMBIENT, Lighting.BLACK, Lighting.WHITE)
        )
        return max(0.0, float((black - ambient).sum()) / float((white - ambient).sum()))

    def result(self) -> Measurement:
        """See `Estimator`. Raises NotYet before all patterns are in."""
        if self._places is None or len(self._read[0]) < self._count:
            raise NotYet(f"{len(self._read[0])} of {self._count} patterns have been taken")
        readings = []
        for k, rows in enumerate(self._read):
            variance = float(np.mean(self._variances[k])) if self._variances[k] else float("nan")
            readings.append(
                [
                    Reading(light, (variance / frames) ** 0.5 / abs(weight), alpha)
                    for light, weight, alpha, frames in rows
                ]
            )
        return self._finish(readings, self._described())

    def _described(self) -> list[dict[str, Any]]:
        assert self._places is not None
        whole = (
            self._references[Lighting.WHITE].value() - self._references[Lighting.AMBIENT].value()
        )
        return [
            {
                "name": spot.name,
                "camera": [spot.x, spot.y],
                "projector": [
                    round(float(place.x[REACH, REACH]), 2),
                    round(float(place.y[REACH, REACH]), 2),
                ],
                "samples": int(np.count_nonzero(place.near)),
                "white": round(float(_cut(whole, k)[place.near].mean()), 3),
                "saturated": bool(self._saturated[k]),
            }
            for k, (spot, place) in enumerate(zip(self._spots, self._places, strict=True))
        ]

    def summary(self) -> dict[str, float]:
        """Patterns so far, the points on the projector (`x0`, `y0` ...) once they are found, and
        how many of them could not be (`lost`)."""
        found = {"patterns": float(len(self._read[0])), "lost": float(len(self._lost))}
        for name in self._lost:
            found[f"lost {name}"] = 1.0
        if self._places is not None:
            for k, (x, y) in enumerate(self.anchors):
                found |= {f"x{k}": float(x), f"y{k}": float(y)}
        return found


def _cut(stack: NDArray[Any], k: int) -> NDArray[Any]:
    """A point's window in a stack of them."""
    side = 2 * REACH + 1
    return stack[k * side : (k + 1) * side]


def _green(bayer: str, spot: Spot, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which samples of a point's window are green; all where there is no mosaic."""
    side = 2 * REACH + 1
    if not bayer or len(shape) == 3:
        return np.ones((side, side), dtype=np.bool_)
    y, x = np.indices((side, side))
    even = (x + spot.x + y + spot.y) % 2 == 0
    return np.asarray(even if bayer[0] == "G" else ~even)


def _plane(coordinates: Plane) -> Plane:
    """A plane through the coordinates near the middle of a window, outliers left out: float32 of
    the window's size. Raises NotYet."""
    rows, columns = np.indices(coordinates.shape)
    y, x = np.asarray(rows - REACH), np.asarray(columns - REACH)
    use = np.isfinite(coordinates) & (np.maximum(np.abs(x), np.abs(y)) <= _FITTED)
    middle = coordinates[use]
    if middle.size < _LEAST_FITTED:
        raise NotYet("the code cannot be read there")
    use &= np.abs(coordinates - np.median(middle)) <= 3 * _FITTED
    fitted = np.zeros(coordinates.shape)
    for _ in range(3):
        if np.count_nonzero(use) < _LEAST_FITTED:
            raise NotYet("the code makes no surface there")
        design = np.stack([np.ones(np.count_nonzero(use)), x[use], y[use]], axis=1)
        solved, *_ = np.linalg.lstsq(design, coordinates[use].astype(np.float64), rcond=None)
        fitted = solved[0] + solved[1] * x + solved[2] * y
        use &= np.abs(coordinates - fitted) <= _OUTLIER_PX
    if not np.ptp(coordinates[use]):  # one coarse cell: its middle may be far from the point
        raise NotYet("the code's fine stripes cannot be read there")
    return fitted.astype(np.float32)
