"""Image files as measurements: what a file holds, whether it is whole, its samples in RGB order.

OpenCV decodes a truncated file without a word, so a file's structure is checked here first:

- PNG: every chunk to IEND with its CRC. JPEG: every segment to the EOI marker.
- TIFF: every strip or tile lies within the file. BMP, PNM: as many bytes as the header says.

Samples are given as they are stored: 8 or 16 bit, never scaled, never rotated by EXIF. An opaque
alpha channel is dropped; any other is refused, because its pixels were mixed with nothing known.
A camera's raw file is refused by its name or its tags: most are TIFF, and what a reader of images
finds in them is a small developed picture for viewing.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

SAVE_AS = "save it as 8- or 16-bit grey or RGB PNG or TIFF"
COPY_AGAIN = "copy or export it again, or take it out of the folder"
CONVERT = (
    "convert it to a 16-bit TIFF of the sensor's own counts (dcraw -D -4 -T -t 0) and name the "
    "mosaic with `bayer`; docs/cameras.md says how"
)

_RAW_NAME = re.compile(
    r"\.(3fr|arw|cr[23w]|dcr|dng|erf|fff|iiq|kdc|mef|mos|mrw|nef|nrw|orf|pef|raf|rw[2l]|sr[2fw]|x3f)",
    re.IGNORECASE,
)
"""Suffixes of cameras' raw files."""


class BadImage(Exception):
    """A file that cannot be used as a frame: what is wrong with it and what to do."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)
        self.problem = problem
        self.remedy = remedy


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What a file holds: `channels` 1 or 3, `bits` 8 or 16 a sample; `alpha` beside these."""

    width: int
    height: int
    channels: int
    bits: int
    alpha: bool = False

    def __str__(self) -> str:
        colour = "colour" if self.channels == 3 else "grey"
        return f"{self.width} x {self.height} {self.bits}-bit {colour}"

    @property
    def layout(self) -> tuple[int, int, int, int]:
        """What must be the same in every frame of a recording: width, height, channels, bits."""
        return self.width, self.height, self.channels, self.bits


def inspect(path: Path) -> ImageHeader:
    """A file's header, its structure checked to the end. Raises BadImage."""
    if _RAW_NAME.fullmatch(path.suffix):
        raise _raw()
    data = _bytes(path)
    header = _parser(data)(data)
    if header.alpha:
        _decode(data, header)  # the only way to know that it is opaque
    return header


def read(path: Path) -> NDArray[Any]:
    """Samples (H, W) or (H, W, 3) RGB, uint8 or uint16; checked again. Raises BadImage."""
    return decode(_bytes(path))


def decode(data: bytes) -> NDArray[Any]:
    """As `read`, of a file's bytes. Raises BadImage."""
    return _decode(data, _parser(data)(data))


def head(path: Path, size: int) -> bytes:
    """The first bytes of a file. Raises BadImage for what cannot be read, or is no file."""
    return _bytes(path, size)


def is_image(data: bytes) -> bool:
    """Whether a file that begins so is in an image format of this module."""
    return _known(data) is not None


# ---------------------------------------------------------------- reading


def _bytes(path: Path, size: int = -1) -> bytes:
    try:
        if not path.is_file() and path.exists():  # a pipe would be waited for, a device has no end
            raise BadImage("is no file", "take it out, or give a folder of files or a video")
        with path.open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise BadImage(
            f"cannot be read ({error.strerror})", "check that it is there and its permissions"
        ) from error


def _known(data: bytes) -> Callable[[bytes], ImageHeader] | None:
    for magic, parser in _PARSERS.items():
        if data.startswith(magic):
            return parser
    return None


def _parser(data: bytes) -> Callable[[bytes], ImageHeader]:
    if not data:
        raise BadImage("is empty", COPY_AGAIN)
    parser = _known(data)
    if parser is None:
        raise BadImage(
            "is not an image (PNG, TIFF, JPEG, BMP, binary PNM)",
            "take it out of the folder, or choose the images with `match`",
        )

    def checked(data: bytes) -> ImageHeader:
        try:
            header = parser(data)
        except (struct.error, IndexError) as error:
            raise _truncated() from error
        if not (header.width and header.height):
            raise BadImage("has no pixels", COPY_AGAIN)
        return header

    return checked


def _decode(data: bytes, header: ImageHeader) -> NDArray[Any]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise BadImage(f"cannot be decoded ({error.err})", COPY_AGAIN) from error
    # OpenCV gives None, not an exception, for most of what it cannot decode; its stubs disagree.
    if image is None or image.size == 0:
        raise BadImage("cannot be decoded", COPY_AGAIN)
    samples: NDArray[Any] = image
    if header.alpha:
        if samples.ndim != 3 or samples.shape[2] not in {2, 4}:
            raise BadImage("has an alpha channel that OpenCV does not give", SAVE_AS)
        if samples[:, :, -1].min() != (1 << header.bits) - 1:
            raise BadImage("is partly transparent", "save it without an alpha channel")
        samples = samples[:, :, :-1]
    if header.channels == 1 and samples.ndim == 3:
        samples = samples[:, :, 0]
    elif header.channels == 3 and samples.ndim == 3:
        samples = samples[:, :, ::-1]
    plane = (header.height, header.width)
    shape = plane if header.channels == 1 else (*plane, 3)
    if samples.shape != shape or samples.dtype.itemsize * 8 != header.bits:
        raise BadImage(f"decodes to {samples.shape} {samples.dtype}, not to {header}", SAVE_AS)
    return np.ascontiguousarray(samples)


def _truncated() -> BadImage:
    return BadImage("is truncated", COPY_AGAIN)


def _raw() -> BadImage:
    return BadImage("is a camera's raw file", CONVERT)


# ---------------------------------------------------------------- formats


def _png(data: bytes) -> ImageHeader:
    header: ImageHeader | None = None
    alpha = False
    at = 8
    while True:
        length, kind = struct.unpack_from(">I4s", data, at)
        (crc,) = struct.unpack_from(">I", data, at + 8 + length)
        if zlib.crc32(memoryview(data)[at + 4 : at + 8 + length]) != crc:
            raise BadImage(f"is corrupt: wrong checksum at byte {at}", COPY_AGAIN)
        if kind == b"IHDR":
            width, height, bits, colour = struct.unpack_from(">IIBB", data, at + 8)
            if colour == 3 or bits not in {8, 16}:
                what = "indexed colour" if colour == 3 else f"{bits} bit"
                raise BadImage(f"is {what}", SAVE_AS)
            alpha = colour in {4, 6}
            header = ImageHeader(width, height, 3 if colour in {2, 6} else 1, bits)
        elif kind == b"tRNS":
            alpha = True
        elif kind == b"acTL":
            raise BadImage("is an animation", "save one image a file, or give a video")
        elif kind == b"IEND":
            break
        at += 12 + length
    if header is None:
        raise BadImage("has no header", COPY_AGAIN)
    return ImageHeader(*header.layout, alpha=alpha)


_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # not stuffing, fill, nor restart
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def _jpeg(data: bytes) -> ImageHeader:
    header: ImageHeader | None = None
    at = 2
    while True:
        # Within entropy-coded data this skips to the next marker, elsewhere it matches at once.
        found = _MARKER.search(data, at)
        if found is None:
            raise _truncated()
        code = data[found.start() + 1]
        if code == 0xD9:
            break
        at = found.end()
        (length,) = struct.unpack_from(">H", data, at)
        if code in _FRAME_HEADERS:
            bits, height, width, components = struct.unpack_from(">BHHB", data, at + 2)
            if bits != 8 or components not in {1, 3}:
                raise BadImage(f"is a JPEG of {components} components, {bits} bit", SAVE_AS)
            header = ImageHeader(width, height, components, 8)
        at += length
    if header is None:
        raise BadImage("has no image header", COPY_AGAIN)
    return header


_Tags = dict[int, tuple[int, ...]]


def _tiff(data: bytes) -> ImageHeader:
    every = list(_tiff_pages(data))
    if data[8:10] == b"CR" or any(map(_is_raw, every)):  # CR2's mark; its mosaic has no tags
        raise _raw()
    pages = [tags for tags in every if not tags.get(254, (0,))[0] & 1]  # no thumbnails
    if len(pages) != 1:
        raise BadImage(f"holds {len(pages)} pages", "save one image a file")
    tags = pages[0]

    def tag(number: int, default: int = 0) -> int:
        return tags.get(number, (default,))[0]

    samples, photometric = tag(277, 1), tag(262, 1)
    kinds = set(tags.get(339, (1,)))
    if kinds == {3}:
        raise BadImage(
            "holds floating-point samples", "scale to the camera's counts and save as 16-bit"
        )
    depths = set(tags.get(258, (1,)))
    if len(depths) != 1 or not depths <= {8, 16} or kinds != {1}:
        depth = "/".join(map(str, sorted(depths)))
        raise BadImage(f"holds {'signed ' if 2 in kinds else ''}{depth}-bit samples", SAVE_AS)
    if photometric not in {1, 2, 6}:  # grey with black as zero, RGB, YCbCr
        what = {0: "inverted grey", 3: "indexed colour"}.get(photometric, "an unusual colour space")
        raise BadImage(f"is in {what}", SAVE_AS)
    channels = 1 if photometric == 1 else 3
    if samples - channels not in {0, 1}:
        raise BadImage(f"has {samples} samples a pixel", SAVE_AS)
    (bits,) = depths
    header = ImageHeader(tag(256), tag(257), channels, bits, alpha=samples > channels)
    offsets = tags.get(273) or tags.get(324) or ()
    counts = tags.get(279) or tags.get(325) or ()
    if not offsets or len(offsets) != len(counts):
        raise BadImage("has no image data", COPY_AGAIN)
    if any(offset + count > len(data) for offset, count in zip(offsets, counts, strict=True)):
        raise _truncated()
    size = header.width * header.height * samples * bits // 8
    if tag(259, 1) == 1 and sum(counts) < size:
        raise _truncated()
    return header


def _is_raw(tags: _Tags) -> bool:
    """Whether a page is of a camera's raw file: DNGVersion, a mosaic, or DNG's linear raw."""
    return 50706 in tags or tags.get(262, (0,))[0] in {32803, 34892}


_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}  # the unsigned ones


def _tiff_pages(data: bytes) -> Iterator[_Tags]:
    """The integer tags of each page (image file directory), classic TIFF and BigTIFF. A page's
    further pages (SubIFDs), in which most raw files have the mosaic, are asked for that only."""
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    (at,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    seen: set[int] = set()
    while at:
        if at in seen:
            raise BadImage("is corrupt: its pages form a loop", COPY_AGAIN)
        seen.add(at)
        tags, at = _tiff_directory(data, at, order, big)
        for below in tags.get(330, ()):
            if _is_raw(_tiff_directory(data, below, order, big)[0]):
                raise _raw()
        yield tags


def _tiff_directory(data: bytes, at: int, order: str, big: bool) -> tuple[_Tags, int]:
    """The integer tags of the directory at an offset, and the next one's offset, 0 after the
    last."""
    word, count_code, entry_size = ("Q", "Q", 20) if big else ("I", "H", 12)
    inline, value_at = (8, 12) if big else (4, 8)
    (entries,) = struct.unpack_from(order + count_code, data, at)
    at += struct.calcsize(order + count_code)
    tags: _Tags = {}
    for entry in range(at, at + entries * entry_size, entry_size):
        number, kind, count = struct.unpack_from(f"{order}HH{word}", data, entry)
        if kind not in _TIFF_TYPES or not count:
            continue
        code = _TIFF_TYPES[kind]
        value = entry + value_at
        if count * struct.calcsize(code) > inline:
            (value,) = struct.unpack_from(order + word, data, value)
        if count * struct.calcsize(code) > len(data) - value:
            raise _truncated()
        tags[number] = struct.unpack_from(f"{order}{count}{code}", data, value)
    (after,) = struct.unpack_from(order + word, data, at + entries * entry_size)
    return tags, after


def _bmp(data: bytes) -> ImageHeader:
    start, size, width, height, _, depth, compression = struct.unpack_from("<IIiiHHI", data, 10)
    height = abs(height)  # negative: stored top down
    if size < 40 or compression or depth not in {8, 24}:
        raise BadImage("is an unusual BMP", SAVE_AS)
    if len(data) < start + (width * depth + 31) // 32 * 4 * height:
        raise _truncated()
    palette = np.frombuffer(data[14 + size : start], np.uint8)
    if depth == 8:
        entries = palette[: len(palette) // 4 * 4].reshape(-1, 4)
        ramp = np.arange(len(entries), dtype=np.uint8)[:, None]
        if not len(entries) or (entries[:, :3] != ramp).any():
            raise BadImage("is indexed colour", SAVE_AS)
    return ImageHeader(width, height, 3 if depth == 24 else 1, 8)


_GAP = rb"(?:\s|#[^\n]*\n)+"
_PNM = re.compile(rb"P([56])" + _GAP + rb"(\d+)" + _GAP + rb"(\d+)" + _GAP + rb"(\d+)\s")


def _pnm(data: bytes) -> ImageHeader:
    found = _PNM.match(data[:4096])
    if found is None:
        raise BadImage("has a header that makes no sense", COPY_AGAIN)
    width, height, largest = (int(found[i]) for i in (2, 3, 4))
    if largest < 255:
        raise BadImage(f"has a full scale of {largest}", SAVE_AS)
    header = ImageHeader(width, height, 3 if found[1] == b"6" else 1, 8 if largest == 255 else 16)
    if len(data) - found.end() < width * height * header.channels * header.bits // 8:
        raise _truncated()
    return header


_PARSERS: dict[bytes, Callable[[bytes], ImageHeader]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8\xff": _jpeg,
    b"II*\x00": _tiff,
    b"MM\x00*": _tiff,
    b"II+\x00": _tiff,
    b"MM\x00+": _tiff,
    b"BM": _bmp,
    b"P5": _pnm,
    b"P6": _pnm,
}
