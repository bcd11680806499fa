"""The command endpoint: ROUTER and ZAP; a request in, exactly one answer out.

Every request is answered from the loop. What is quick is done there; what touches a device or the
disk is done in a worker thread, so that no command blocks the loop. A command that changes
something is done once: its answer is remembered by the request's id, a repeat gets that answer,
and a repeat that comes while the first is under way waits for it.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import structlog
import zmq
import zmq.asyncio
from numpy.typing import NDArray

from daemon.runs.failures import as_error
from protocol import wire
from protocol.errors import Code, UmbraError
from protocol.messages.access import Role
from protocol.messages.commands import AnyCommand
from protocol.messages.envelopes import PROTOCOL, Preamble, Request, Response
from protocol.messages.replies import AnyReply

_REMEMBERED = 1024  # answers that a repeated request finds ...
_REMEMBERED_BYTES = 64 << 20  # ... of so many bytes together
_ID_LIMIT = 64  # characters of an id that is given back with an error

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Answer:
    """A reply with its arrays."""

    reply: AnyReply
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks: the key's role and name (an open loopback rig: operator, no name)."""

    role: Role = Role.OPERATOR
    name: str = ""


@dataclass(frozen=True, slots=True)
class Asked:
    """Who asked, under which request id, with which lock token."""

    caller: Caller
    request_id: str
    token: str


Handler = Callable[[AnyCommand, Caller, str, str], Awaitable[Answer]]
"""command, caller, request id, lock token -> answer; raises UmbraError, DeviceError."""

_Frames = list[bytes | memoryview]


class Server:
    """Reads requests, checks them, hands them on, answers."""

    def __init__(
        self,
        socket: zmq.asyncio.Socket,
        handle: Handler,
        caller_of: Callable[[zmq.Frame], Caller | None],
    ) -> None:
        self._socket = socket
        self._handle = handle
        self._caller_of = caller_of
        self._preamble = msgspec.json.Decoder(Preamble)
        self._request = msgspec.json.Decoder(Request)
        self._answers: OrderedDict[tuple[str, str], _Frames] = OrderedDict()
        self._answers_bytes = 0
        self._under_way: dict[tuple[str, str], asyncio.Task[_Frames]] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    async def serve(self) -> None:
        """Answer until cancelled."""
        while True:
            parts = await self._socket.recv_multipart(copy=False)
            task = asyncio.create_task(self._serve_one(parts))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _serve_one(self, parts: list[zmq.Frame]) -> None:
        if len(parts) < 2:
            return  # not even a header: nobody to answer
        try:
            caller = self._caller_of(parts[1])
        except UmbraError as error:
            log.warning("nobody can be known", error=error.message)
            return
        if caller is None:
            return  # a key that was revoked: strangers get no reply
        frames = await self._answer(bytes(parts[1].buffer), len(parts) - 2, caller)
        try:
            await self._socket.send_multipart([parts[0].bytes, *frames], copy=False)
        except zmq.ZMQError as error:  # the client has gone; its retry will find the answer
            log.debug("answer not delivered", error=str(error))

    async def _answer(self, header: bytes, buffers: int, caller: Caller) -> _Frames:
        request_id = ""
        try:
            preamble = wire.decode(self._preamble, header)
            request_id = preamble.id[:_ID_LIMIT]
            if preamble.protocol != PROTOCOL:
                raise UmbraError(  # noqa: TRY301 - every error takes the one way out
                    Code.VERSION_MISMATCH,
                    f"the client speaks protocol {preamble.protocol}, this daemon {PROTOCOL}: "
                    "install the same version of umbra-rig on both sides",
                    "$.protocol",
                )
            request = wire.decode(self._request, header)
            if len(request.arrays) != buffers:
                raise UmbraError(  # noqa: TRY301
                    Code.BAD_REQUEST,
                    f"{len(request.arrays)} arrays announced, {buffers} sent",
                    "$.arrays",
                )
            if request.command.role is Role.OPERATOR:
                if caller.role is not Role.OPERATOR:
                    raise UmbraError(  # noqa: TRY301
                        Code.FORBIDDEN, f"the key of {caller.name} is an observer's: it may not"
                    )
                return await self._once(request, caller)
            return await self._do(request, caller)
        except UmbraError as error:
            return wire.encode(Response(id=request_id, error=error.info))

    async def _once(self, request: Request, caller: Caller) -> _Frames:
        key = (caller.name, request.id)
        if (known := self._answers.get(key)) is not None:
            return known
        task = self._under_way.get(key)
        if task is None:
            task = asyncio.create_task(self._do(request, caller))
            self._under_way[key] = task
            task.add_done_callback(lambda done: self._remember(key, done))
        return await asyncio.shield(task)

    def _remember(self, key: tuple[str, str], done: asyncio.Task[_Frames]) -> None:
        self._under_way.pop(key, None)
        if done.cancelled() or done.exception() is not None:
            return
        frames = done.result()
        self._answers[key] = frames
        self._answers_bytes += sum(len(f) for f in frames)
        while len(self._answers) > _REMEMBERED or (
            self._answers_bytes > _REMEMBERED_BYTES and len(self._answers) > 1
        ):
            _, old = self._answers.popitem(last=False)
            self._answers_bytes -= sum(len(f) for f in old)

    async def _do(self, request: Request, caller: Caller) -> _Frames:
        try:
            answer = await self._handle(request.command, caller, request.id, request.token)
            response = Response(
                id=request.id, reply=answer.reply, arrays=wire.headers(answer.arrays)
            )
            return wire.encode(response, answer.arrays)
        except Exception as error:
            known = as_error(error)
            if known.code is Code.INTERNAL:
                log.exception("command failed", command=type(request.command).__name__)
            return wire.encode(Response(id=request.id, error=known.info))
