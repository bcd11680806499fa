"""A run as its operator has it in hand."""

from __future__ import annotations

import html
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protocol.arrivals import place_in
from protocol.errors import Code, UmbraError
from protocol.following import SILENCE_S, Following
from protocol.messages.runs import Progress, RunInfo, RunState
from protocol.results import Separation

if TYPE_CHECKING:
    from protocol.client import Client


def failure(info: RunInfo) -> UmbraError:
    """Why a run came to no good end."""
    reason = info.end.reason if info.end and info.end.reason else f"it is {info.state.value}"
    try:
        code = Code(info.end.code) if info.end else Code.WRONG_STATE
    except ValueError:
        code = Code.INTERNAL if info.state is RunState.FAILED else Code.WRONG_STATE
    return UmbraError(code, f"run {info.id} {info.state.value}: {reason}")


class Known:
    """What is known of a run: `info`, as last heard."""

    def __init__(self, info: RunInfo) -> None:
        self.info = info

    @property
    def id(self) -> str:
        """The run's id."""
        return self.info.id

    @property
    def state(self) -> RunState:
        """The run's state as last heard; `refresh` asks."""
        return self.info.state

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {described(self.info)}>"

    def _repr_html_(self) -> str:
        return f"<b>{html.escape(self.id)}</b> {html.escape(described(self.info, with_id=False))}"


class Run(Known):
    """A run on a rig: follow it, steer it, fetch what it made."""

    def __init__(self, rig: Client, info: RunInfo) -> None:
        super().__init__(info)
        self._rig = rig

    def refresh(self) -> RunInfo:
        """Ask the rig how the run is."""
        self.info = self._rig.run_info(self.id)
        return self.info

    def progress(self) -> Iterator[Progress]:
        """How the run goes on, until it has ended: first as it is, then each change.

        Where events were lost or the daemon restarted, the next one is from a snapshot. Raises
        UmbraError(unreachable) when the rig is gone.
        """
        return self._followed(("run", "progress"), until=None)

    def wait(self, timeout_s: float | None = None, *, check: bool = True) -> RunInfo:
        """Wait until the run has ended.

        Raises TimeoutError (the run goes on), and with `check` the UmbraError of a run that did
        not end well: failed, aborted, interrupted.
        """
        until = None if timeout_s is None else time.monotonic() + timeout_s
        for _ in self._followed(("run",), until):
            pass
        if not self.state.ended:
            raise TimeoutError(f"run {self.id} is {self.state} after {timeout_s:g} s")
        if check and self.state is not RunState.DONE:
            raise failure(self.info)
        return self.info

    def _followed(self, topics: tuple[str, ...], until: float | None) -> Iterator[Progress]:
        following = Following(self.id)
        with self._rig.subscribe(*topics, joined=False) as events:
            news = self._snapshot(following)
            while True:
                if news is not None:
                    yield news
                left = SILENCE_S if until is None else min(SILENCE_S, until - time.monotonic())
                if following.ended or left <= 0:
                    break
                notice = events.next(left)
                if notice is None or following.outdated_by(notice.event):
                    news = self._snapshot(following)
                else:
                    news = following.event(notice.event)
        self.refresh()

    def _snapshot(self, following: Following) -> Progress | None:
        status = self._rig.status()
        return following.snapshot(status, self.refresh())

    def result(self, *, check: bool = True) -> Separation:
        """Direct and global as they are now; final when the run is done.

        Raises UmbraError: no_result before the first frames; with `check`, the reason of a run
        that failed.
        """
        if check and self.refresh().state is RunState.FAILED:
            raise failure(self.info)
        return self._rig.result(self.id)

    def facts(self) -> dict[str, Any]:
        """The figures of the run as they are now; of a calibration or verification all it has."""
        return self._rig.facts(self.id)

    def save(self, folder: Path | str) -> list[Path]:
        """Fetch all products into a folder, which is made; the files written."""
        return [
            self._rig.download(self.id, product.name, place_in(folder, product))
            for product in self.refresh().products
        ]

    def pause(self) -> None:
        """Pause after the step under way."""
        self._rig.pause(self.id)

    def resume(self) -> None:
        """Go on."""
        self._rig.resume(self.id)

    def abort(self) -> None:
        """End the run; what was recorded is kept."""
        self._rig.abort(self.id)


def described(info: RunInfo, *, with_id: bool = True) -> str:
    """A run in a few words."""
    method = info.spec.__struct_config__.tag
    frames = f"{info.recorded}/{info.planned}" if info.planned else f"{info.recorded}"
    end = f", {info.end.reason}" if info.end and info.end.reason else ""
    return f"{info.id + ': ' if with_id else ''}{method}, {info.state.value}, {frames} frames{end}"
