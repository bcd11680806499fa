"""A digital camera's picture as samples: RAW through LibRaw as the sensor's mosaic, or JPEG."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import rawpy
from numpy.typing import NDArray

from drivers import imagefile
from drivers.base.pixelformat import PixelFormat
from drivers.imagefile import BadImage


def develop(data: bytes) -> tuple[NDArray[Any], PixelFormat, float]:
    """A picture's samples as stored, their format, the black level in counts. Raises BadImage."""
    if data.startswith(b"\xff\xd8"):
        pixels = imagefile.decode(data)
        return pixels, PixelFormat.RGB8 if pixels.ndim == 3 else PixelFormat.MONO8, 0.0
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern.shape != (2, 2):
                raise BadImage("is no Bayer mosaic", "set the camera to JPEG")
            names = raw.color_desc.decode()
            first = "".join(names[i] for i in raw.raw_colors_visible[0, :2])
            bits = next(b for b in (8, 10, 12, 14, 16) if raw.white_level < 1 << b)
            pixel_format = PixelFormat(f"Bayer{first}{bits}")
            black = float(np.mean(raw.black_level_per_channel))
            return raw.raw_image_visible.astype(pixel_format.dtype), pixel_format, black
    except rawpy.LibRawError as error:
        raise BadImage(f"is neither JPEG nor RAW ({error})", "set its image format") from error
