"""Writes docs/protocol.md from the structs: ``python -m protocol.reference > docs/protocol.md``.

The page is put together here; `protocol.tables` puts structs and enums into words.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import get_args

from protocol import tables
from protocol.connection import ATTEMPTS, EVENTS_HWM, PREVIEWS_HWM
from protocol.errors import Code, ErrorInfo
from protocol.following import SILENCE_S
from protocol.messages import commands, replies
from protocol.messages.access import DEFAULT_COMMAND, DEFAULT_EVENTS, Role
from protocol.messages.envelopes import JOINED, PROTOCOL, ArrayHeader, Event, Request, Response
from protocol.messages.events import AnyEvent
from protocol.messages.findings import Check, Found, Outcome, Search
from protocol.messages.rig import CameraSettings, DeviceInfo, Health, LockInfo, RigState, StageState
from protocol.messages.runs import End, Product, Progress, RunInfo, RunState, Waiting
from protocol.patterns import AnyPattern, Axis
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import Grid
from protocol.scans.spec import Radiometry, Ready, Reference
from protocol.scans.verifications import Point
from protocol.wire import encode

CLIENT = """\
import json, sys, uuid, zmq


def ask(command, attempts=3, wait_ms=5000):
    request = {"id": uuid.uuid4().hex, "protocol": 1, "command": command}
    for _ in range(attempts):  # the same id each time: a repeat is answered, never done again
        commands.send_json(request)
        while commands.poll(wait_ms):
            header, *buffers = commands.recv_multipart()
            response = json.loads(header)
            if response["id"] == request["id"]:
                return response["reply"] or sys.exit(response["error"]["message"]), {
                    a["name"]: memoryview(b).cast(FORMAT[a["dtype"]], a["shape"])
                    for a, b in zip(response["arrays"], buffers)
                }
    sys.exit("no answer: is umbrad running?")


FORMAT = {"uint8": "B", "uint16": "H", "float32": "f", "bool": "?"}
commands, events = (zmq.Context.instance().socket(kind) for kind in (zmq.DEALER, zmq.SUB))
commands.connect(sys.argv[1])
welcome, _ = ask({"type": "hello", "client": "thirty lines"})
events.subscribe("run")
events.connect(welcome["events"].replace("*", sys.argv[1].split("/")[2].rpartition(":")[0]))
run = ask({"type": "submit", "spec": {"method": "checkerboard"}})[0]["run"]
while run["state"] not in {"done", "aborted", "failed", "interrupted"}:
    events.poll(1000) and events.recv_multipart()  # some run has changed: ask
    run = ask({"type": "run", "run": run["id"]})[0]["run"]
direct = ask({"type": "result", "run": run["id"]})[1]["direct"]
print(run["state"], direct.shape, "brightest", max(memoryview(direct.tobytes()).cast("f")))
"""

_STATES = (RunState, RigState, Health, StageState, Outcome, Role)
_FACTS: tuple[tables.Struct, ...] = (
    DeviceInfo,
    Product,
    End,
    RunInfo,
    Waiting,
    Progress,
    LockInfo,
    CameraSettings,
    Found,
    Search,
    Check,
    Radiometry,
    Ready,
    Point,
)
"""What is in others and has no section of its own."""
_CHOICES = (Reference, Grid, Axis)


# ---------------------------------------------------------------- the page


def _example() -> str:
    request = Request(id="5f3a9c1e", protocol=PROTOCOL, command=commands.Hello(client="me"))
    return bytes(encode(request)[0]).decode()


def page() -> str:
    """The whole of docs/protocol.md."""
    lines = "\n".join(_page()).splitlines()
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _page() -> Iterable[str]:
    yield f"""\
# Umbra's protocol, version {PROTOCOL}

<!-- Made by `python -m protocol.reference > docs/protocol.md`. Don't edit: change the structs. -->

Everything that travels between a client and `umbrad`. Any language with ZeroMQ and JSON can speak
it: [thirty lines](#thirty-lines) are enough for a scan.

## Endpoints

| endpoint | default | daemon | client |
| --- | --- | --- | --- |
| command | `{DEFAULT_COMMAND}` | ROUTER | DEALER, never REQ |
| events | `{DEFAULT_EVENTS}` | XPUB | SUB, by [topic](#events) |

`ipc://` works for both. The events endpoint is in the answer to `hello`; where its host is `*` or
`0.0.0.0`, it is the host that was reached. Off loopback both are CURVE sockets: see [keys](#keys).

## Framing

```
client -> daemon    [header, buffer...]
daemon -> client    [header, buffer...]
events              [topic, header, buffer...]
```

A header is JSON in UTF-8. Each entry of its `arrays` announces one buffer, in order: the array's
memory in C order, little endian, as `uint8`, `uint16`, `float32` or `bool`. There is no empty
delimiter frame. Unknown fields and values out of range are refused with the path of the field.

```json
{_example()}
```

"""
    yield from tables.struct(Request)
    yield from tables.struct(Response)
    yield from tables.struct(ArrayHeader)
    yield from tables.struct(Event)
    yield f"""\
## Requests

- `hello` comes first: its answer names the version, the rig, its methods, and your role. Each
  request carries the version too; a daemon of another version answers `version_mismatch`.
- The client makes the `id`, at random. A request without an answer is sent again **with the same
  id**: the daemon remembers recent ids, joins a repeat to work under way, and answers it with the
  first answer; nothing is done twice. Umbra's own clients send at most {ATTEMPTS} times, each on a
  fresh socket, and take a late answer on an earlier one; then the error is `unreachable`.
- Answers may come in another order than requests: match them by `id`, and pass over the rest.
- No command takes long: a scan answers with its run at once, and the run goes on without you.
- A *lock* keeps others' hands off; its `token` goes with every request of its holder.

## Events in practice

Each topic counts its events from 1, anew in each `epoch` (a start of the daemon). Subscribe, then
ask for `status`: its `sequences` say which events it already holds. A subscription takes a moment
to arrive: subscribe last to a topic of your own that begins with `{JOINED}`, and an event of that
name, one frame without a header, tells that the rig knows them all. A number that is not the next,
or another epoch, means that something was missed: ask again. A subscriber that is slow loses
events and never slows the rig. Umbra's own clients let {EVENTS_HWM} events wait, and on a socket of
their own {PREVIEWS_HWM} previews; they ask when they have heard nothing for {SILENCE_S:g} s.

## States

"""
    for states in _STATES:
        yield from tables.choices(states)
    yield "## Commands\n"
    yield "| command | least role | answer | |"
    yield "| --- | --- | --- | --- |"
    for command, reply in replies.ANSWERS.items():
        name, answer = tables.tag_link(command), tables.link(reply)
        yield f"| {name} | {command.role.value} | {answer} | {tables.summary(command)} |"
    yield ""
    yield "Each has a field `type`, its name.\n"
    for command, reply in replies.ANSWERS.items():
        said = f"For: {command.role.value}. Answer: {tables.link(reply)}."
        yield from tables.struct(command, said)
    yield "## Replies\n\nEach has a field `type`, its name.\n"
    yield from tables.structs(replies.AnyReply)
    yield "## Events\n\nThe `body` of an event; each has a field `type`, its name.\n"
    for cls in get_args(AnyEvent):
        yield from tables.struct(cls, f"Topic: `{cls.topic}`.")
    yield "## Scans\n\nThe `spec` of `submit`; a field `method` says which.\n"
    yield from tables.structs(AnyScan)
    yield "## Patterns\n\nWhat `show` shows; a field `pattern` says which.\n"
    yield from tables.structs(AnyPattern)
    yield "## Facts\n\nParts of the above.\n"
    for fact in _FACTS:
        yield from tables.struct(fact)
    for choices in _CHOICES:
        yield from tables.choices(choices)
    yield "## Errors\n"
    yield from tables.struct(ErrorInfo)
    yield from tables.choices(Code)
    yield """\
## Keys

Off loopback the daemon binds CURVE sockets with an allow-list, and answers no one else at all. Make
a pair with `umbra keys new`, have the public half allowed with `umbra keys authorize`, and set
`curve_publickey`, `curve_secretkey` and the rig's `curve_serverkey` on both sockets before they
connect. The files are ZeroMQ certificates. An *observer* reads and subscribes; an *operator* does
everything.

## Thirty lines

A scan from `hello` to the direct light, in Python with nothing but pyzmq and json:
`python thirty.py tcp://127.0.0.1:5750`.

```python"""
    yield CLIENT + "```"


if __name__ == "__main__":
    sys.stdout.write(page())
