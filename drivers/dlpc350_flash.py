"""The images in a DLPC350's flash: found by content, and put in order for a sequence.

The flash holds 24-bit images, made into the firmware with TI's GUI out of 912 x 1140 files. Each is
24 black and white patterns, or three of 8 bits. rig.toml lists the same files in the same order;
whatever is to be shown is looked up among their patterns. White and black the board makes itself.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import dlpc350_protocol as p
from drivers import dmd
from drivers.base.errors import DeviceRefused

KEPT = 2  # images that the board holds at once: only a third must be waited for


@dataclass(frozen=True, slots=True)
class Place:
    """Where a pattern is: which image, which of its patterns, of how many bits."""

    index: int  # -1: the board makes it
    number: int
    bits: int = 1
    invert: bool = False

    def entry(self, led: p.Led) -> p.Entry:
        """It, in the pattern table."""
        return p.Entry(self.number, bits=self.bits, led=led, invert=self.invert)


WHITE = Place(-1, p.FILL)
BLACK = Place(-1, p.FILL, invert=True)


class FlashImages:
    """What is in flash, by content."""

    def __init__(self, device: str, files: Sequence[str], load_ms: float) -> None:
        self._device = device
        self._files = files
        self._load_us = load_ms * 1e3
        self._found: dict[bytes, Place] = {}

    def read(self) -> None:
        """Read the files. Raises DeviceRefused, naming the one that cannot be."""
        self._found = {}
        for index, name in enumerate(self._files):
            picture = cv2.imread(name, cv2.IMREAD_COLOR) if Path(name).is_file() else None
            if picture is None or picture.shape != (dmd.ROWS, dmd.COLUMNS, 3):
                size = "no picture"
                if picture is not None:
                    size = f"{picture.shape[1]} x {picture.shape[0]}"
                raise DeviceRefused(
                    self._device,
                    "connect",
                    f"flash image {index}, {name}, is {size}",
                    f"give the {dmd.COLUMNS} x {dmd.ROWS} files that the firmware was made of",
                )
            frame = np.asarray(picture[..., ::-1], np.uint8)
            for number in range(dmd.PLANES):
                channel = frame[..., dmd.ORDER[number // 8]]
                key = _digest(np.packbits(channel & np.uint8(1 << number % 8)))
                self._found.setdefault(key, Place(index, number))
            for number in range(3):
                key = _digest(dmd.plane(frame, number, 8))
                self._found.setdefault(key, Place(index, number, 8))

    def find(self, phase: str, mirrors: NDArray[np.uint8]) -> Place:
        """Where an image (1140, 912) is. Raises DeviceRefused."""
        if not mirrors.any():
            return BLACK
        if (mirrors == 255).all():
            return WHITE
        binary = np.count_nonzero(mirrors) == np.count_nonzero(mirrors == 255)
        place = self._found.get(_digest(np.packbits(mirrors) if binary else mirrors))
        if place is None:
            raise DeviceRefused(
                self._device,
                phase,
                "this image is not in flash",
                "add it to the firmware with TI's GUI and to `flash` in rig.toml, or use `display`",
            )
        return place

    def arrange(
        self, images: Sequence[NDArray[np.uint8]], period_us: int, led: p.Led
    ) -> tuple[list[p.Entry], list[int]]:
        """The pattern table for a sequence, and the flash images in the order of their use.

        Raises DeviceRefused for an image that is not in flash, or that cannot be fetched in time.
        """
        entries: list[p.Entry] = []
        order: list[int] = []
        served: list[int] = []  # how many patterns come of each
        for image in images:
            place = self.find("load", image)
            swap = False
            if place.index >= 0 and order and order[-1] == -1:
                order[-1] = place.index  # only black and white so far: any image does for them
            elif not order or place.index not in {-1, order[-1]}:
                order.append(place.index)
                served.append(0)
                swap = True
            served[-1] += 1
            entries.append(replace(place.entry(led), swap=swap))
        self._check(order, min(served) * period_us)
        return entries, [max(index, 0) for index in order]

    def _check(self, order: list[int], shortest_us: int) -> None:
        if len(order) > p.INDICES:
            raise DeviceRefused(
                self._device,
                "load",
                f"the sequence changes between flash images {len(order)} times",
                f"{p.INDICES} at most: put patterns that follow one another into one image",
            )
        if len(order) > KEPT and shortest_us < self._load_us:
            raise DeviceRefused(
                self._device,
                "load",
                f"a flash image takes {self._load_us / 1e3:g} ms to fetch, and one of them is "
                f"shown for {shortest_us / 1e3:g} ms only",
                "choose a longer period, or put patterns that follow one another into one image",
            )


def _digest(image: NDArray[np.uint8]) -> bytes:
    return hashlib.blake2b(image.tobytes(), digest_size=16).digest()
