"""Events on the XPUB endpoint: numbered within their topic, dropped for slow subscribers only."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Iterator
from typing import Any

import structlog
import zmq
from numpy.typing import NDArray

from daemon.runs.ending import utc_now
from protocol import wire
from protocol.messages.envelopes import JOINED, Event
from protocol.messages.events import AnyEvent

HIGH_WATER = 200
"""Events that may wait for one subscriber; beyond that it misses some, and sees it by the gap."""

_JOINING = b"\1" + JOINED.encode()
_LONGEST = 80
"""Bytes of a subscription that is answered; Umbra's own have 40."""

log = structlog.get_logger(__name__)


class Publisher:
    """Numbers and sends events; used from the loop's thread only."""

    def __init__(self, socket: zmq.Socket[bytes], epoch: str) -> None:
        self._socket = socket
        self._epoch = epoch
        self._counters: Counter[str] = Counter()

    def publish(self, body: AnyEvent, **arrays: NDArray[Any]) -> None:
        """Send an event to whoever listens. Never waits; never sent twice."""
        topic = body.topic
        self._counters[topic] += 1
        header = Event(
            topic=topic,
            sequence=self._counters[topic],
            epoch=self._epoch,
            utc=utc_now(),
            body=body,
            arrays=wire.headers(arrays),
        )
        try:
            self._socket.send_multipart(
                [topic.encode(), *wire.encode(header, arrays)], zmq.NOBLOCK, copy=not arrays
            )
        except zmq.Again:  # XPUB drops by itself; this is a socket that is closing
            log.debug("event dropped", topic=topic)
        self._admit()  # sending may have used up the sign that there are subscriptions to read

    @contextlib.contextmanager
    def admitting(self, loop: asyncio.AbstractEventLoop) -> Iterator[None]:
        """Tell those who ask that their subscriptions are known, from this loop."""
        door = self._socket.FD
        loop.add_reader(door, self._admit)
        try:
            yield
        finally:
            loop.remove_reader(door)

    def _admit(self) -> None:
        with contextlib.suppress(zmq.Again):
            while True:
                subscription = self._socket.recv(zmq.NOBLOCK)
                if subscription.startswith(_JOINING) and len(subscription) <= _LONGEST:
                    self._socket.send(subscription[1:], zmq.NOBLOCK)

    def sequences(self) -> dict[str, int]:
        """The number of the last event of each topic: what a snapshot is as of."""
        return dict(self._counters)
