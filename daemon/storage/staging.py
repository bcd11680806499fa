"""Products on their way into a run's folder: all of them whole, or none."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.storage.durable import fsync_file, fsync_folder, storage
from protocol.messages.runs import Product

_STAGING = ".products-"


class Staging:
    """Files that are written into a folder of their own first and then moved to the run's."""

    def __init__(self, folder: Path) -> None:
        """Raises StorageError."""
        self.products: list[Product] = []
        self._folder = folder
        with storage("writing products"):
            for left in folder.glob(f"{_STAGING}*"):
                shutil.rmtree(left)
            self._staging = Path(tempfile.mkdtemp(prefix=_STAGING, dir=folder))

    def add(self, name: str, kind: str, file: str, data: bytes, unit: str = "") -> None:
        """Write a product's file. Raises StorageError."""
        with storage(f"writing {file}"):
            (self._staging / file).write_bytes(data)
            fsync_file(self._staging / file)
        product = Product(name=name, kind=kind, file=file, unit=unit, bytes=len(data))
        self.products.append(product)

    def publish(self) -> None:
        """Move all files to the run's folder. Raises StorageError."""
        with storage("writing products"):
            for product in self.products:
                (self._staging / product.file).replace(self._folder / product.file)
            fsync_folder(self._folder)

    def clear(self) -> None:
        """Remove what was not published."""
        shutil.rmtree(self._staging, ignore_errors=True)


def tiff(plane: NDArray[Any]) -> bytes:
    """A plane (H, W) or (H, W, 3) RGB, float32 or uint16, as an uncompressed TIFF."""
    # Uncompressed: noise hardly shrinks, and every reader maps it. OpenCV wants BGR, writes RGB.
    ordered = plane[..., ::-1] if plane.ndim == 3 else plane
    return encoded(".tiff", ordered, [cv2.IMWRITE_TIFF_COMPRESSION, 1])


def encoded(kind: str, plane: NDArray[Any], options: list[int] | None = None) -> bytes:
    """A picture file's bytes. Raises ValueError."""
    done, data = cv2.imencode(kind, np.ascontiguousarray(plane), options or [])
    if not done:
        raise ValueError(f"{plane.shape} {plane.dtype} cannot be written as {kind}")
    return data.tobytes()


def as_json(facts: Mapping[str, Any]) -> bytes:
    """Figures as JSON for people, NumPy's among them."""
    return msgspec.json.format(msgspec.json.encode(facts, enc_hook=_plain)) + b"\n"


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} in facts")
