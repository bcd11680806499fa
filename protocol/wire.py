"""Multipart framing: a JSON header, then one raw buffer an array. Nothing is copied through text.

client -> daemon   [header, buffer...]            (DEALER; ROUTER sees the identity before it)
daemon -> client   [header, buffer...]
events             [topic, header, buffer...]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import msgspec

from protocol.errors import Code, UmbraError
from protocol.messages.envelopes import ArrayHeader

if TYPE_CHECKING:  # NumPy is loaded with the first array: most commands carry none
    from numpy.typing import NDArray

Arrays: TypeAlias = "Mapping[str, NDArray[Any]]"
T = TypeVar("T")

MOST_BYTES = 4 << 20
"""Of a request's frame; a daemon closes the connection on more."""

_ALLOWED = {"uint8", "uint16", "float32", "bool"}
_encoder = msgspec.json.Encoder()


def headers(arrays: Arrays) -> tuple[ArrayHeader, ...]:
    """The `arrays` field that announces these arrays, in order."""
    return tuple(
        ArrayHeader(name=name, dtype=a.dtype.name, shape=a.shape) for name, a in arrays.items()
    )


def encode(header: msgspec.Struct, arrays: Arrays | None = None) -> list[bytes | memoryview]:
    """The frames of one message; the arrays' own memory is sent where it is contiguous.

    Raises ValueError for a dtype that the protocol doesn't carry.
    """
    parts: list[bytes | memoryview] = [_encoder.encode(header)]
    for name, a in (arrays or {}).items():
        if a.dtype.name not in _ALLOWED:
            raise ValueError(f"array {name}: the protocol does not carry {a.dtype}")
        parts.append(a.reshape(-1).view("uint8").data)  # reshape copies what is not contiguous
    return parts


def decode(decoder: msgspec.json.Decoder[T], header: bytes | memoryview) -> T:
    """A header as its struct. Raises UmbraError(bad_request) with the field's path."""
    try:
        return decoder.decode(header)
    except msgspec.DecodeError as error:
        message, _, where = str(error).partition(" - at `")
        raise UmbraError(Code.BAD_REQUEST, message, where.rstrip("`")) from error
    except RecursionError as error:
        raise UmbraError(Code.BAD_REQUEST, "it is nested without end") from error


def arrays_of(
    announced: Sequence[ArrayHeader], buffers: Sequence[bytes | memoryview]
) -> dict[str, NDArray[Any]]:
    """The arrays of a message as views of its buffers. Raises UmbraError(bad_request)."""
    if len(announced) != len(buffers):
        raise UmbraError(
            Code.BAD_REQUEST, f"{len(announced)} arrays announced, {len(buffers)} sent", "$.arrays"
        )
    if not announced:
        return {}
    import numpy as np  # noqa: PLC0415  (see above)

    found: dict[str, NDArray[Any]] = {}
    for i, (head, buffer) in enumerate(zip(announced, buffers, strict=True)):
        if head.dtype not in _ALLOWED or any(n < 0 for n in head.shape):
            raise UmbraError(
                Code.BAD_REQUEST, f"array {head.name!r}: not an array", f"$.arrays[{i}]"
            )
        flat = np.frombuffer(buffer, dtype=np.uint8)
        dtype = np.dtype(head.dtype)
        if flat.nbytes != int(np.prod(head.shape, dtype=np.int64)) * dtype.itemsize:
            raise UmbraError(
                Code.BAD_REQUEST,
                f"array {head.name!r}: {flat.nbytes} bytes do not fill {head.shape} of {dtype}",
                f"$.arrays[{i}]",
            )
        found[head.name] = flat.view(dtype).reshape(head.shape)
    return found
