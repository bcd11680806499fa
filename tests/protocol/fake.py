"""A rig of the protocol alone: a thread with a ROUTER and a PUB, and faults on order.

It knows no devices and takes no time: a run goes on when the test says so.
"""

from __future__ import annotations

import itertools
import queue
import threading
import uuid
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
import numpy as np
import zmq
from zmq.auth.thread import ThreadAuthenticator

from protocol.errors import Code, ErrorInfo, UmbraError
from protocol.keys import KeyPair
from protocol.messages import commands, replies
from protocol.messages.access import Role
from protocol.messages.envelopes import JOINED, PROTOCOL, Event, Preamble, Request, Response
from protocol.messages.events import AnyEvent, RunChanged
from protocol.messages.findings import Check, Search
from protocol.messages.rig import RigState, StageState
from protocol.messages.runs import End, Product, RunInfo, RunState
from protocol.scans.anyscan import AnyScan
from protocol.wire import Arrays, decode, encode, headers

T = TypeVar("T")
UTC = "2026-01-01T00:00:00Z"
Frames = list[bytes]
STAGE = replies.StageStatus(
    state=StageState.IDLE,
    position_mm=(1.0, 2.0),
    travel_mm=((0.0, 100.0), (0.0, 50.0)),
    max_feed_mm_s=20.0,
)
_requests = msgspec.json.Decoder(Request)


class FakeRig:
    """Use as a context manager. `requests` are all that came, `done` those carried out."""

    def __init__(
        self,
        *,
        server_keys: KeyPair | None = None,
        command: str = "tcp://127.0.0.1:0",
        events: str = "tcp://127.0.0.1:0",
        allow: list[bytes] | None = None,
        protocol: int = PROTOCOL,
    ) -> None:
        self.protocol = protocol
        self.requests: list[Request] = []
        self.done: list[Request] = []
        self.drop = 0  # answers to swallow
        self.deaf = False  # to those who ask whether they have joined
        self.copies = 1  # how often each answer is sent
        self.hold_back = 0  # answers to send only together with the next one's
        self.before: list[Frames] = []  # messages to send ahead of the next answer
        self.mangle: Callable[[Frames], Frames] | None = None  # applied to each answer
        self.on_request: Callable[[Request], object] | None = None
        self.refuse: dict[str, ErrorInfo] = {}  # by command tag
        self.arrays: dict[str, np.ndarray[Any, Any]] = {
            "direct": np.arange(12, dtype=np.float32).reshape(3, 4),
            "global": np.full((3, 4), 2.5, np.float32),
        }
        self.checks: tuple[Check, ...] = ()
        self.files: dict[str, bytes] = {}
        self.runs: dict[str, RunInfo] = {}
        self.lock: replies.Locked | None = None
        self.renewed = threading.Event()
        self.finish_on_submit = False
        self.new_epoch()
        self._answers: dict[str, list[bytes | memoryview]] = {}
        self._held: list[list[bytes | memoryview]] = []
        self._ids = itertools.count(1)
        self._orders: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._auth: ThreadAuthenticator | None = None
        if server_keys is not None:
            self._auth = ThreadAuthenticator(self._context)
            self._auth.start()
            self._auth.configure_curve_callback(credentials_provider=_Allowed(allow or []))
        self._router = self._context.socket(zmq.ROUTER)
        self._pub = self._context.socket(zmq.XPUB)  # tells of subscriptions: no test need sleep
        for socket in (self._router, self._pub):
            socket.linger = 0
            if server_keys is not None:
                socket.curve_server = True
                socket.curve_publickey = server_keys.public
                socket.curve_secretkey = server_keys.secret
        self._router.bind(command)
        self._pub.bind(events)
        self.endpoint = _bound(self._router)
        self.events = _bound(self._pub)
        self.subscribed = threading.Semaphore(0)
        self._ours = self._context.socket(zmq.PAIR)
        self._ours.bind("inproc://orders")
        self._theirs = self._context.socket(zmq.PAIR)
        self._theirs.connect("inproc://orders")
        self._alive = True
        self._thread = threading.Thread(target=self._serve, name="fake rig")

    def __enter__(self) -> FakeRig:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.order(self._end)
        self._thread.join()
        if self._auth is not None:
            self._auth.stop()
        self._context.destroy(linger=0)

    # -------------------------------------------------------- what a test orders

    def order(self, what: Callable[[], T]) -> T:
        """Have the rig's thread do something, and wait for it."""
        result: queue.SimpleQueue[T] = queue.SimpleQueue()
        self._orders.put(lambda: result.put(what()))
        self._theirs.send(b"")
        return result.get(timeout=60)

    def publish(self, body: AnyEvent, arrays: Arrays | None = None, *, lose: bool = False) -> None:
        """Send an event, or count it and lose it on the way."""

        def do() -> None:
            topic = type(body).topic
            self.sequences[topic] = self.sequences.get(topic, 0) + 1
            event = Event(
                topic=topic,
                sequence=self.sequences[topic],
                epoch=self.epoch,
                utc=UTC,
                body=body,
                arrays=headers(arrays or {}),
            )
            if not lose:
                self._pub.send_multipart([topic.encode(), *encode(event, arrays)])

        self.order(do)

    def publish_raw(self, *frames: bytes) -> None:
        """Send anything on the event endpoint."""
        self.order(lambda: self._pub.send_multipart(frames))

    def change(self, run: str, *, tell: bool = True, lose: bool = False, **fields: Any) -> RunInfo:
        """A run goes on; `tell` publishes it."""

        def do() -> RunInfo:
            self.runs[run] = msgspec.structs.replace(self.runs[run], **fields)
            return self.runs[run]

        info = self.order(do)
        if tell:
            self.publish(RunChanged(run=info), lose=lose)
        return info

    def await_subscribers(self, count: int) -> None:
        """Wait until so many subscriptions (one a topic) have arrived since the last call."""
        for _ in range(count):
            assert self.subscribed.acquire(timeout=10)

    def new_epoch(self) -> None:
        """As after a restart: counters begin again."""
        self.epoch = uuid.uuid4().hex
        self.sequences: dict[str, int] = {}

    # -------------------------------------------------------- the thread

    def _end(self) -> None:
        self._alive = False

    def _serve(self) -> None:
        poller = zmq.Poller()
        for socket in (self._router, self._pub, self._ours):
            poller.register(socket, zmq.POLLIN)
        while self._alive:
            ready = dict(poller.poll())
            if self._ours in ready:
                self._ours.recv()
                self._orders.get()()
            if self._pub in ready:
                self._subscribed(self._pub.recv())
            if self._router in ready:
                self._answer(*self._router.recv_multipart())

    def _subscribed(self, message: bytes) -> None:
        if message.startswith(b"\1" + JOINED.encode()):
            if not self.deaf:
                self._pub.send(message[1:])
        elif message.startswith(b"\1"):
            self.subscribed.release()

    def _answer(self, identity: bytes, header: bytes, *_: bytes) -> None:
        request: Request | None
        try:
            preamble = msgspec.json.decode(header, type=Preamble)
            self._check(preamble.protocol)
            request = decode(_requests, header)
            self.requests.append(request)
            if request.id not in self._answers:
                self.done.append(request)
                reply, arrays = self._reply(request)
                response = Response(id=request.id, reply=reply, arrays=headers(arrays))
                self._answers[request.id] = encode(response, arrays)
            message = self._answers[request.id]
        except UmbraError as error:
            message = encode(Response(id=preamble.id, error=error.info))
            request = None
        if self.on_request is not None and request is not None:
            self.on_request(request)
        if self.mangle is not None:
            message = list(self.mangle([bytes(part) for part in message]))
        if self.drop:
            self.drop -= 1
            return
        for frames in self.before:
            self._router.send_multipart([identity, *frames])
        self.before.clear()
        if self.hold_back:
            self.hold_back -= 1
            self._held.append([identity, *message])
            return
        for late in self._held:
            self._router.send_multipart(late)
        self._held.clear()
        for _copy in range(self.copies):
            self._router.send_multipart([identity, *message])

    def _check(self, theirs: int) -> None:
        if theirs != self.protocol:
            raise UmbraError(
                Code.VERSION_MISMATCH, f"client speaks {theirs}, daemon {self.protocol}"
            )

    def _reply(  # noqa: PLR0911, PLR0912  (a table of answers)
        self, request: Request
    ) -> tuple[replies.AnyReply, dict[str, Any]]:
        command = request.command
        tag = str(type(command).__struct_config__.tag)
        if tag in self.refuse:
            no = self.refuse[tag]
            raise UmbraError(no.code, no.message, no.where)
        match command:
            case commands.Hello():
                return replies.Welcome(
                    protocol=self.protocol,
                    server="0.0-fake",
                    rig="fake",
                    epoch=self.epoch,
                    role=Role.OPERATOR,
                    events=self.events.replace("127.0.0.1", "*"),
                    methods=("checkerboard",),
                    devices=("camera", "projector"),
                ), {}
            case commands.GetStatus():
                return self._status(), {}
            case commands.GetDevices():
                return replies.Devices(devices=()), {}
            case commands.Submit(spec=spec, by=by):
                return replies.Run(run=self._submitted(spec, by)), {}
            case commands.Reprocess(run=run, by=by):
                made = self._submitted(self._run(run).spec, by)
                made = self.runs[made.id] = msgspec.structs.replace(made, parents=(run,))
                return replies.Run(run=made), {}
            case commands.GetQueue() | commands.ListRuns() | commands.MoveQueued():
                return replies.Runs(runs=tuple(self.runs.values())), {}
            case commands.GetRun(run=run) | commands.Pause(run=run) | commands.Resume(run=run):
                return replies.Run(run=self._run(run)), {}
            case commands.Abort(run=run, by=by):
                info = self._run(run)
                end = End(state=RunState.ABORTED, reason=f"aborted by {by}", by=by)
                self.runs[info.id] = msgspec.structs.replace(info, state=end.state, end=end)
                return replies.Run(run=self.runs[info.id]), {}
            case commands.GetResult(run=run):
                info = self._run(run)
                final = info.state is RunState.DONE
                return replies.Result(run=info, final=final, facts={"images": 25}), self.arrays
            case commands.GetProduct(name=name, offset=offset, limit=limit):
                data = self.files[name]
                part = np.frombuffer(data[offset : offset + limit], np.uint8)
                product = Product(name=name, kind="image", file=name, bytes=len(data))
                reply = replies.ProductPart(product=product, offset=offset, size=len(data))
                return reply, {"data": part}
            case commands.GetLog():
                return replies.Log(records=({"event": "hello"},)), {}
            case commands.Draw():
                facts = {"images": 27, "lighting": "black"}
                return replies.Picture(facts=facts), {"png": np.zeros(8, np.uint8)}
            case commands.GetPreview() | commands.Snap():
                name = "preview" if isinstance(command, commands.GetPreview) else "frame"
                return replies.Picture(facts={"saturated": 0}), {
                    name: np.zeros((4, 4, 3), np.uint8)
                }
            case commands.SetCamera(settings=settings, auto_exposure=auto):
                facts = {"exposure_us": 400.0, "brightest": 0.55, "problem": "too dark"}
                return replies.Camera(settings=settings, facts=facts if auto else {}), {}
            case (
                commands.GetStage()
                | commands.StageHome()
                | commands.StageMove()
                | commands.StageCircle()
                | commands.StageStop()
                | commands.StageUnlock()
            ):
                return STAGE, {}
            case commands.Discover(drivers=drivers):
                return replies.Discovered(
                    searches=tuple(Search(kind="camera", driver=d) for d in drivers)
                ), {}
            case commands.Examine():
                return replies.Examined(checks=self.checks), {}
            case commands.Lock(lease_s=lease_s):
                self.lock = replies.Locked(token=uuid.uuid4().hex, lease_s=lease_s)
                return self.lock, {}
            case commands.RenewLock() | commands.Unlock():
                if self.lock is None or request.token != self.lock.token:
                    raise UmbraError(Code.LOCKED, "you don't hold the rig: lock it again")
                if isinstance(command, commands.Unlock):
                    self.lock = None
                else:
                    self.renewed.set()
                    return self.lock, {}
        return replies.Done(), {}

    def _submitted(self, spec: AnyScan, by: str) -> RunInfo:
        state = RunState.DONE if self.finish_on_submit else RunState.QUEUED
        info = RunInfo(
            id=f"run-{next(self._ids)}", state=state, spec=spec, submitted=UTC, by=by, planned=25
        )
        self.runs[info.id] = info
        return info

    def _run(self, run: str) -> RunInfo:
        found = self.runs.get(run) if run else next(reversed(self.runs.values()), None)
        if found is None:
            raise UmbraError(Code.UNKNOWN_RUN, f"there is no run {run!r}: see 'umbra runs'")
        return found

    def _status(self) -> replies.Status:
        return replies.Status(
            rig="fake",
            state=RigState.IDLE,
            epoch=self.epoch,
            uptime_s=1.0,
            devices=(),
            run=None,
            progress=None,
            queue=(),
            lock=None,
            free_bytes=1 << 30,
            reserve_bytes=0,
            sequences=dict(self.sequences),
        )


def _bound(socket: zmq.Socket[bytes]) -> str:
    return bytes(socket.getsockopt(zmq.LAST_ENDPOINT)).decode().rstrip("\0")


class _Allowed:
    """The allow-list, as pyzmq's authenticator asks for it."""

    def __init__(self, keys: list[bytes]) -> None:
        self.keys = keys

    def callback(self, _domain: str, key: bytes) -> bool:
        return key in self.keys
