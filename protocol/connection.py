"""How a client reaches a rig: endpoints, sockets, one exchange at a time, the event stream.

Nothing here waits: both clients share these decisions and differ only in how they wait.

Retry policy. The client makes the id of a request. When no answer has come in a third of the
time-out, the *same* message, with the same id, is sent again on a fresh socket, up to `ATTEMPTS`
times in all; the daemon remembers ids, so that a repeat is answered and never carried out twice.
The sockets of earlier attempts stay open until the exchange is over: a late answer counts. After
the last attempt the error is UNREACHABLE.
"""

from __future__ import annotations

import contextlib
import getpass
import logging
import os
import re
import socket as network
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar

import msgspec
import zmq

from protocol.errors import Code, UmbraError
from protocol.keys import ClientKeys
from protocol.messages.access import DEFAULT_COMMAND
from protocol.messages.commands import AnyCommand
from protocol.messages.envelopes import JOINED, PROTOCOL, Event, Request, Response
from protocol.messages.events import AnyEvent, Logged, PreviewTaken
from protocol.messages.replies import AnyReply, Reply, Welcome
from protocol.wire import MOST_BYTES, Arrays, arrays_of, decode, encode

if TYPE_CHECKING:
    from numpy.typing import NDArray

ATTEMPTS = 3
"""How often a request is sent at most."""

EVENTS_HWM = 1000
"""Events that wait for a slow reader; beyond, they are lost and show as a gap."""

PREVIEWS_HWM = 4
"""Previews that wait for a slow reader; beyond, they are lost. Only the newest is handed on."""

_LOOPBACK = re.compile(r"localhost|127(\.\d+){3}|\[::1\]")

log = logging.getLogger("umbra")

GivenKeys: TypeAlias = ClientKeys | Path | str | Literal[False] | None
"""A client's keys or their folder; None: see `ClientKeys.default`; False: none at all."""

T = TypeVar("T")
R = TypeVar("R", bound=Reply)
S = TypeVar("S", bound="zmq.Socket[Any]")
_responses = msgspec.json.Decoder(Response)
_events = msgspec.json.Decoder(Event)


class _Glance(msgspec.Struct):
    """What can be read of any version's response."""

    id: str = ""
    reply: msgspec.Raw = msgspec.Raw(b"null")


class _Versions(msgspec.Struct):
    """What can be read of any version's welcome."""

    protocol: int = PROTOCOL
    server: str = "?"


_glances = msgspec.json.Decoder(_Glance)

# ---------------------------------------------------------------- where


def chosen_endpoint(endpoint: str | None) -> str:
    """The endpoint given, or UMBRA_RIG's, or the default. Raises UmbraError(bad_request)."""
    chosen = endpoint or os.environ.get("UMBRA_RIG") or DEFAULT_COMMAND
    scheme, _, rest = chosen.partition("://")
    port = rest.rpartition(":")[2]
    if not rest or scheme not in {"tcp", "ipc"} or (scheme == "tcp" and not port.isdigit()):
        raise UmbraError(
            Code.BAD_REQUEST,
            f"{chosen!r} is not a rig's endpoint: write tcp://HOST:PORT or ipc://PATH",
        )
    return chosen


def is_local(endpoint: str) -> bool:
    """Whether an endpoint is on this machine and cannot be reached from another."""
    scheme, _, rest = endpoint.partition("://")
    host = rest.rpartition(":")[0]
    return scheme == "ipc" or _LOOPBACK.fullmatch(host) is not None


def chosen_keys(keys: GivenKeys, endpoint: str) -> ClientKeys | None:
    """The keys given, or read from the folder given, or the default ones; False: none at all."""
    if keys is False:
        return None
    if isinstance(keys, str | Path):
        return ClientKeys.load(keys)
    return keys or ClientKeys.default(local=is_local(endpoint))


def own_name() -> str:
    """Who asks, for the rig's records: user@host."""
    try:
        return f"{getpass.getuser()}@{network.gethostname()}"
    except (KeyError, OSError):  # no such user: a container with a bare number
        return network.gethostname()


def events_endpoint(welcome: Welcome, reached: str) -> str:
    """Where this rig's events are for this client: a wildcard host is the one that was reached."""
    scheme, _, rest = welcome.events.partition("://")
    host, _, port = rest.rpartition(":")
    if scheme == "tcp" and host in {"*", "0.0.0.0", "[::]"} and reached.startswith("tcp://"):
        return f"{reached.rpartition(':')[0]}:{port}"
    return welcome.events


def unreachable(endpoint: str, timeout_s: float, keys: ClientKeys | None) -> UmbraError:
    """The error after the last attempt: what to do, in one line."""
    message = (
        f"no answer from {endpoint} in {timeout_s:g} s: is umbrad running? "
        "start it with 'umbrad', or name another rig with --rig / UMBRA_RIG"
    )
    if keys is not None:
        message += f"; a rig doesn't answer keys it doesn't allow (here: {keys.name}, {keys.where})"
    elif not is_local(endpoint):
        message += "; a rig beyond this machine answers allowed keys only: see 'umbra keys --help'"
    return UmbraError(Code.UNREACHABLE, message)


def deaf(endpoint: str, timeout_s: float) -> UmbraError:
    """The error where the rig answers, and its events don't come."""
    return UmbraError(
        Code.UNREACHABLE,
        f"the rig answers, but no events came from {endpoint} in {timeout_s:g} s: "
        "is that port open between here and there?",
    )


# ---------------------------------------------------------------- sockets


def _secure(socket: zmq.Socket[Any], keys: ClientKeys | None) -> None:
    if keys is not None:
        socket.curve_publickey = keys.public
        socket.curve_secretkey = keys.secret
        socket.curve_serverkey = keys.server


def dealer(context: zmq.Context[S], endpoint: str, keys: ClientKeys | None) -> S:
    """A socket for requests: it holds nothing back for a peer that isn't there."""
    socket = context.socket(zmq.DEALER)
    socket.linger = 0
    socket.immediate = True  # don't queue for a connection that was never made
    socket.ipv6 = "[" in endpoint
    _secure(socket, keys)
    socket.connect(endpoint)
    return socket


def subscriber(
    context: zmq.Context[S],
    endpoint: str,
    keys: ClientKeys | None,
    topics: Sequence[str],
    hwm: int,
) -> S:
    """A socket for events, with a bounded queue; the rig says when it has joined (see Inbox)."""
    socket = context.socket(zmq.SUB)
    socket.linger = 0
    socket.rcvhwm = hwm
    socket.ipv6 = "[" in endpoint
    _secure(socket, keys)
    for topic in (*topics, f"{JOINED}{uuid.uuid4().hex}"):
        socket.subscribe(topic)
    socket.connect(endpoint)
    return socket


# ---------------------------------------------------------------- request and answer


class Answer(NamedTuple):
    """A reply with its arrays."""

    reply: AnyReply
    arrays: Arrays

    def array(self, name: str, dtype: str = "") -> NDArray[Any]:
        """The array of this name. Raises UmbraError(internal) where there is none such."""
        found = self.arrays.get(name)
        if found is None or (dtype and found.dtype.name != dtype):
            raise UmbraError(Code.INTERNAL, f"the daemon's answer has no {dtype} array {name!r}")
        return found


@dataclass(frozen=True)
class Ask(Generic[T]):
    """A command, and how its answer becomes what the caller wants."""

    command: AnyCommand
    value: Callable[[Answer], T]
    timeout_s: float = 0.0  # at least this long, where the work itself takes time


def expect(reply: AnyReply, kind: type[R]) -> R:
    """The reply, which must be of this kind. Raises UmbraError(internal)."""
    if not isinstance(reply, kind):
        raise UmbraError(
            Code.INTERNAL, f"the daemon answered with {type(reply).__name__}, not {kind.__name__}"
        )
    return reply


class Exchange(Generic[T]):
    """One request until it is answered."""

    def __init__(self, ask: Ask[T], token: str = "") -> None:
        self.id = uuid.uuid4().hex
        self._ask = ask
        self.message = encode(
            Request(id=self.id, protocol=PROTOCOL, command=ask.command, token=token)
        )
        if (size := len(self.message[0])) > MOST_BYTES:
            raise UmbraError(
                Code.BAD_REQUEST,
                f"the request has {size / 1e6:.1f} MB, at most {MOST_BYTES / 1e6:.1f} are taken",
            )

    def value(self, frames: Sequence[zmq.Frame]) -> T:
        """What this response, which must be the one of this id, says.

        Raises the UmbraError in it; or version_mismatch or internal where it can't be read.
        """
        try:
            response = decode(_responses, frames[0].buffer)
            arrays = arrays_of(response.arrays, [frame.buffer for frame in frames[1:]])
        except UmbraError as error:
            with contextlib.suppress(msgspec.DecodeError):
                reply = _glances.decode(frames[0].buffer).reply
                their = msgspec.json.decode(reply, type=_Versions)
                if their.protocol != PROTOCOL:
                    raise mismatch(their.protocol, their.server) from error
            raise UmbraError(
                Code.INTERNAL, f"the daemon's answer can't be read: {error}", error.where
            ) from error
        if response.error is not None:
            raise UmbraError(response.error.code, response.error.message, response.error.where)
        if response.reply is None:
            raise UmbraError(Code.INTERNAL, "the daemon's answer holds neither reply nor error")
        return self._ask.value(Answer(response.reply, arrays))


def id_of(frames: Sequence[zmq.Frame]) -> str:
    """The id that a message answers; "" (and a log record) where it cannot be read."""
    try:
        return _glances.decode(frames[0].buffer).id
    except msgspec.DecodeError as error:
        log.warning("ignored a message that is no response: %s", error)
        return ""


def mismatch(theirs: object, server: object) -> UmbraError:
    """The error where client and daemon speak different versions."""
    return UmbraError(
        Code.VERSION_MISMATCH,
        f"this client speaks protocol {PROTOCOL}, the daemon (umbrad {server}) protocol {theirs}: "
        "install the same version of umbra-rig on both sides",
    )


def checked(welcome: Welcome) -> Welcome:
    """The welcome, if both sides speak the same version. Raises UmbraError(version_mismatch)."""
    if welcome.protocol != PROTOCOL:
        raise mismatch(welcome.protocol, welcome.server)
    return welcome


# ---------------------------------------------------------------- events


@dataclass(frozen=True, eq=False)
class Notice:
    """An event as a subscriber gets it.

    `gap` says that events of its topic were lost before it, or that the daemon has restarted: what
    the subscriber knows may be out of date, `status` has the present state.
    """

    event: Event
    arrays: Arrays
    gap: bool

    @property
    def body(self) -> AnyEvent:
        """What happened."""
        return self.event.body


class Inbox:
    """Messages from the event sockets become notices: gaps are marked, old previews dropped.

    `joined` are the sockets that the rig has heard of, each by a topic of its own.
    """

    def __init__(self) -> None:
        self.joined: set[bytes] = set()
        self._last: dict[str, int] = {}
        self._epoch = ""

    def take(self, messages: Sequence[Sequence[zmq.Frame]]) -> list[Notice]:
        """The notices of these messages, in order; of the previews only the newest of each kind."""
        notices = [n for n in map(self._notice, messages) if n is not None]
        newest = {(n.body.run, n.body.what): n for n in notices if isinstance(n.body, PreviewTaken)}
        return [
            n
            for n in notices
            if not isinstance(n.body, PreviewTaken) or newest[n.body.run, n.body.what] is n
        ]

    def _notice(self, frames: Sequence[zmq.Frame]) -> Notice | None:
        if frames[0].bytes.startswith(JOINED.encode()):
            self.joined.add(frames[0].bytes)
            return None
        try:
            event = decode(_events, frames[1].buffer if len(frames) > 1 else b"")
            arrays = arrays_of(event.arrays, [frame.buffer for frame in frames[2:]])
        except UmbraError as error:
            log.warning("ignored a message that is no event: %s", error)
            return None
        restarted = self._epoch not in {"", event.epoch}
        if restarted:
            self._last.clear()
        self._epoch = event.epoch
        last = self._last.get(event.topic)
        self._last[event.topic] = event.sequence
        gap = restarted or (last is not None and event.sequence != last + 1)
        return Notice(event, arrays, gap)


def split_topics(topics: Sequence[str]) -> list[tuple[list[str], int]]:
    """The subscriptions to make: previews apart, so that they can't crowd out what counts. Without
    topics all but previews and the log."""
    asked_for = {PreviewTaken, Logged}
    wanted = list(topics) or [kind.topic for kind in AnyEvent.__args__ if kind not in asked_for]
    states = [t for t in wanted if t != PreviewTaken.topic]
    previews = [t for t in wanted if t == PreviewTaken.topic]
    return [(t, n) for t, n in ((states, EVENTS_HWM), (previews, PREVIEWS_HWM)) if t]
