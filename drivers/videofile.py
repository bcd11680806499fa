"""Video files through OpenCV's FFmpeg: frames in order, and what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import imagefile
from drivers.imagefile import BadImage, ImageHeader

DEFAULT_RATE_HZ = 30.0


class VideoFile:
    """A video file, read from its beginning; frames (H, W, 3) uint8 RGB as stored, unrotated.

    Raises BadImage for what is no video that can be read, and `read` for a frame that cannot.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.next = 0
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        if not self._capture.isOpened():
            raise BadImage("is not a video that can be read", "convert it, or name its folder")

    @property
    def rate_hz(self) -> float:
        """Frames a second, as the file says; 30 where it says nothing sensible."""
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate if 0 < rate < 1e6 else DEFAULT_RATE_HZ

    def count(self) -> int:
        """Frames that really decode: as the header says if its last one does, else counted."""
        said = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if said > 0 and self._capture.set(cv2.CAP_PROP_POS_FRAMES, said - 1):
            there = self._capture.grab()
            if there and self._capture.get(cv2.CAP_PROP_POS_FRAMES) == said:
                return said
        self._rewind()
        while self._capture.grab():
            self.next += 1
        return self.next

    def skip(self, frames: int) -> None:
        """Decode so many frames and drop them, or all that are left."""
        for _ in range(frames):
            if not self._capture.grab():
                return
            self.next += 1

    def read(self) -> NDArray[np.uint8] | None:
        """The next frame; None at the end."""
        there, image = self._capture.read()
        if not there:
            return None
        try:
            colour = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        except cv2.error as error:
            raise BadImage(
                f"has a frame {self.next} that is no colour picture: {image.shape} {image.dtype}",
                "convert it to 8-bit colour",
            ) from error
        self.next += 1
        return cast(NDArray[np.uint8], colour)

    def close(self) -> None:
        """Let go of the file."""
        self._capture.release()

    def _rewind(self) -> None:
        self._capture.release()
        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self.next = 0


def inspect(path: Path, *, grey: bool) -> tuple[ImageHeader, int, float]:
    """What a video holds: its frames' layout, how many, and how many a second.

    `grey`: its colours are alike, and one of them is meant. Raises BadImage.
    """
    head = imagefile.head(path, 4096)
    if imagefile.is_image(head):
        raise BadImage("is one image, not a video", "give its folder")
    if b"\0" not in head and not head.startswith(b"YUV4MPEG2"):
        # FFmpeg plays text files as terminal art.
        raise BadImage("is neither a folder nor a video", "give a folder or a video file")
    video = VideoFile(path)
    try:
        image = video.read()
        frames = video.count()
        rate = video.rate_hz
    finally:
        video.close()
    if image is None or not frames:
        raise BadImage("has no frames", "copy or convert it again")
    return ImageHeader(image.shape[1], image.shape[0], 1 if grey else 3, 8), frames, rate
