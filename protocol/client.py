"""The blocking client: ``with connect() as rig: run = rig.scan(Checkerboard())``.

Requests are repeated and given up as `protocol.connection` says. A Client may be used from several
threads; their requests take turns. Ctrl-C ends a wait at once and leaves the client usable.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeVar

import zmq

from protocol.arrivals import arrival, place_for
from protocol.bothways import Blocking
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
from protocol.run import Run
from protocol.scans.anyscan import AnyScan

T = TypeVar("T")
log = logging.getLogger("umbra")


def connect(
    endpoint: str | None = None,
    *,
    keys: GivenKeys = None,
    timeout_s: float = 5.0,
    name: str = "",
) -> Client:
    """Connect to a rig: the endpoint given, or UMBRA_RIG's, or the one on this machine.

    `keys` are a client's keys or their folder; without, see `ClientKeys.default`; False is none at
    all. `timeout_s` is how long an answer may take, repeats included. Raises UmbraError:
    unreachable, version_mismatch, bad_keys, and bad_request for what is no endpoint.
    """
    return Client(endpoint, keys=keys, timeout_s=timeout_s, name=name)


class Client(Blocking, Commands):
    """A connection to a rig, with a blocking method for each command."""

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        keys: GivenKeys = None,
        timeout_s: float = 5.0,
        name: str = "",
    ) -> None:
        super().__init__(endpoint, keys, timeout_s, name)
        self._turn = threading.RLock()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._sockets: list[zmq.Socket[bytes]] = []
        try:
            self.welcome: Welcome = self.hello()
        except BaseException:
            self.close()
            raise

    # -------------------------------------------------------- life

    def close(self) -> None:
        """Let go of the rig; what runs there goes on. Streams of events end too."""
        with self._turn:
            self._context.destroy(linger=0)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = " (closed)" if self._context.closed else ""
        return f"<Client of {self.endpoint}{state}>"

    # -------------------------------------------------------- one request

    def perform(self, ask: Ask[T]) -> T:
        """Ask, wait, repeat: what the answer says. Raises UmbraError."""
        with self._turn:
            if self._context.closed:
                raise UmbraError(Code.UNREACHABLE, "this client is closed: connect again")
            exchange = Exchange(ask, self.token)
            whole = max(self.timeout_s, ask.timeout_s)
            begun = time.monotonic()
            try:
                for attempt in range(1, ATTEMPTS + 1):
                    if attempt > 1 or not self._sockets:
                        self._sockets.append(dealer(self._context, self.endpoint, self.keys))
                    answer = self._attempt(exchange, begun + whole * attempt / ATTEMPTS)
                    if answer is not None:
                        return exchange.value(answer)
            finally:
                while len(self._sockets) > 1:
                    self._sockets.pop(0).close()
            raise unreachable(self.endpoint, whole, self.keys)

    def _attempt(self, exchange: Exchange[T], until: float) -> list[zmq.Frame] | None:
        """Send on the newest socket as soon as it is connected; hear them all."""
        newest, sent = self._sockets[-1], False
        poller = zmq.Poller()
        for socket in self._sockets:
            poller.register(socket, zmq.POLLIN)
        poller.register(newest, zmq.POLLIN | zmq.POLLOUT)
        while (left := until - time.monotonic()) > 0:
            for socket, state in poller.poll(max(1, int(left * 1000))):
                if state & zmq.POLLIN:
                    frames: list[zmq.Frame] = socket.recv_multipart(copy=False)
                    if id_of(frames) == exchange.id:
                        return frames
                if not sent and state & zmq.POLLOUT and socket is newest:
                    newest.send_multipart(exchange.message)
                    poller.register(newest, zmq.POLLIN)
                    sent = True
        return None

    # -------------------------------------------------------- runs

    def scan(self, spec: AnyScan, *, first: bool = False) -> Run:
        """Queue a scan and hand back its run, at once."""
        return Run(self, self.submit(spec, first=first))

    def reprocess(
        self,
        run: Run | str,
        *,
        calibration: Literal["recorded", "now"] = "recorded",
        **changes: Any,
    ) -> Run:
        """Separate a run's recorded frames anew, with other values for fields of its spec
        (`leakage=0.04`, `estimator="maxmin"`), and hand back the new run, at once.

        Fields that say what was shown or exposed cannot be changed. `calibration`: the run's own,
        or what applies now.
        """
        which = run if isinstance(run, str) else run.id
        info = self.submit_reprocess(which, calibration=calibration, changes=changes)
        return Run(self, info)

    def run(self, run: str = "") -> Run:
        """A handle on a run; "" is the current or else the newest."""
        return Run(self, self.run_info(run))

    def download(self, run: str, name: str, to: Path | str) -> Path:
        """Fetch a product's file to a path, or into a folder; the file appears when it is whole."""
        part = self.product_part(run, name)
        path, size = place_for(to, part.product), part.size
        with arrival(path) as file:
            while True:
                file.write(part.data)
                done = part.offset + len(part.data)
                if done >= size or not part.data:
                    break
                part = self.product_part(run, name, offset=done)
            file.finish(size)
        return path

    # -------------------------------------------------------- events

    def subscribe(self, *topics: str, joined: bool = True) -> EventStream:
        """The rig's events as they come: run, progress, queue, device, rig, preview.

        No topic means all but previews. Close it, or use it as a context manager. With `joined`
        it waits until the rig has heard of it: of what happens then, nothing is missed. Raises
        UmbraError(unreachable) where no events come within the time-out.
        """
        endpoint = events_endpoint(self.welcome, self.endpoint)
        stream = EventStream(
            [
                subscriber(self._context, endpoint, self.keys, names, hwm)
                for names, hwm in split_topics(topics)
            ],
            endpoint,
        )
        if joined:
            stream.join(self.timeout_s)
        return stream

    # -------------------------------------------------------- the lock

    @contextlib.contextmanager
    def hold(self, owner: str = "", note: str = "", lease_s: float = 10.0) -> Iterator[None]:
        """Hold the rig for manual work: ``with rig.hold("me", note="focusing"): ...``.

        A thread renews the lock three times a lease, over a connection of its own. Where that
        fails the rig goes to its safe state, and the error is raised at the end of the block.
        """
        locked = self.lock(owner or self.name, note, lease_s)
        self.token = locked.token
        heartbeat = _Heartbeat(self, locked.lease_s)
        try:
            with heartbeat:
                yield
        finally:
            try:
                if heartbeat.error is None:
                    self.unlock()
            finally:
                self.token = ""
        if heartbeat.error is not None:
            raise heartbeat.error


class EventStream(Iterator[Notice]):
    """Events, one after the other; made by `Client.subscribe`. For one thread."""

    def __init__(self, sockets: list[zmq.Socket[bytes]], endpoint: str) -> None:
        self._sockets, self._endpoint = sockets, endpoint
        self._inbox = Inbox()
        self._waiting: deque[Notice] = deque()

    def next(self, timeout_s: float | None = None) -> Notice | None:
        """The next event, or None after `timeout_s` without one and when the stream is closed."""
        if any(socket.closed for socket in self._sockets):
            return None
        there = self._received(lambda: bool(self._waiting), timeout_s)
        return self._waiting.popleft() if there else None

    def join(self, timeout_s: float) -> None:
        """Wait until the rig has heard of all subscriptions; else close, and raise UmbraError."""
        if not self._received(lambda: len(self._inbox.joined) >= len(self._sockets), timeout_s):
            self.close()
            raise deaf(self._endpoint, timeout_s)

    def _received(self, enough: Callable[[], bool], timeout_s: float | None) -> bool:
        until = None if timeout_s is None else time.monotonic() + timeout_s
        poller = zmq.Poller()
        for socket in self._sockets:
            poller.register(socket, zmq.POLLIN)
        while not enough():
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                return False
            poller.poll(None if left is None else max(1, int(left * 1000)))
            self._waiting.extend(self._inbox.take(self._drained()))
        return True

    def _drained(self) -> list[list[zmq.Frame]]:
        messages = []
        for socket in self._sockets:
            with contextlib.suppress(zmq.Again):
                while True:
                    messages.append(socket.recv_multipart(zmq.NOBLOCK, copy=False))
        return messages

    def __iter__(self) -> EventStream:
        return self

    def __next__(self) -> Notice:
        notice = self.next()
        if notice is None:
            raise StopIteration
        return notice

    def close(self) -> None:
        """Unsubscribe."""
        for socket in self._sockets:
            socket.close()

    def __enter__(self) -> EventStream:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _Heartbeat:
    """A thread that renews a lock until it is stopped, or until it fails."""

    def __init__(self, rig: Client, lease_s: float) -> None:
        self.error: UmbraError | None = None
        self._rig, self._lease_s = rig, lease_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="umbra lock", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()

    def _beat(self) -> None:
        own, every = self._rig, self._lease_s / 3
        try:
            with Client(
                own.endpoint, keys=own.keys, timeout_s=min(own.timeout_s, every), name=own.name
            ) as line:
                line.token = own.token
                while not self._stop.wait(every):
                    line.renew_lock()
        except UmbraError as error:
            log.warning("the rig's lock is lost: %s", error)
            self.error = UmbraError(error.code, f"the rig's lock was lost: {error}", error.where)
