"""The command endpoint: one answer a request, whatever is sent."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
import zmq
import zmq.asyncio

from daemon.serving.server import Answer, Caller, Server
from drivers.base.errors import DeviceLost
from protocol import wire
from protocol.errors import Code, UmbraError
from protocol.messages.access import Role
from protocol.messages.commands import Abort, AnyCommand, Dark, GetQueue, Hello, Snap
from protocol.messages.envelopes import PROTOCOL, Request
from protocol.messages.replies import Done, Picture


class Desk:
    """A server with a handler that counts, and a client's socket."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.gate = asyncio.Event()
        self.gate.set()
        self.caller = Caller(Role.OPERATOR, "ada")
        self.context = zmq.asyncio.Context()
        self.router = self.context.socket(zmq.ROUTER)
        self.router.bind("inproc://desk")
        self.client = self.context.socket(zmq.DEALER)
        self.client.connect("inproc://desk")
        self.task = asyncio.create_task(Server(self.router, self.handle, self.caller_of).serve())

    def caller_of(self, frame: zmq.Frame) -> Caller | None:
        return None if b"stranger" in frame.bytes else self.caller

    async def handle(
        self, command: AnyCommand, caller: Caller, request_id: str, token: str
    ) -> Answer:
        self.done.append(type(command).__name__)
        await self.gate.wait()
        if isinstance(command, Abort):
            raise UmbraError(Code.WRONG_STATE, "no run is under way")
        if isinstance(command, Hello):
            raise DeviceLost("camera", "grab", "it is gone", "check its cable")
        if isinstance(command, GetQueue):
            raise ZeroDivisionError
        if isinstance(command, Snap):
            return Answer(Picture(), {"frame": np.arange(6, dtype=np.uint16).reshape(2, 3)})
        return Answer(Done(message=str(len(self.done))))

    async def ask(self, *parts: bytes) -> dict[str, Any]:
        await self.client.send_multipart(list(parts))
        frames = await asyncio.wait_for(self.client.recv_multipart(), 5)
        return dict(json.loads(frames[0]))

    async def request(self, command: AnyCommand, request_id: str = "abcdefgh") -> dict[str, Any]:
        sent = Request(id=request_id, protocol=PROTOCOL, command=command)
        return await self.ask(bytes(wire.encode(sent)[0]))

    async def close(self) -> None:
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)
        self.context.destroy(linger=0)


@pytest.fixture
async def desk() -> AsyncIterator[Desk]:
    made = Desk()
    yield made
    await made.close()


async def test_a_repeat_gets_the_first_answer(desk: Desk) -> None:
    first = await desk.request(Dark())
    assert await desk.request(Dark()) == first
    assert await desk.request(Dark(), "another1") != first
    assert desk.done == ["Dark", "Dark"]


async def test_a_repeat_while_the_first_is_under_way_waits_for_it(desk: Desk) -> None:
    desk.gate.clear()
    sent = wire.encode(Request(id="abcdefgh", protocol=PROTOCOL, command=Dark()))
    for _ in range(3):
        await desk.client.send_multipart(sent)
    while not desk.done:
        await asyncio.sleep(0)
    desk.gate.set()
    answers = [await asyncio.wait_for(desk.client.recv_multipart(), 5) for _ in range(3)]
    assert desk.done == ["Dark"]
    assert answers[0] == answers[1] == answers[2]


async def test_an_error_is_remembered_too(desk: Desk) -> None:
    answer = await desk.request(Abort())
    assert answer["error"] == {
        "code": "wrong_state", "message": "no run is under way", "where": ""
    }  # fmt: skip
    await desk.request(Abort())
    assert desk.done == ["Abort"]


async def test_a_device_error_keeps_its_remedy(desk: Desk) -> None:
    answer = await desk.request(Hello())
    assert answer["error"]["code"] == "device_lost"
    assert answer["error"]["message"] == "camera: grab: it is gone; check its cable"


async def test_a_bug_is_an_answer_and_not_the_end(desk: Desk) -> None:
    answer = await desk.request(GetQueue())
    assert answer["error"]["code"] == "internal"
    assert (await desk.request(Dark()))["reply"]["type"] == "done"


async def test_another_version_is_told_both(desk: Desk) -> None:
    answer = await desk.ask(b'{"id":"abcdefgh","protocol":99,"command":{"type":"from-afar"}}')
    assert answer["error"]["code"] == "version_mismatch"
    assert f"protocol 99, this daemon {PROTOCOL}" in answer["error"]["message"]


@pytest.mark.parametrize(
    ("parts", "where"),
    [
        ([b""], ""),
        ([b"\x00\xff\xfe"], ""),
        ([b"[1,2,3]"], ""),
        ([b'{"id":"abcdefgh","protocol":1}'], ""),
        ([b'{"id":"abcdefgh","protocol":1,"command":{"type":"dark","x":1}}'], "$.command"),
        ([b'{"id":"short","protocol":1,"command":{"type":"dark"}}'], "$.id"),
        ([b'{"id":"abcdefgh","protocol":1,"command":{"type":"dark"}}', b"stray"], "$.arrays"),
        ([b"{" * 100_000], ""),
        ([b'{"id":"abcdefgh","protocol":1,"command":' + b"[" * 100_000], ""),
    ],
)
async def test_garbage_is_answered(desk: Desk, parts: list[bytes], where: str) -> None:
    answer = await desk.ask(*parts)
    assert answer["error"]["code"] == "bad_request"
    assert answer["error"]["where"] == where
    assert not desk.done


async def test_an_observer_may_look_only(desk: Desk) -> None:
    desk.caller = Caller(Role.OBSERVER, "bob")
    answer = await desk.request(Dark())
    assert answer["error"]["code"] == "forbidden"
    assert "bob" in answer["error"]["message"]
    assert not desk.done


async def test_a_stranger_gets_no_reply(desk: Desk) -> None:
    sent = Request(id="stranger", protocol=PROTOCOL, command=Dark())
    await desk.client.send_multipart(wire.encode(sent))
    answer = await desk.request(Dark())
    assert answer["id"] == "abcdefgh"
    assert desk.done == ["Dark"]


async def test_arrays_travel_as_they_are(desk: Desk) -> None:
    sent = wire.encode(Request(id="abcdefgh", protocol=PROTOCOL, command=Snap()))
    await desk.client.send_multipart(sent)
    header, frame = await asyncio.wait_for(desk.client.recv_multipart(), 5)
    assert json.loads(header)["arrays"] == [{"name": "frame", "dtype": "uint16", "shape": [2, 3]}]
    assert np.frombuffer(frame, np.uint16).tolist() == list(range(6))
