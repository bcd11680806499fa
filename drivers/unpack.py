"""Pixel layouts: the names that cameras use for their buffers, and the buffers as plain samples.

Names are the GenICam Pixel Format Naming Convention's (PFNC), and GigE Vision's older ones. Of the
ways to store 10, 12 and 14 bit samples:

- plain: two bytes a sample, little endian, in the low bits (Mono12);
- `p`: one stream of bits, the least significant first (Mono12p: 2 samples in 3 bytes);
- `Packed`: GigE Vision's pairs: high byte, both samples' low bits, high byte (Mono12Packed);
- CSI-2: a group's high bytes, then its low bits as one stream (V4L2's Y12P, pRCC ...).
"""

from __future__ import annotations

import enum
import functools
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base.pixelformat import PixelFormat


class Packing(enum.StrEnum):
    """How samples lie in bytes; see the module."""

    PLAIN = "plain"
    STREAM = "p"
    GIGE = "Packed"
    CSI2 = "CSI-2"


@dataclass(frozen=True, slots=True)
class Layout:
    """How a buffer holds an image: what comes out, how samples lie, in which order colours do."""

    pixel_format: PixelFormat
    packing: Packing = Packing.PLAIN
    order: str = ""  # of an RGB format's samples: RGB, BGR, RGBa, BGRa

    @property
    def samples(self) -> int:
        """Samples a pixel as stored, alpha included."""
        return len(self.order) or 1

    def row_bytes(self, samples: int) -> int:
        """Bytes that so many samples take, the last group cut to whole bytes."""
        if self.packing is Packing.PLAIN:
            return samples * self.pixel_format.dtype.itemsize
        bits = 12 if self.packing is Packing.GIGE else self.pixel_format.bits
        if self.packing is Packing.CSI2:
            group = _group(self.packing, self.pixel_format.bits)
            return -(-samples // group.samples) * group.bytes
        return (samples * bits + 7) // 8


_NAME = re.compile(
    r"(?P<kind>Mono|Bayer(?:RG|GR|GB|BG)|(?P<order>RGB|BGR)(?P<alpha>[aA]?))"
    r"(?P<bits>8|10|12|14|16)(?P<packing>p|Packed)?"
)


def layout_of(name: str) -> Layout | None:
    """The layout that a PFNC or GigE Vision name means; None for those that Umbra cannot use."""
    found = _NAME.fullmatch(name)
    if found is None:
        return None
    bits, order, suffix = int(found["bits"]), found["order"], found["packing"]
    if order:
        # Here "Packed" only says that colours are not in planes.
        packing = Packing.STREAM if suffix == "p" else Packing.PLAIN
        pixel_format = PixelFormat(f"RGB{bits}")
        return Layout(pixel_format, packing, order + ("a" if found["alpha"] else ""))
    packing = Packing(suffix) if suffix else Packing.PLAIN
    if packing is not Packing.PLAIN and bits not in {10, 12, 14}:
        return None
    if packing is Packing.GIGE and bits == 14:
        return None
    return Layout(PixelFormat(found["kind"] + found["bits"]), packing)


def unpack(
    data: NDArray[np.uint8], layout: Layout, out: NDArray[Any], stride: int | None = None
) -> None:
    """Write a buffer's samples to `out`, (H, W) or (H, W, 3) RGB of the format's dtype.

    `data` is flat bytes. `stride` is the number of bytes from row to row; None: rows follow each
    other without a gap, even within a byte. Raises ValueError for a buffer that is too short.
    """
    height, width = out.shape[:2]
    row = width * layout.samples
    if stride is None:
        rows, count, need = 1, height * row, layout.row_bytes(height * row)
    else:
        rows, count, need = height, row, stride * (height - 1) + layout.row_bytes(row)
    if len(data) < need:
        raise ValueError(
            f"a {width} x {height} {layout.pixel_format} takes {need} bytes, not {len(data)}"
        )
    size = layout.row_bytes(count)
    lines = np.lib.stride_tricks.as_strided(
        data, (rows, size), (stride or size, 1), writeable=False
    )
    samples = lines.view(out.dtype) if layout.packing is Packing.PLAIN else None
    if samples is None:
        samples = _samples(lines, layout, count)
    image = samples.reshape((height, width, layout.samples) if layout.order else (height, width))
    if layout.order:
        image = image[:, :, :3] if layout.order.startswith("RGB") else image[:, :, 2::-1]
    np.copyto(out, image)


# ---------------------------------------------------------------- packed samples


@dataclass(frozen=True, slots=True)
class _Term:
    """A part of a sample: `((byte >> right) & mask) << left`."""

    byte: int
    right: int
    mask: int
    left: int


@dataclass(frozen=True, slots=True)
class _Group:
    """The smallest number of samples that begins and ends with whole bytes."""

    bytes: int
    terms: tuple[tuple[_Term, ...], ...]  # of each sample

    @property
    def samples(self) -> int:
        return len(self.terms)


def _stream(start: int, bits: int, left: int = 0) -> tuple[_Term, ...]:
    """The terms of a field of `bits` that begins at bit `start` of a least-significant-first
    stream and goes to bit `left` of the sample."""
    terms = []
    while bits:
        byte, right = divmod(start, 8)
        taken = min(8 - right, bits)
        terms.append(_Term(byte, right, (1 << taken) - 1, left))
        start, bits, left = start + taken, bits - taken, left + taken
    return tuple(terms)


@functools.cache
def _group(packing: Packing, bits: int) -> _Group:
    samples = 2 if bits == 12 else 4
    low = bits - 8
    if packing is Packing.GIGE:
        return _Group(
            3, tuple((_Term(2 * k, 0, 255, low), *_stream(8 + 4 * k, low)) for k in (0, 1))
        )
    if packing is Packing.CSI2:
        terms = tuple(
            (_Term(k, 0, 255, low), *_stream(8 * samples + k * low, low)) for k in range(samples)
        )
    else:
        terms = tuple(_stream(k * bits, bits) for k in range(samples))
    return _Group(samples * bits // 8, terms)


def _samples(lines: NDArray[np.uint8], layout: Layout, count: int) -> NDArray[np.uint16]:
    """(rows, bytes) -> (rows, count)."""
    group = _group(layout.packing, layout.pixel_format.bits)
    groups = -(-count // group.samples)
    missing = groups * group.bytes - lines.shape[1]
    if missing:
        lines = np.pad(lines, ((0, 0), (0, missing)))
    packed = lines.reshape(len(lines), groups, group.bytes)
    out = np.zeros((len(lines), groups, group.samples), np.uint16)
    for k, terms in enumerate(group.terms):
        for term in terms:
            part = packed[:, :, term.byte].astype(np.uint16)
            part >>= term.right
            part &= term.mask
            part <<= term.left
            out[:, :, k] |= part
    return out.reshape(len(lines), -1)[:, :count]
