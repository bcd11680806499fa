"""Events on the PUB endpoint: numbered within their topic, dropped for slow subscribers only."""

from __future__ import annotations

from collections import Counter
from typing import Any

import structlog
import zmq
from numpy.typing import NDArray

from daemon.runs.ending import utc_now
from protocol import wire
from protocol.messages.envelopes import Event
from protocol.messages.events import AnyEvent

HIGH_WATER = 200
"""Events that may wait for one subscriber; beyond that it misses some, and sees it by the gap."""

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
        except zmq.Again:  # PUB drops by itself; this is a socket that is closing
            log.debug("event dropped", topic=topic)

    def sequences(self) -> dict[str, int]:
        """The number of the last event of each topic: what a snapshot is as of."""
        return dict(self._counters)
