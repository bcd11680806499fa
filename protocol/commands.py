"""Every command as a typed method, written once for both clients.

A method here says what to send and what the answer becomes. `Client` has it as a blocking call,
`AsyncClient` as a coroutine: `command` binds it to either.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import (
    TYPE_CHECKING,
    Any,
    Concatenate,
    Generic,
    Literal,
    ParamSpec,
    TypeVar,
    cast,
    overload,
)

from protocol import messages as m
from protocol.connection import Answer, Ask, checked, expect
from protocol.messages import CameraSettings, Progress, Role, RunInfo, RunState
from protocol.patterns import AnyPattern
from protocol.scans import AnyScan

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from protocol.aio import AsyncClient
    from protocol.client import Client

P = ParamSpec("P")
T = TypeVar("T")

SLOW_S = 30.0
"""The least time-out of a command whose own work takes time: an exposure, a large array."""


class command(Generic[P, T]):  # noqa: N801  (a decorator, as property is)
    """Makes a function that returns an Ask into a method of both clients."""

    def __init__(self, make: Callable[Concatenate[Any, P], Ask[T]]) -> None:
        functools.update_wrapper(cast("Any", self), make)
        self._make = make

    @overload
    def __get__(self, rig: None, owner: type) -> command[P, T]: ...
    @overload
    def __get__(self, rig: Client, owner: type) -> Callable[P, T]: ...
    @overload
    def __get__(self, rig: AsyncClient, owner: type) -> Callable[P, Coroutine[Any, Any, T]]: ...
    def __get__(self, rig: Any, owner: type) -> Any:
        if rig is None:
            return self

        @functools.wraps(self._make)
        def call(*args: P.args, **kwargs: P.kwargs) -> Any:
            return rig.perform(self._make(rig, *args, **kwargs))

        call.__signature__ = _bound(self._make)  # type: ignore[attr-defined]
        return call


@functools.cache
def _bound(make: Callable[..., Any]) -> inspect.Signature:
    """The signature that a person sees: without self, and with what comes back."""
    whole = inspect.signature(make)
    back = str(whole.return_annotation).removeprefix("Ask[").removesuffix("]")
    return whole.replace(parameters=list(whole.parameters.values())[1:], return_annotation=back)


# ---------------------------------------------------------------- what comes back


@dataclass(frozen=True)
class Picture:
    """A frame or a preview: the array, or the bytes of a PNG file, and what is known of it."""

    pixels: NDArray[Any]
    facts: dict[str, Any]

    def _repr_html_(self) -> str:
        shown = ", ".join(f"{k} {v}" for k, v in self.facts.items() if isinstance(v, int | float))
        return f"<code>{'×'.join(map(str, self.pixels.shape))} {self.pixels.dtype}</code> {shown}"


@dataclass(frozen=True)
class Separation:
    """Direct and global light: float32, H x W or H x W x 3 (RGB), linear camera counts.

    The arrays are read-only views of the message that was received; copy one to change it.
    `quality` is a mask of named bits (uint16), or None. `final` is False while the run goes on.
    Python has taken the name `global`: `global_` it is here, or ``getattr(result, "global")``.
    """

    direct: NDArray[np.float32]
    global_: NDArray[np.float32]
    quality: NDArray[np.uint16] | None
    run: RunInfo
    facts: dict[str, Any]
    final: bool

    def __getattr__(self, name: str) -> Any:
        if name == "global":
            return self.global_
        raise AttributeError(name)

    def __repr__(self) -> str:
        size = "×".join(map(str, self.direct.shape))
        kind = "final" if self.final else f"so far ({self.run.recorded} frames)"
        return f"<Separation of {self.run.id}: direct, global_ {size} float32, {kind}>"


def _separation(answer: Answer) -> Separation:
    reply = expect(answer.reply, m.Result)
    return Separation(
        direct=answer.array("direct", "float32"),
        global_=answer.array("global", "float32"),
        quality=answer.array("quality", "uint16") if "quality" in answer.arrays else None,
        run=reply.run,
        facts=reply.facts,
        final=reply.final,
    )


def _picture(*names: str) -> Callable[[Answer], Picture]:
    def made(answer: Answer) -> Picture:
        reply = expect(answer.reply, m.Picture)
        name = next((n for n in names if n in answer.arrays), names[0])
        return Picture(answer.array(name), reply.facts)

    return made


def _run(answer: Answer) -> RunInfo:
    return expect(answer.reply, m.Run).run


def _runs(answer: Answer) -> tuple[RunInfo, ...]:
    return expect(answer.reply, m.Runs).runs


def _message(answer: Answer) -> str:
    """What the daemon says to a command that has no other answer."""
    return expect(answer.reply, m.Done).message


def _whatever(answer: Answer) -> m.AnyReply:
    return answer.reply


@dataclass(frozen=True)
class Part:
    """A part of a product's file."""

    product: m.Product
    offset: int
    size: int
    data: memoryview


def _part(answer: Answer) -> Part:
    reply = expect(answer.reply, m.ProductPart)
    return Part(reply.product, reply.offset, reply.size, answer.array("data", "uint8").data)


# ---------------------------------------------------------------- the commands


class Commands:
    """The methods that both clients have. Each raises UmbraError with the daemon's reason.

    `run` is a run's id; "" means the current run (or, to read, else the newest).
    """

    name: str  # who asks, for the rig's records

    @command
    def hello(self) -> Ask[m.Welcome]:
        """Who is there, with the version check; done on connecting."""
        return Ask(m.Hello(client=self.name), lambda a: checked(expect(a.reply, m.Welcome)))

    @command
    def status(self) -> Ask[m.Status]:
        """Everything that changes, now: rig, devices, current run, queue, lock, free space."""
        return Ask(m.GetStatus(), lambda a: expect(a.reply, m.Status))

    @command
    def devices(self) -> Ask[tuple[m.DeviceInfo, ...]]:
        """The devices in detail."""
        return Ask(m.GetDevices(), lambda a: expect(a.reply, m.Devices).devices)

    @command
    def submit(self, spec: AnyScan, *, first: bool = False) -> Ask[RunInfo]:
        """Queue a scan, ahead of the others if `first`; comes back at once. `scan` gives a Run."""
        return Ask(m.Submit(spec=spec, by=self.name, first=first), _run)

    @command
    def queue(self) -> Ask[tuple[RunInfo, ...]]:
        """The runs that wait, in order."""
        return Ask(m.GetQueue(), _runs)

    @command
    def move_queued(self, run: str, to: int) -> Ask[m.AnyReply]:
        """Put a waiting run at another place in the queue (0 is next)."""
        return Ask(m.MoveQueued(run=run, to=to), _whatever)

    @command
    def pause(self, run: str = "") -> Ask[m.AnyReply]:
        """Pause a run after the step under way: projector dark, stage held."""
        return Ask(m.Pause(run=run), _whatever)

    @command
    def resume(self, run: str = "") -> Ask[m.AnyReply]:
        """Go on with a paused run, or queue an interrupted one where it stopped."""
        return Ask(m.Resume(run=run), _whatever)

    @command
    def abort(self, run: str = "") -> Ask[m.AnyReply]:
        """End a run and go to the safe state; what was recorded is kept."""
        return Ask(m.Abort(run=run, by=self.name), _whatever)

    @command
    def estop(self) -> Ask[m.AnyReply]:
        """Safe state now; everything is refused until `reset`."""
        return Ask(m.EStop(by=self.name), _whatever)

    @command
    def reset(self) -> Ask[m.AnyReply]:
        """End an emergency stop."""
        return Ask(m.Reset(), _whatever)

    @command
    def runs(self, limit: int = 50, state: RunState | None = None) -> Ask[tuple[RunInfo, ...]]:
        """Runs, the newest first."""
        return Ask(m.ListRuns(limit=limit, state=state), _runs)

    @command
    def run_info(self, run: str = "") -> Ask[RunInfo]:
        """What is known of one run; `run` gives a handle on it."""
        return Ask(m.GetRun(run=run), _run)

    @command
    def result(self, run: str = "") -> Ask[Separation]:
        """Direct and global, final or so far."""
        return Ask(m.GetResult(run=run), _separation, SLOW_S)

    @command
    def product_part(self, run: str, name: str, offset: int = 0, limit: int = 8 << 20) -> Ask[Part]:
        """A part of a product's file; `download` fetches a whole one."""
        return Ask(m.GetProduct(run=run, name=name, offset=offset, limit=limit), _part, SLOW_S)

    @command
    def log(self, run: str = "", limit: int = 200) -> Ask[tuple[dict[str, Any], ...]]:
        """The last log records of a run, or ("") of the daemon; the oldest first."""
        return Ask(m.GetLog(run=run, limit=limit), lambda a: expect(a.reply, m.Log).records)

    @command
    def preview(
        self, width: int = 640, what: Literal["frame", "direct", "global"] = "frame"
    ) -> Ask[Picture]:
        """The latest frame, small (uint8, RGB)."""
        return Ask(m.GetPreview(width=width, what=what), _picture("preview"))

    @command
    def show(self, pattern: AnyPattern, lease_s: float = 600.0) -> Ask[m.AnyReply]:
        """Show a pattern by hand; the projector goes dark after `lease_s`."""
        return Ask(m.Show(pattern=pattern, lease_s=lease_s), _whatever)

    @command
    def snap(self, *, png: bool = False, demosaic: bool = True) -> Ask[Picture]:
        """Take one frame as things are: native depth, or the bytes of a PNG file."""
        return Ask(m.Snap(png=png, demosaic=demosaic), _picture("frame", "png"), SLOW_S)

    @command
    def camera(
        self,
        *,
        exposure_us: float | None = None,
        gain: float | None = None,
        pixel_format: str | None = None,
        frame_rate_hz: float | None = None,
        roi: tuple[int, int, int, int] | None = None,
    ) -> Ask[CameraSettings]:
        """Change the camera's settings, or with none only read them: those in force."""
        settings = CameraSettings(
            exposure_us=exposure_us,
            gain=gain,
            pixel_format=pixel_format,
            frame_rate_hz=frame_rate_hz,
            roi=roi,
        )
        return Ask(m.SetCamera(settings=settings), lambda a: expect(a.reply, m.Camera).settings)

    @command
    def light(self, name: str, on: bool) -> Ask[m.AnyReply]:
        """Switch a light."""
        return Ask(m.SetLight(name=name, on=on), _whatever)

    @command
    def dark(self) -> Ask[m.AnyReply]:
        """End manual work: projector dark, lights off, stage held."""
        return Ask(m.Dark(), _whatever)

    @command
    def lock(self, owner: str, note: str = "", lease_s: float = 10.0) -> Ask[m.Locked]:
        """Take the lock, without its heartbeat: `hold` is the way to have both."""
        return Ask(
            m.Lock(owner=owner, note=note, lease_s=lease_s), lambda a: expect(a.reply, m.Locked)
        )

    @command
    def renew_lock(self) -> Ask[m.AnyReply]:
        """The heartbeat of this client's lock."""
        return Ask(m.RenewLock(), _whatever)

    @command
    def unlock(self, *, force: bool = False) -> Ask[m.AnyReply]:
        """Give the rig back; `force` breaks another's lock."""
        return Ask(m.Unlock(force=force), _whatever)


# ---------------------------------------------------------------- following a run


class Following:
    """What a run's progress is, from snapshots and events.

    A snapshot is asked for first, on a gap, on a new epoch, and on silence; events that a snapshot
    already holds are passed over.
    """

    def __init__(self, run: str) -> None:
        self.run = run
        self.last: Progress | None = None
        self._epoch = ""
        self._held: dict[str, int] = {}

    @property
    def ended(self) -> bool:
        """Whether there is nothing more to come."""
        return self.last is not None and self.last.state.ended

    def snapshot(self, status: m.Status, info: RunInfo) -> Progress | None:
        """The progress as of a snapshot, if that is news."""
        self._epoch, self._held = status.epoch, dict(status.sequences)
        there = status.progress
        if there is not None and there.run == self.run and there.state == info.state:
            return self._news(there)
        return self._news(self._of(info))

    def needs_snapshot(self, epoch: str, gap: bool) -> bool:
        """Whether an event says that the last snapshot is not enough any more."""
        return gap or epoch != self._epoch

    def event(self, event: m.Event) -> Progress | None:
        """The progress after an event, if that is news of this run."""
        if event.sequence <= self._held.get(event.topic, -1):
            return None
        match event.body:
            case m.Progressed(progress=progress) if progress.run == self.run:
                return self._news(progress)
            case m.RunChanged(run=info) if info.id == self.run:
                return self._news(self._of(info))
        return None

    def _of(self, info: RunInfo) -> Progress:
        """A run's own figures; what only the daemon's progress knows is kept from the last one."""
        last = self.last
        return Progress(
            run=info.id,
            state=info.state,
            recorded=info.recorded,
            planned=info.planned,
            missing=info.missing,
            rejected=info.rejected,
            fraction=1.0 if info.state is RunState.DONE else last.fraction if last else None,
            rate_hz=last.rate_hz if last and not info.state.ended else 0.0,
            remaining_s=0.0 if info.state.ended else last.remaining_s if last else None,
            phase=info.end.reason if info.end else info.state.value,
            summary=last.summary if last else {},
        )

    def _news(self, progress: Progress) -> Progress | None:
        if progress == self.last:
            return None
        self.last = progress
        return progress


__all__ = ["Commands", "Following", "Part", "Picture", "Role", "Separation", "command"]
