"""The headers in which commands, replies and events travel, and their version."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from protocol.errors import ErrorInfo
from protocol.messages.commands import AnyCommand
from protocol.messages.events import AnyEvent
from protocol.messages.replies import AnyReply

PROTOCOL = 1
"""The one version of everything in this package; both sides must have the same."""


JOINED = "joined/"
"""Topics with this prefix are answered, each with an event of that name and no header: what was
subscribed to before it is then known to the rig, and nothing that happens later is missed."""


class ArrayHeader(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One raw buffer that follows the header: C order, native little endian."""

    name: str
    dtype: str  # NumPy's: uint8, uint16, float32
    shape: tuple[int, ...]


class Preamble(Struct, frozen=True, kw_only=True):
    """The part of a request that every version can read: checked before the rest."""

    id: str = ""
    protocol: int = 0


class Request(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A request's header. The client makes `id`, at random: a repeat gets the first answer."""

    id: Annotated[str, Meta(min_length=8, max_length=64)]
    protocol: int
    command: AnyCommand
    token: str = ""  # of the lock, if the client holds it
    arrays: tuple[ArrayHeader, ...] = ()


class Response(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A response's header: a reply or an error, never both."""

    id: str
    reply: AnyReply | None = None
    error: ErrorInfo | None = None
    arrays: tuple[ArrayHeader, ...] = ()


class Event(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An event's header. `sequence` counts from 1 within topic and epoch, without gaps."""

    topic: str
    sequence: int
    epoch: str
    utc: str
    body: AnyEvent
    arrays: tuple[ArrayHeader, ...] = ()
