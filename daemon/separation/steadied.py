"""A separation from frames that a shaking camera took: what interpolation spoils is left out.

A frame that the camera took from another place is moved back, and interpolated. In smooth places
nothing is lost; at edges light is mixed that no pixel saw, and the brightest and darkest of many
samples find each such mixture. So there are two collections of the same frames:

- *sure*: a moved frame's samples count where interpolation changes less than noise does;
- *all*: all of them count.

Each pixel's components are the sure ones. Where those are not known, for the camera never stood
still while the shadow passed an edge, they are those of all, and marked as moved. Where it shook in
most of the frames all components are those of all. Until a frame is
moved there is one collection, and its result is that of the estimator alone, bit for bit.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.separation.estimator import (
    Components,
    Estimator,
    Lighting,
    NotYet,
    Observation,
    Quality,
)
from daemon.separation.finish import bits, count
from daemon.separation.noise import Noise
from daemon.separation.radiometry import Response
from daemon.separation.warping import aligned, beyond, uncertain

UNKNOWN = np.uint16(Quality.NEVER_LIT | Quality.NEVER_UNLIT)
"""Pixels whose components are not known."""

_LEFT_OUT = 0.5  # of the frames: what is left may never have been in full light, or in the umbra
_MOSTLY = 0.5  # of the frames: if as many are moved, few pixels have sure samples enough
_SHOOK = (
    "The camera shook in most of the frames: edges are interpolated, and less sharp; a "
    "firmer tripod shows them as they are"
)
_MARKED = 0.01  # of the pixels: as many that are moved are worth a line of advice


class Extremes(Estimator, Protocol):
    """An estimator of each pixel's brightest and darkest samples. Frames come to it in place; of an
    observation's warp it need know only that the frame was interpolated."""

    def update(
        self,
        pixels: NDArray[Any],
        observation: Observation,
        left_out: NDArray[np.bool_] | None = None,
    ) -> None:
        """See `Estimator`. The pixels (H, W) that are `left_out` count as neither lit nor unlit,
        but in a collection's first frame."""
        ...

    def brightest(self) -> NDArray[Any] | None:
        """Each pixel's brightest sample so far, encoded; None: there is none."""
        ...

    def noise(self) -> Noise | None:
        """The camera's noise, as far as the frames tell."""
        ...


class Steadied:
    """The estimator of an occluder's frames (see `Estimator`), whatever the camera did."""

    def __init__(
        self, response: Response, make: Callable[[], Extremes], *, few: bool = False
    ) -> None:
        """`few`: each pixel is in shadow in a few frames only, of which none can be left out."""
        self._response = response
        self._few = few
        self._bayer = bool(response.bayer)
        self._sure = make()
        self._all: Extremes | None = None
        self._frames = 0  # of this collection
        self._moved = 0  # of them
        self._left_out = np.zeros((0, 0), np.uint16)  # of them, those that tell nothing of a pixel
        self._spoiled: NDArray[np.bool_] | None = None  # by a collection's first frame, if moved

    def update(self, pixels: NDArray[Any], observation: Observation) -> None:
        """See `Estimator`."""
        if observation.fresh:
            self._all = self._spoiled = None
            self._frames = self._moved = 0
        if observation.used and observation.warp is not None:
            self._take_moved(pixels, observation, observation.warp)
            return
        self._frames += observation.used and observation.lighting is Lighting.PATTERN
        for one in (self._sure, self._all):
            if one is not None:
                one.update(pixels, observation)

    def _take_moved(
        self, pixels: NDArray[Any], observation: Observation, warp: tuple[float, ...]
    ) -> None:
        outside = beyond(pixels.shape, warp, self._bayer)
        moved = aligned(pixels, warp, self._bayer)
        moved = self._response.scaled(moved, 1.0 / observation.strength)
        observation = msgspec.structs.replace(observation, strength=1.0)
        if self._few:
            self._sure.update(moved, observation, outside)
            return
        scene = noise = None
        if not observation.fresh:  # else they would be those of the collection before
            scene, noise = self._sure.brightest(), self._sure.noise()
        doubtful = outside | uncertain(pixels, warp, self._bayer, noise, scene)
        if self._all is None:
            self._all = copy.deepcopy(self._sure)
            if scene is None:
                self._spoiled = doubtful
            self._left_out = np.zeros(doubtful.shape, np.uint16)
        self._left_out += doubtful
        self._frames += 1
        self._moved += 1
        self._sure.update(moved, observation, doubtful)
        self._all.update(moved, observation, outside)

    def result(self) -> Components:
        """See `Estimator`. Raises NotYet."""
        if self._all is None:
            return _components(self._sure)
        every = _components(self._all)
        if self._moved > _MOSTLY * self._frames:
            return replace(every, facts={**every.facts, "advice": [*every.facts["advice"], _SHOOK]})
        try:
            sure = _components(self._sure)
        except NotYet:
            return every
        return self._joined(sure, every)

    def _joined(self, sure: Components, every: Components) -> Components:
        """The sure components, and those of all frames where they are needed."""
        lacking = sure.quality & UNKNOWN != 0
        lacking |= self._left_out > _LEFT_OUT * self._frames
        if self._spoiled is not None:
            lacking |= self._spoiled
        lacking &= every.quality & UNKNOWN == 0

        def chosen(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
            where = lacking if one.ndim == 2 else lacking[..., None]
            return np.where(where, other, one)

        quality = chosen(sure.quality, every.quality) | bits(lacking, Quality.MOVED)
        facts = {**every.facts, "quality": count(quality)}
        share = float(lacking.mean())
        if share > _MARKED:
            line = (
                f"{share:.1%} of the pixels lie at edges that the shadow passed only while the "
                "camera was elsewhere: they are interpolated, and marked as moved; a firmer "
                "tripod, or a longer scan, shows them as they are"
            )
            facts["advice"] = [*every.facts["advice"], line]
        return Components(
            chosen(sure.direct, every.direct),
            chosen(sure.global_, every.global_),
            quality,
            {name: chosen(sure.planes[name], plane) for name, plane in every.planes.items()},
            facts,
        )

    def summary(self) -> dict[str, float]:
        """See `Estimator`: of the sure samples."""
        return self._sure.summary()


def _components(one: Extremes) -> Components:
    found = one.result()
    assert isinstance(found, Components)
    return found
