"""`umbra preview`: look through the camera, once or live."""

from __future__ import annotations

import contextlib
import enum
import itertools
import math
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.cli.delivery import make_folder, write_file
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.output import on_terminal, print_json, say
from protocol.errors import Code, UmbraError
from protocol.messages.events import PreviewTaken
from protocol.messages.replies import Picture
from protocol.messages.rig import RigState

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from protocol.client import Client
    from protocol.results import Picture as Seen

OLD_S = 3.0  # a picture's age that is worth a word
LEASE_S = 10.0
"""A live view that nobody renews ends after this."""
_DRAWING = "\x1b[?1049h\x1b[?25l"  # a screen of its own, without a cursor
_DRAWN = "\x1b[0m\x1b[?25h\x1b[?1049l"


class What(enum.StrEnum):
    """What a preview shows."""

    FRAME = "frame"
    DIRECT = "direct"
    GLOBAL = "global"


class Separate(enum.StrEnum):
    """How a live view may separate each frame."""

    SINGLE_IMAGE = "single-image"


def preview(
    *,
    what: Annotated[
        What | None,
        typer.Argument(help="A frame (default), or the separation so far."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="One picture after the other, until Ctrl-C.")
    ] = False,
    rate_hz: Annotated[
        float, typer.Option("--rate", min=0.1, max=15, help="With --live: pictures a second.")
    ] = 4.0,
    separate: Annotated[
        Separate | None,
        typer.Option(help="With --live: show stripes, and separate each frame."),
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="With --live: so many pictures.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="FILE.png",
            help="Write a PNG file; with --live it is replaced each time, or DIR is filled.",
        ),
    ] = None,
    width: Annotated[int, typer.Option(min=16, max=4096, help="Of the picture, pixels.")] = 640,
    mark: Annotated[
        bool, typer.Option("--mark/--no-mark", help="Over-exposed pixels in magenta.")
    ] = True,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """A frame, small: drawn in the terminal, or written with -o.

    While a run has the camera it is the run's latest; otherwise one is taken.

    --live takes frames by hand, and follows those of a run while one goes on. What saturates is
    magenta; below the picture are exposure, brightness and a histogram.

    --json: a Picture (its facts, no pixels); with --live a PreviewTaken a line.
    """
    if out is None and not as_json and not on_terminal():
        raise UmbraError(
            Code.BAD_REQUEST, "standard output is no terminal to draw in: give -o FILE.png"
        )
    if not live and (separate is not None or count is not None):
        raise UmbraError(Code.BAD_REQUEST, "--separate and --count are of a live view", "--live")
    numbered = live and out is not None and (out.is_dir() or not out.suffix)
    if not numbered:
        png_name(out)
    columns, lines = shutil.get_terminal_size()
    if out is None:
        width = max(16, min(width, columns))  # a character cell shows one pixel of the width
    screen = _Screen(columns, lines) if live and out is None and not as_json else None
    with connect(rig, keys) as client:
        if not live:
            chosen = what or What.FRAME
            if chosen is What.FRAME:
                _take_one(client)
            _one(
                client.preview(width, chosen.value), out, columns, lines, mark=mark, as_json=as_json
            )
            return
        pictures = _Pictures(client, rate_hz, what, separating=separate is not None)
        with contextlib.suppress(KeyboardInterrupt), pictures, screen or contextlib.nullcontext():
            for number, seen in enumerate(itertools.islice(pictures, count), 1):
                pixels = marked(seen.pixels, seen.saturated if mark else None)
                if as_json:
                    body = PreviewTaken(
                        run=str(seen.facts.get("run", "")),
                        what=str(seen.facts.get("what", "frame")),
                        facts=seen.facts,
                    )
                    print_json(body, lines=True)
                if out is not None:
                    _write(out, pixels, number, numbered=numbered)
                elif screen is not None:
                    screen.draw(pixels, seen.facts)


def _take_one(client: Client) -> None:
    """A frame of now, where nobody else has the camera; else the latest, whose age is told."""
    if client.status().state not in {RigState.IDLE, RigState.MANUAL}:
        return
    try:
        client.snap()
    except UmbraError as error:
        say(f"umbra: no new frame: {error}")


def _one(
    seen: Seen, out: Path | None, columns: int, lines: int, *, mark: bool, as_json: bool
) -> None:
    from protocol.cli.picture import in_terminal, png

    pixels = marked(seen.pixels, seen.saturated if mark else None)
    if out is not None:
        write_file(out, png(pixels))
    if as_json:
        print_json(Picture(facts=seen.facts))
    elif out is not None:
        print(out)
    else:
        sys.stdout.write(in_terminal(pixels, columns, lines - 3) + "\n")
    if not as_json:
        say_facts(seen.facts)


def _write(out: Path, pixels: NDArray[np.uint8], number: int, *, numbered: bool) -> None:
    from protocol.cli.picture import png

    path = out
    if numbered:
        make_folder(out)
        path = out / f"{number:06d}.png"
    write_file(path, png(pixels))


def marked(pixels: NDArray[np.uint8], saturated: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """The picture with its over-exposed pixels in magenta."""
    if saturated is None or saturated.shape != pixels.shape[:2] or not saturated.any():
        return pixels
    shown = pixels.copy()
    shown[saturated > 0] = (255, 0, 255)
    return shown


# ---------------------------------------------------------------- one after the other


class _Pictures:
    """The pictures of a live view as they come; a context that keeps the view alive.

    While a run has the camera its own previews come instead, and the live view goes on after it.
    """

    def __init__(
        self, client: Client, rate_hz: float, what: What | None, *, separating: bool
    ) -> None:
        self._client = client
        self._rate_hz = rate_hz
        self._what = what
        self._separating = separating
        self._run = ""  # the one that has the camera
        self._live = False
        self._renew_at = 0.0

    def __enter__(self) -> _Pictures:
        self._events = self._client.subscribe("preview")
        self._renew()
        return self

    def __exit__(self, *error: object) -> None:
        self._events.close()
        if self._live and not self._run:
            self._client.stop_live()
            if self._separating:
                self._client.dark()

    def __iter__(self) -> Iterator[Seen]:
        both: dict[str, Seen] = {}
        while True:
            left = self._renew_at - time.monotonic()
            if left <= 0:
                self._renew()
                continue
            notice = self._events.next(left)
            if notice is None or not isinstance(notice.body, PreviewTaken):
                continue
            body = notice.body
            if self._run and self._what in {What.DIRECT, What.GLOBAL}:
                of_run: What = self._what
                yield self._client.preview(what=of_run.value)  # of a run: it is asked for
            elif self._separating and self._what is None and not self._run:
                both[body.what] = _seen(body, notice.arrays)
                if body.what == What.GLOBAL and What.DIRECT in both:
                    yield _beside(both.pop(What.DIRECT), both.pop(What.GLOBAL))
            elif body.what == (self._what or What.FRAME):
                yield _seen(body, notice.arrays)

    def _renew(self) -> None:
        from protocol.scans.projected import SingleImage

        try:
            self._client.live(self._rate_hz, LEASE_S, SingleImage() if self._separating else None)
        except UmbraError as error:
            if error.code is not Code.BUSY:
                raise
            run = self._client.status().run
            self._run = run.id if run is not None else ""
        else:
            self._run, self._live = "", True
        self._renew_at = time.monotonic() + (LEASE_S / 4 if not self._run else 1.0)


def _seen(body: PreviewTaken, arrays: Any) -> Seen:
    from protocol.results import Picture as Seen

    facts = {**body.facts, "what": body.what, "run": body.run}
    return Seen(arrays["preview"], facts, arrays.get("saturated"))


def _beside(left: Seen, right: Seen) -> Seen:
    """Direct and global as one picture."""
    import numpy as np

    from protocol.results import Picture as Seen

    gap = np.zeros((left.pixels.shape[0], 4, 3), np.uint8)
    masks = None
    if left.saturated is not None and right.saturated is not None:
        masks = np.hstack([left.saturated, gap[..., 0], right.saturated])
    pixels = np.hstack([left.pixels, gap, right.pixels])
    return Seen(pixels, {**right.facts, "what": "direct, global"}, masks)


class _Screen:
    """A terminal in which pictures take each other's place."""

    def __init__(self, columns: int, lines: int) -> None:
        self._columns, self._lines = columns, lines

    def __enter__(self) -> None:
        sys.stdout.write(_DRAWING)

    def __exit__(self, *error: object) -> None:
        sys.stdout.write(_DRAWN)
        sys.stdout.flush()

    def draw(self, pixels: NDArray[np.uint8], facts: dict[str, Any]) -> None:
        """Draw over what is there."""
        from protocol.cli.picture import in_terminal

        told = [told_of(facts) + " · Ctrl-C ends it"]
        if facts.get("histogram"):
            told.append(bars(facts["histogram"]))
        picture = in_terminal(pixels, self._columns, self._lines - len(told) - 1)
        below = "".join(f"{line[: self._columns - 1]}\x1b[K\n" for line in told)
        sys.stdout.write(f"\x1b[H{picture}\x1b[K\n{below}\x1b[J")
        sys.stdout.flush()


# ---------------------------------------------------------------- what is said of a picture


def png_name(out: Path | None) -> None:
    """Raise UmbraError(bad_request) for what is no PNG file's name."""
    if out is not None and out.suffix.lower() != ".png":
        raise UmbraError(Code.BAD_REQUEST, f"{out}: pictures are PNG files: name it {out}.png")


def say_facts(facts: dict[str, Any]) -> None:
    """What one wants to know when setting the exposure; the histogram as a line of bars."""
    told = told_of(facts)
    if told:
        say(told)
    if facts.get("histogram") and on_terminal(sys.stderr):
        say(bars(facts["histogram"]))


def told_of(facts: dict[str, Any]) -> str:
    """Exposure, brightness and saturation in words."""
    told = [
        str(facts[name]) for name in ("what", "run") if facts.get(name) not in (None, "", "frame")
    ]
    if "exposure_us" in facts:
        told.append(f"exposure {facts['exposure_us']:g} µs")
    if "mean" in facts and "full_scale" in facts:
        told.append(f"mean {facts['mean']:.0f} of {facts['full_scale']:.0f}")
    if "saturated" in facts:
        told.append(f"{100 * facts['saturated']:.2f}% saturated")
    if facts.get("age_s", 0.0) >= OLD_S:
        told.append(f"taken {facts['age_s']:.0f} s ago")
    return " · ".join(told)


def bars(histogram: Sequence[float]) -> str:
    """A histogram as one line of block characters, its height the square root of the count."""
    most = max(histogram) or 1
    return "".join(" ▁▂▃▄▅▆▇█"[math.ceil(8 * math.sqrt(count / most))] for count in histogram)
