"""The asyncio client: ``async with AsyncClient() as rig: run = await rig.scan(Checkerboard())``.

The same commands, retries and errors as the blocking client's. Requests may overlap: each answer
finds its own by id. A cancelled request is forgotten; its late answer is passed over.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import zmq
import zmq.asyncio

from protocol.aio_run import AsyncRun
from protocol.arrivals import arrival, place_for
from protocol.bothways import Awaited
from protocol.commands import Commands
from protocol.connection import (
    ATTEMPTS,
    Ask,
    Exchange,
    GivenKeys,
    Inbox,
    Notice,
    deaf,
    dealer,
    events_endpoint,
    id_of,
    split_topics,
    subscriber,
    unreachable,
)
from protocol.errors import Code, UmbraError
from protocol.messages.replies import Welcome
from protocol.scans.anyscan import AnyScan

T = TypeVar("T")
log = logging.getLogger("umbra")


class AsyncClient(Awaited, Commands):
    """A connection to a rig, with a coroutine for each command. For one loop."""

    welcome: Welcome

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        keys: GivenKeys = None,
        timeout_s: float = 5.0,
        name: str = "",
    ) -> None:
        super().__init__(endpoint, keys, timeout_s, name)
        self._context = zmq.asyncio.Context()
        self._streams: weakref.WeakSet[AsyncEventStream] = weakref.WeakSet()
        self._lines: list[_Line] = []
        self._waiting: dict[str, asyncio.Future[list[zmq.Frame]]] = {}

    # -------------------------------------------------------- life

    async def open(self) -> AsyncClient:
        """Connect, with the version check. Raises UmbraError."""
        try:
            self.welcome = await self.hello()
        except BaseException:
            await self.close()
            raise
        return self

    async def close(self) -> None:
        """Let go of the rig; what runs there goes on. Requests under way end in UNREACHABLE."""
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(_closed())
        await self._retire(keep=0)
        for stream in list(self._streams):
            stream.close()
        self._context.destroy(linger=0)

    async def __aenter__(self) -> AsyncClient:
        return await self.open()

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    def __repr__(self) -> str:
        state = " (closed)" if self._context.closed else ""
        return f"<AsyncClient of {self.endpoint}{state}>"

    # -------------------------------------------------------- one request

    async def perform(self, ask: Ask[T]) -> T:
        """Ask, wait, repeat: what the answer says. Raises UmbraError."""
        exchange = Exchange(ask, self.token)
        whole = max(self.timeout_s, ask.timeout_s)
        begun = time.monotonic()
        future = asyncio.get_running_loop().create_future()
        self._waiting[exchange.id] = future
        try:
            for attempt in range(1, ATTEMPTS + 1):
                until = begun + whole * attempt / ATTEMPTS
                line = self._line(fresh=attempt > 1)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(max(0.0, until - time.monotonic())):
                        await line.send(exchange)
                        return exchange.value(await asyncio.shield(future))
            raise unreachable(self.endpoint, whole, self.keys)
        finally:
            future.cancel()
            del self._waiting[exchange.id]
            if not self._waiting:
                await self._retire(keep=1)

    async def _retire(self, *, keep: int) -> None:
        """Close all lines but the newest."""
        old, self._lines = (
            self._lines[: len(self._lines) - keep],
            self._lines[len(self._lines) - keep :],
        )
        for line in old:
            await line.close()

    def _line(self, *, fresh: bool) -> _Line:
        if self._context.closed:
            raise _closed()
        if fresh or not self._lines:
            socket = dealer(self._context, self.endpoint, self.keys)
            self._lines.append(_Line(socket, self._waiting))
        return self._lines[-1]

    # -------------------------------------------------------- runs

    async def scan(self, spec: AnyScan, *, first: bool = False) -> AsyncRun:
        """Queue a scan and hand back its run, at once."""
        return AsyncRun(self, await self.submit(spec, first=first))

    async def reprocess(
        self,
        run: AsyncRun | str,
        *,
        calibration: Literal["recorded", "now"] = "recorded",
        **changes: Any,
    ) -> AsyncRun:
        """Separate a run's recorded frames anew, with other values for fields of its spec
        (`leakage=0.04`, `estimator="maxmin"`), and hand back the new run, at once.

        Fields that say what was shown or exposed cannot be changed. `calibration`: the run's own,
        or what applies now.
        """
        which = run if isinstance(run, str) else run.id
        info = await self.submit_reprocess(which, calibration=calibration, changes=changes)
        return AsyncRun(self, info)

    async def run(self, run: str = "") -> AsyncRun:
        """A handle on a run; "" is the current or else the newest."""
        return AsyncRun(self, await self.run_info(run))

    async def download(self, run: str, name: str, to: Path | str) -> Path:
        """Fetch a product's file to a path, or into a folder; the file appears when it is whole."""
        part = await self.product_part(run, name)
        path, size = place_for(to, part.product), part.size
        with arrival(path) as file:
            while True:
                await asyncio.to_thread(file.write, part.data)
                done = part.offset + len(part.data)
                if done >= size or not part.data:
                    break
                part = await self.product_part(run, name, offset=done)
            await asyncio.to_thread(file.finish, size)
        return path

    # -------------------------------------------------------- events

    def subscribe(self, *topics: str, joined: bool = True) -> AsyncEventStream:
        """The rig's events as they come: run, progress, queue, device, rig, preview.

        No topic means all but previews. Close it, or use it as a context manager, which with
        `joined` waits until the rig has heard of it: of what happens then, nothing is missed. It
        raises UmbraError(unreachable) where no events come within the time-out.
        """
        endpoint = events_endpoint(self.welcome, self.endpoint)
        stream = AsyncEventStream(
            [
                subscriber(self._context, endpoint, self.keys, names, hwm)
                for names, hwm in split_topics(topics)
            ],
            endpoint,
            self.timeout_s if joined else None,
        )
        self._streams.add(stream)
        return stream

    # -------------------------------------------------------- the lock

    @contextlib.asynccontextmanager
    async def hold(
        self, owner: str = "", note: str = "", lease_s: float = 10.0
    ) -> AsyncIterator[None]:
        """Hold the rig for manual work: ``async with rig.hold("me", note="focusing"): ...``.

        A task renews the lock three times a lease. Where that fails the rig goes to its safe
        state, and the error is raised at the end of the block.
        """
        locked = await self.lock(owner or self.name, note, lease_s)
        self.token = locked.token
        lost: UmbraError | None = None

        async def beat() -> None:
            nonlocal lost
            try:
                while True:
                    await asyncio.sleep(locked.lease_s / 3)
                    await self.renew_lock()
            except UmbraError as error:
                log.warning("the rig's lock is lost: %s", error)
                lost = UmbraError(error.code, f"the rig's lock was lost: {error}", error.where)

        heartbeat = asyncio.create_task(beat())
        try:
            yield
        finally:
            heartbeat.cancel()
            await asyncio.wait([heartbeat])
            try:
                if lost is None:
                    await self.unlock()
            finally:
                self.token = ""
        if lost is not None:
            raise lost


def _closed() -> UmbraError:
    return UmbraError(Code.UNREACHABLE, "this client is closed: connect again")


class _Line:
    """A DEALER socket and the task that hands its answers to those who wait."""

    def __init__(
        self,
        socket: zmq.asyncio.Socket,
        waiting: dict[str, asyncio.Future[list[zmq.Frame]]],
    ) -> None:
        self._socket = socket
        self._waiting = waiting
        self._reader = asyncio.create_task(self._read())

    async def send(self, exchange: Exchange[T]) -> None:
        """Send as soon as there is a connection."""
        await self._socket.send_multipart(exchange.message)

    async def _read(self) -> None:
        while True:
            frames = await self._socket.recv_multipart(copy=False)
            future = self._waiting.get(id_of(frames))
            if future is not None and not future.done():
                future.set_result(frames)

    async def close(self) -> None:
        self._reader.cancel()
        await asyncio.wait([self._reader])
        self._socket.close()


class AsyncEventStream:
    """Events, one after the other; made by `AsyncClient.subscribe`."""

    def __init__(
        self, sockets: list[zmq.asyncio.Socket], endpoint: str, join_s: float | None
    ) -> None:
        self._sockets, self._endpoint, self._join_s = sockets, endpoint, join_s
        self._inbox = Inbox()
        self._waiting: deque[Notice] = deque()

    async def next(self, timeout_s: float | None = None) -> Notice | None:
        """The next event, or None after `timeout_s` without one and when the stream is closed."""
        there = await self._received(lambda: bool(self._waiting), timeout_s)
        return self._waiting.popleft() if there else None

    async def join(self, timeout_s: float) -> None:
        """Wait until the rig has heard of all subscriptions; else close, and raise UmbraError."""
        sockets, joined = self._sockets, self._inbox.joined
        if not await self._received(lambda: len(joined) >= len(sockets), timeout_s):
            self.close()
            raise deaf(self._endpoint, timeout_s)

    async def _received(self, enough: Callable[[], bool], timeout_s: float | None) -> bool:
        until = None if timeout_s is None else time.monotonic() + timeout_s
        poller = zmq.asyncio.Poller()
        for socket in self._sockets:
            poller.register(socket, zmq.POLLIN)
        while not enough():
            if any(socket.closed for socket in self._sockets):
                return False
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                return False
            await poller.poll(None if left is None else max(1, int(left * 1000)))
            self._waiting.extend(self._inbox.take(await self._drained()))
        return True

    async def _drained(self) -> list[list[zmq.Frame]]:
        messages = []
        for socket in self._sockets:
            with contextlib.suppress(zmq.Again):
                while True:
                    messages.append(await socket.recv_multipart(zmq.NOBLOCK, copy=False))
        return messages

    def __aiter__(self) -> AsyncEventStream:
        return self

    async def __anext__(self) -> Notice:
        notice = await self.next()
        if notice is None:
            raise StopAsyncIteration
        return notice

    def close(self) -> None:
        """Unsubscribe."""
        for socket in self._sockets:
            socket.close()

    async def __aenter__(self) -> AsyncEventStream:
        if self._join_s is not None:
            await self.join(self._join_s)
        return self

    async def __aexit__(self, *error: object) -> None:
        self.close()
