"""What the mathematics says of a frame that it can make nothing of, with the frame's name to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import structlog

from protocol.errors import Code, UmbraError

UNFORESEEN = (cv2.error, ArithmeticError, LookupError, ValueError)
"""What NumPy and OpenCV raise for pixels that nobody thought of; a singular matrix is among it."""

log = structlog.get_logger(__name__)


@contextmanager
def named(index: int, source: str) -> Iterator[None]:
    """Within it a frame is taken in: the `index`-th of the run, from the file `source` ("": from a
    camera). Raises UmbraError(bad_input, device_garbled) for what it can do nothing with."""
    try:
        yield
    except UNFORESEEN as error:
        log.exception("a frame could not be taken in", frame=index, source=source)
        problem = f"cannot be separated ({type(error).__name__}: {str(error).strip()})"
        if source:
            raise UmbraError(
                Code.BAD_INPUT, f"{source} {problem}: look at it, and take it out if it is damaged"
            ) from error
        raise UmbraError(
            Code.DEVICE_GARBLED,
            f"camera: frame {index} {problem}: look at what the camera gives (`umbra snap`); "
            "umbrad's log has the details",
        ) from error
