"""V4L2's pixel formats by their four letters, and how their samples lie."""

from __future__ import annotations

from drivers.base.pixelformat import PixelFormat
from drivers.unpack import Layout, Packing


def _bayer(codes: str, bits: int, packing: Packing = Packing.PLAIN) -> dict[str, Layout]:
    """Four codes, of BG, GB, GR and RG mosaics."""
    orders = ("BG", "GB", "GR", "RG")
    return {
        code: Layout(PixelFormat(f"Bayer{order}{bits}"), packing)
        for code, order in zip(codes.split(), orders, strict=True)
    }


LAYOUTS: dict[str, Layout] = {
    "GREY": Layout(PixelFormat.MONO8),
    "Y10 ": Layout(PixelFormat.MONO10),
    "Y12 ": Layout(PixelFormat.MONO12),
    "Y14 ": Layout(PixelFormat.MONO14),
    "Y16 ": Layout(PixelFormat.MONO16),
    "Y10P": Layout(PixelFormat.MONO10, Packing.CSI2),
    "Y12P": Layout(PixelFormat.MONO12, Packing.CSI2),
    "Y14P": Layout(PixelFormat.MONO14, Packing.CSI2),
    "RGB3": Layout(PixelFormat.RGB8, order="RGB"),
    "BGR3": Layout(PixelFormat.RGB8, order="BGR"),
    **_bayer("BA81 GBRG GRBG RGGB", 8),
    **_bayer("BG10 GB10 BA10 RG10", 10),
    **_bayer("BG12 GB12 BA12 RG12", 12),
    **_bayer("BG14 GB14 GR14 RG14", 14),
    **_bayer("BYR2 GB16 GR16 RG16", 16),
    **_bayer("pBAA pGAA pgAA pRAA", 10, Packing.CSI2),
    **_bayer("pBCC pGCC pgCC pRCC", 12, Packing.CSI2),
    **_bayer("pBEE pGEE pgEE pREE", 14, Packing.CSI2),
    # Not samples of a sensor any more: what most webcams have. Decoded to RGB.
    "YUYV": Layout(PixelFormat.RGB8, order="RGB"),
    "MJPG": Layout(PixelFormat.RGB8, order="RGB"),
}


def reordered(code: str) -> list[str]:
    """The formats that differ from this one by the order of the mosaic's colours alone."""
    like = LAYOUTS.get(code)
    return [
        other
        for other, layout in LAYOUTS.items()
        if like is not None
        and like.pixel_format.bayer
        and layout.pixel_format.bayer
        and (layout.pixel_format.bits, layout.packing) == (like.pixel_format.bits, like.packing)
    ]
