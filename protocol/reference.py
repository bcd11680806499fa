"""Writes docs/protocol.md from the structs: ``python -m protocol.reference > docs/protocol.md``.

What is said of a field is the comment beside it in the source, so there is one place to keep true.
"""

from __future__ import annotations

import ast
import enum
import functools
import inspect
import re
import sys
from collections.abc import Iterable, Iterator
from typing import Any, get_args

import msgspec
from msgspec import inspect as mi

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
from protocol.patterns import AnyBinary, AnyPattern, Axis
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

Struct = type[msgspec.Struct]

# ---------------------------------------------------------------- types in words


def _limits(kind: Any) -> str:
    said = []
    for name, sign in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<")):
        if (limit := getattr(kind, name, None)) is not None:
            said.append(f"{sign} {limit:g}" if limit < 1e6 else f"{sign} {limit}")
    low, high = getattr(kind, "min_length", None), getattr(kind, "max_length", None)
    if low is not None or high is not None:
        said.append(f"{low or 0} to {'any' if high is None else high} long")
    if pattern := getattr(kind, "pattern", None):
        said.append(f"matching `{pattern}`".replace("|", "\\|"))
    return f" {', '.join(said)}" if said else ""


_PLAIN = {
    mi.BoolType: "true or false",
    mi.NoneType: "null",
    mi.AnyType: "any value",
    mi.StrType: "text",
    mi.IntType: "integer",
    mi.FloatType: "number",
}


def _type(kind: mi.Type) -> str:  # noqa: PLR0911  (one case a kind of type)
    """A type as the tables name it."""
    match kind:
        case mi.Metadata(type=inner):
            return _type(inner)
        case mi.UnionType(types=types):
            structs = [t for t in types if isinstance(t, mi.StructType)]
            if len(structs) > 1:
                return _union(structs) + (" or null" if len(types) > len(structs) else "")
            return " or ".join(map(_type, types))
        case mi.StructType(cls=cls):
            return _link(cls)
        case mi.EnumType(cls=cls):
            return _link(cls)
        case mi.LiteralType(values=values):
            return " or ".join(f'`"{v}"`' for v in values)
        case mi.VarTupleType(item_type=item):
            return f"list of {_type(item)}"
        case mi.TupleType(item_types=items):
            return f"list of {len(items)}: {', '.join(map(_type, items))}"
        case mi.DictType(value_type=value):
            return f"object of {_type(value)}s" if type(value) is not mi.AnyType else "object"
        case _:
            return _PLAIN[type(kind)] + _limits(kind)


_UNIONS = {
    "any command": commands.AnyCommand,
    "any reply": replies.AnyReply,
    "any event": AnyEvent,
    "any scan": AnyScan,
    "any pattern": AnyPattern,
    "a two-valued pattern": AnyBinary,
}
_SECTIONS = {
    "any command": "commands",
    "any reply": "replies",
    "any event": "events",
    "any scan": "scans",
    "any pattern": "patterns",
    "a two-valued pattern": "patterns",
}


_STATES = (RunState, RigState, Health, StageState, Outcome, Role)
_FACTS: tuple[Struct, ...] = (
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


def _union(structs: list[mi.StructType]) -> str:
    members = {s.cls for s in structs}
    [name] = [name for name, union in _UNIONS.items() if set(get_args(union)) == members]
    return f"[{name}](#{_SECTIONS[name]})"


def _link(cls: type) -> str:
    return f"[{cls.__name__}](#{_anchor(_title(cls))})"


def _tag(cls: type) -> str:
    config = getattr(cls, "__struct_config__", None)
    return str(config.tag) if config and config.tag else ""


def _title(cls: type) -> str:
    """A heading; the same tag may name a command and its reply, so those say which they are."""
    if not _tag(cls):
        return cls.__name__
    return f"{cls.__name__}: `{_tag(cls)}`"


def _anchor(title: str) -> str:
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


# ---------------------------------------------------------------- comments in the source


@functools.cache
def _source(module: str) -> tuple[list[str], dict[str, ast.ClassDef]]:
    """A module's lines and classes."""
    text = inspect.getsource(sys.modules[module])
    classes = {n.name: n for n in ast.parse(text).body if isinstance(n, ast.ClassDef)}
    return text.splitlines(), classes


def _remarks(cls: type) -> dict[str, str]:
    """Field or member -> the comment beside it or, with ``#:``, above it; base classes too."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not base.__module__.startswith("protocol"):
            continue
        lines, classes = _source(base.__module__)
        for item in classes[base.__name__].body:
            match item:
                case ast.AnnAssign(target=ast.Name(id=name)):
                    pass
                case ast.Assign(targets=[ast.Name(id=name)]):
                    pass
                case _:
                    continue
            beside = lines[(item.end_lineno or item.lineno) - 1].partition("  # ")[2]
            above = lines[item.lineno - 2].strip()
            found[name] = beside or (above[2:].strip() if above.startswith("#:") else "")
    return found


def _doc(cls: type) -> str:
    text = inspect.cleandoc(cls.__doc__ or "")
    return re.sub(r"``(.+?)``", r"`\1`", text)


# ---------------------------------------------------------------- tables


def _described(kind: mi.Type) -> str:
    """What the type itself says of the field (Meta's description)."""
    match kind:
        case mi.Metadata(type=inner, extra_json_schema=schema):
            return str((schema or {}).get("description", "")) or _described(inner)
        case mi.UnionType(types=types):
            return next(filter(None, map(_described, types)), "")
        case _:
            return ""


def _default(field: mi.Field) -> str:
    if field.required:
        return "required"
    value = field.default
    if value is msgspec.NODEFAULT:
        value = field.default_factory()
    return f"`{msgspec.json.encode(value).decode()}`"


def _field_table(cls: Struct) -> Iterator[str]:
    info = mi.type_info(cls)
    assert isinstance(info, mi.StructType)
    remarks = _remarks(cls)
    if not info.fields:
        yield "No fields."
        return
    yield "| field | type | default | |"
    yield "| --- | --- | --- | --- |"
    for field in info.fields:
        said = (_described(field.type), remarks.get(field.name, ""))
        remark = "; ".join(filter(None, said)).replace("None:", "`null`:")
        yield f"| `{field.encode_name}` | {_type(field.type)} | {_default(field)} | {remark} |"


def _members(cls: type[enum.StrEnum]) -> Iterator[str]:
    remarks = _remarks(cls)
    yield "| value | |"
    yield "| --- | --- |"
    for member in cls:
        yield f"| `{member.value}` | {remarks.get(member.name, '')} |"


def _struct(cls: Struct, extra: str = "") -> Iterator[str]:
    yield f"### {_title(cls)}"
    yield ""
    yield _doc(cls)
    if extra:
        yield ""
        yield extra
    yield ""
    yield from _field_table(cls)
    yield ""


def _structs(union: Any) -> Iterator[str]:
    for cls in get_args(union):
        yield from _struct(cls)


def _enum(cls: type[enum.StrEnum]) -> Iterator[str]:
    yield f"### {_title(cls)}"
    yield ""
    doc = _doc(cls)
    if "──>" in doc:
        first, _, rest = doc.partition("\n\n")
        yield f"{first}\n\n```\n{rest}\n```"
    else:
        yield doc
    yield ""
    yield from _members(cls)
    yield ""


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
    yield from _struct(Request)
    yield from _struct(Response)
    yield from _struct(ArrayHeader)
    yield from _struct(Event)
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
        yield from _enum(states)
    yield "## Commands\n"
    yield "| command | least role | answer | |"
    yield "| --- | --- | --- | --- |"
    for command, reply in replies.ANSWERS.items():
        first = _doc(command).partition("\n")[0]
        name = f"[`{_tag(command)}`](#{_anchor(_title(command))})"
        yield f"| {name} | {command.role.value} | {_link(reply)} | {first} |"
    yield ""
    yield "Each has a field `type`, its name.\n"
    for command, reply in replies.ANSWERS.items():
        yield from _struct(command, f"For: {command.role.value}. Answer: {_link(reply)}.")
    yield "## Replies\n\nEach has a field `type`, its name.\n"
    yield from _structs(replies.AnyReply)
    yield "## Events\n\nThe `body` of an event; each has a field `type`, its name.\n"
    for cls in get_args(AnyEvent):
        yield from _struct(cls, f"Topic: `{cls.topic}`.")
    yield "## Scans\n\nThe `spec` of `submit`; a field `method` says which.\n"
    yield from _structs(AnyScan)
    yield "## Patterns\n\nWhat `show` shows; a field `pattern` says which.\n"
    yield from _structs(AnyPattern)
    yield "## Facts\n\nParts of the above.\n"
    for fact in _FACTS:
        yield from _struct(fact)
    for choices in _CHOICES:
        yield from _enum(choices)
    yield "## Errors\n"
    yield from _struct(ErrorInfo)
    yield from _enum(Code)
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
