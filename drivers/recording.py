"""What a folder of images or a video file holds, found and checked before anything is read from it.

Frames come in the natural order of their names (frame2 before frame10), after those that are named
first, and must all be alike.
"""

from __future__ import annotations

import fnmatch
import os
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from drivers import imagefile, videofile
from drivers.imagefile import BadImage, ImageHeader

T = TypeVar("T")

DROPPINGS = frozenset({"thumbs.db", "ehthumbs.db", "desktop.ini"})  # and all that begins with "."


class BadRecording(BadImage):
    """Files that cannot be used as a recording; `problem` names them."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Images given first, then the folder's images or the video's frames."""

    images: tuple[Path, ...]
    video: Path | None
    video_frames: int
    layout: ImageHeader
    rate_hz: float

    @property
    def frames(self) -> int:
        """How many there are."""
        return len(self.images) + self.video_frames


def find(
    path: Path, *, first: tuple[str, ...], match: str, grey: bool, rate_hz: float | None
) -> Recording:
    """The recording in a folder of images, or in a video file.

    `first` are files given before all others, relative ones within the folder; `match` tells which
    of the folder's names are frames; `grey`: a video is to be read as grey; `rate_hz` None: as the
    video says. Raises BadRecording naming the first file that will not do.
    """
    if not path.exists():
        raise BadRecording(f"{path} is not there", "check `path`")
    folder = path if path.is_dir() else path.parent
    given = tuple(folder / Path(name).expanduser() for name in first)
    video = None if path.is_dir() else path
    images = given if video else given + _listing(path, given, match)
    headers = {image: _checked(image, imagefile.inspect) for image in images}
    frames, rate = 0, videofile.DEFAULT_RATE_HZ
    if video:
        headers[video], frames, rate = _checked(
            video, lambda path: videofile.inspect(path, grey=grey)
        )
    return Recording(images, video, frames, _same_layout(headers), rate_hz or rate)


def natural_key(name: str) -> tuple[tuple[str | int, ...], str]:
    """Sorts names as people number them: numbers by value, the rest without regard to case."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), name


def _listing(folder: Path, apart: tuple[Path, ...], match: str) -> tuple[Path, ...]:
    """The folder's images, without those that are given `apart`."""
    known = {os.path.realpath(path) for path in apart}
    try:
        entries = sorted(folder.iterdir(), key=lambda path: natural_key(path.name))
    except OSError as error:
        raise BadRecording(
            f"{folder} cannot be listed ({error.strerror})", "check its permissions"
        ) from error
    seen = [path for path in entries if not _is_dropping(path.name)]
    files = tuple(
        path
        for path in seen
        if not path.is_dir()
        and fnmatch.fnmatchcase(path.name, match)
        and os.path.realpath(path) not in known  # not resolve(): it fails for a loop of links
    )
    if not files:
        folders = ", ".join(path.name for path in seen if path.is_dir())
        matching = "" if match == "*" else f" that match {match!r}"
        raise BadRecording(
            f"{folder} has no images{matching}",
            f"give one of its folders ({folders})" if folders else "check `path` and `match`",
        )
    return files


def _same_layout(headers: dict[Path, ImageHeader]) -> ImageHeader:
    usual, _ = Counter(header.layout for header in headers.values()).most_common(1)[0]
    like, right = next((p.name, h) for p, h in headers.items() if h.layout == usual)
    for path, header in headers.items():
        if header.layout != usual:
            raise BadRecording(
                f"{path.name} is {header}, {like} is {right}",
                "all frames must be alike: take it out, or choose the others with `match`",
            )
    return right


def _checked(path: Path, inspect: Callable[[Path], T]) -> T:
    try:
        return inspect(path)
    except BadImage as error:
        raise BadRecording(f"{path.name} {error.problem}", error.remedy) from error


def _is_dropping(name: str) -> bool:
    return name.startswith(".") or name.casefold() in DROPPINGS
