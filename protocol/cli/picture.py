"""Pictures without OpenCV: as PNG files, and in the terminal."""

from __future__ import annotations

import os
import struct
import zlib

import numpy as np
from numpy.typing import NDArray


def png(pixels: NDArray[np.uint8]) -> bytes:
    """A PNG file's bytes of (H, W) or (H, W, 3) RGB uint8. Raises ValueError for another shape."""
    height, width, *rest = pixels.shape
    if pixels.dtype.name != "uint8" or rest not in ([], [3]):
        raise ValueError(f"not a picture: {pixels.dtype} {pixels.shape}")

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    rows = b"".join(b"\0" + row.tobytes() for row in pixels)  # \0: filter "none"
    header = struct.pack(">IIBBBBB", width, height, 8, 2 if rest else 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows, 6))
        + chunk(b"IEND", b"")
    )


def in_terminal(pixels: NDArray[np.uint8], columns: int, lines: int) -> str:
    """The picture as half blocks: each character cell is two pixels, one above the other.

    `pixels`: (H, W) or (H, W, 3) RGB uint8. It fits into `columns` x `lines` cells. Needs a
    terminal with 24-bit colour; with NO_COLOR, or 256 colours, it comes as grey levels.
    """
    image = np.atleast_3d(pixels).astype(np.float32)
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    height, width = image.shape[:2]
    scale = min(1.0, columns / width, 2 * lines / height)
    small = _shrunk(image, max(1, round(height * scale)), max(1, round(width * scale)))
    if small.shape[0] % 2:
        small = np.concatenate([small, np.zeros_like(small[:1])])
    return "\n".join(_line(small[y], small[y + 1]) for y in range(0, small.shape[0], 2))


def _shrunk(image: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Area average (the mean of the source pixels under each target pixel)."""

    def edges(have: int, want: int) -> NDArray[np.intp]:
        return (np.arange(want) * have // want).astype(np.intp)

    tall = np.add.reduceat(image, edges(image.shape[0], height), axis=0)
    both = np.add.reduceat(tall, edges(image.shape[1], width), axis=1)
    counts = np.add.reduceat(
        np.add.reduceat(
            np.ones(image.shape[:2], np.float32), edges(image.shape[0], height), axis=0
        ),
        edges(image.shape[1], width),
        axis=1,
    )
    return np.asarray(both / counts[..., None], dtype=np.float32)


def _line(upper: NDArray[np.float32], lower: NDArray[np.float32]) -> str:
    cells = []
    last = ("", "")
    for above, below in zip(upper, lower, strict=True):
        colours = (_colour(38, above), _colour(48, below))
        cells.append(("" if colours == last else "".join(colours)) + "▀")
        last = colours
    return "".join(cells) + "\x1b[0m"


def _colour(ground: int, rgb: NDArray[np.float32]) -> str:
    red, green, blue = (int(v + 0.5) for v in rgb)
    if "NO_COLOR" not in os.environ and os.environ.get("COLORTERM") in ("truecolor", "24bit"):
        return f"\x1b[{ground};2;{red};{green};{blue}m"
    if "NO_COLOR" not in os.environ:
        cube = 16 + 36 * _sixth(red) + 6 * _sixth(green) + _sixth(blue)
        return f"\x1b[{ground};5;{cube}m"
    grey = 232 + min(23, (red * 3 + green * 6 + blue) * 24 // 2560)
    return f"\x1b[{ground};5;{grey}m"


def _sixth(value: int) -> int:
    """The nearest step of the 256-colour palette's cube: 0, 95, 135, 175, 215, 255."""
    return 0 if value < 48 else 1 if value < 115 else (value - 35) // 40
