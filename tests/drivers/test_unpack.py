from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.pixelformat import PixelFormat
from drivers.unpack import Layout, Packing, layout_of, unpack

Pack = Callable[[list[int], int], bytes]


def bits_lsb_first(values: list[int], width: int) -> bytes:
    stream = "".join(format(value, f"0{width}b")[::-1] for value in values)
    stream += "0" * (-len(stream) % 8)
    return bytes(int(stream[i : i + 8][::-1], 2) for i in range(0, len(stream), 8))


def stream(values: list[int], bits: int) -> bytes:
    return bits_lsb_first(values, bits)


def gige(values: list[int], bits: int) -> bytes:
    out = bytearray()
    low = bits - 8
    for i in range(0, len(values), 2):
        first = values[i]
        if i + 1 == len(values):
            out += bytes([first >> low, first & ((1 << low) - 1)])
            break
        second = values[i + 1]
        middle = first & ((1 << low) - 1) | (second & ((1 << low) - 1)) << 4
        out += bytes([first >> low, middle, second >> low])
    return bytes(out)


def csi2(values: list[int], bits: int) -> bytes:
    size = 2 if bits == 12 else 4
    out = bytearray()
    for i in range(0, len(values), size):
        group = values[i : i + size] + [0] * (size - len(values[i : i + size]))
        out += bytes(v >> (bits - 8) for v in group)
        out += bits_lsb_first([v & ((1 << (bits - 8)) - 1) for v in group], bits - 8)
    return bytes(out)


PACKERS: list[tuple[Packing, Pack, int]] = [
    (Packing.STREAM, stream, 10),
    (Packing.STREAM, stream, 12),
    (Packing.STREAM, stream, 14),
    (Packing.GIGE, gige, 10),
    (Packing.GIGE, gige, 12),
    (Packing.CSI2, csi2, 10),
    (Packing.CSI2, csi2, 12),
    (Packing.CSI2, csi2, 14),
]


def flat(data: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


@pytest.mark.parametrize(("packing", "pack", "bits"), PACKERS)
def test_every_value_at_every_place_of_a_group(packing: Packing, pack: Pack, bits: int) -> None:
    # 4 samples hold every group; beside each value its neighbours are all zeros, then all ones.
    full = (1 << bits) - 1
    for around in (0, full):
        for place in range(4):
            values = np.full((full + 1, 4), around)
            values[:, place] = np.arange(full + 1)
            out = np.empty((full + 1, 4), np.uint16)
            data = flat(pack(values.ravel().tolist(), bits))
            unpack(data, Layout(PixelFormat(f"Mono{bits}"), packing), out)
            np.testing.assert_array_equal(out, values)


@pytest.mark.parametrize(("packing", "pack", "bits"), PACKERS)
@pytest.mark.parametrize("size", [(1, 1), (3, 3), (3, 5), (2, 7), (5, 6), (1, 1023)])
def test_odd_sizes_contiguous_and_with_padded_rows(
    packing: Packing, pack: Pack, bits: int, size: tuple[int, int]
) -> None:
    layout = Layout(PixelFormat(f"Mono{bits}"), packing)
    values = np.random.default_rng(1).integers(0, 1 << bits, size)
    out = np.empty(size, np.uint16)
    unpack(flat(pack(values.ravel().tolist(), bits)), layout, out)
    np.testing.assert_array_equal(out, values)

    rows = [pack(row.tolist(), bits) for row in values]
    assert {len(row) for row in rows} == {layout.row_bytes(size[1])}
    out[:] = 0
    unpack(flat(b"".join(row + b"\xaa\xbb\xcc" for row in rows)), layout, out, len(rows[0]) + 3)
    np.testing.assert_array_equal(out, values)
    out[:] = 0
    unpack(flat(b"\xaa\xbb\xcc".join(rows)), layout, out, len(rows[0]) + 3)  # last row unpadded
    np.testing.assert_array_equal(out, values)


def test_words_of_the_standards() -> None:
    """Byte by byte, as the format specifications draw them."""
    out = np.empty((1, 2), np.uint16)
    layout = layout_of("Mono12p")
    assert layout is not None
    unpack(flat(bytes([0xBC, 0x3A, 0x12])), layout, out)
    assert out.tolist() == [[0xABC, 0x123]]
    layout = layout_of("Mono12Packed")
    assert layout is not None
    unpack(flat(bytes([0xAB, 0x3C, 0x12])), layout, out)
    assert out.tolist() == [[0xABC, 0x123]]
    layout = layout_of("BayerRG10Packed")
    assert layout is not None
    unpack(flat(bytes([0xFF, 0x12, 0x80])), layout, out)
    assert out.tolist() == [[0x3FE, 0x201]]


@pytest.mark.parametrize(
    ("name", "pixel_format", "packing", "order"),
    [
        ("Mono8", PixelFormat.MONO8, Packing.PLAIN, ""),
        ("Mono12", PixelFormat.MONO12, Packing.PLAIN, ""),
        ("BayerBG10p", PixelFormat.BAYER_BG10, Packing.STREAM, ""),
        ("BayerGR12Packed", PixelFormat.BAYER_GR12, Packing.GIGE, ""),
        ("RGB8Packed", PixelFormat.RGB8, Packing.PLAIN, "RGB"),
        ("BGR12p", PixelFormat.RGB12, Packing.STREAM, "BGR"),
        ("RGBa8", PixelFormat.RGB8, Packing.PLAIN, "RGBa"),
        ("BGRA8Packed", PixelFormat.RGB8, Packing.PLAIN, "BGRa"),
    ],
)
def test_names(name: str, pixel_format: PixelFormat, packing: Packing, order: str) -> None:
    assert layout_of(name) == Layout(pixel_format, packing, order)


@pytest.mark.parametrize(
    "name", ["YUV422_8", "Mono1p", "Mono8Signed", "Mono14Packed", "RGB8_Planar", ""]
)
def test_names_that_cannot_be_used(name: str) -> None:
    assert layout_of(name) is None


@pytest.mark.parametrize("name", ["RGB8", "BGR8", "RGBa8", "BGRa8", "BGR16", "BGR10p"])
@pytest.mark.parametrize("padding", [0, 2])
def test_colours_come_in_rgb_order(name: str, padding: int) -> None:
    layout = layout_of(name)
    assert layout is not None
    bits = layout.pixel_format.bits
    rgb = np.random.default_rng(2).integers(0, 1 << bits, (3, 5, 3), np.uint16)
    stored = rgb[:, :, [layout.order.index(c) for c in "RGB"]]  # BGR is its own inverse
    if "a" in layout.order:
        stored = np.dstack([stored, np.full((3, 5), 7)])
    rows = []
    for row in stored:
        plain = row.astype(np.uint8 if bits == 8 else "<u2").tobytes()
        rows.append(stream(row.ravel().tolist(), bits) if name.endswith("p") else plain)
    out = np.empty(rgb.shape, layout.pixel_format.dtype)
    if padding:
        unpack(
            flat(b"".join(r + bytes(padding) for r in rows)), layout, out, len(rows[0]) + padding
        )
        np.testing.assert_array_equal(out, rgb)
    elif not name.endswith("p"):
        unpack(flat(b"".join(rows)), layout, out)
        np.testing.assert_array_equal(out, rgb)


def test_a_short_buffer_is_told() -> None:
    layout = layout_of("Mono12p")
    assert layout is not None
    with pytest.raises(ValueError, match="4 x 3 Mono12 takes 18 bytes, not 17"):
        unpack(flat(bytes(17)), layout, np.empty((3, 4), np.uint16))
