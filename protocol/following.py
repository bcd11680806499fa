"""How a run's progress is followed: snapshots, and the events after them."""

from __future__ import annotations

from protocol.messages import replies
from protocol.messages.envelopes import Event
from protocol.messages.events import Progressed, RunChanged
from protocol.messages.runs import Progress, RunInfo, RunState

SILENCE_S = 1.0
"""Without an event for so long the rig is asked: a daemon that is gone is noticed so."""


class Following:
    """What a run's progress is, from snapshots and events; it waits for nothing itself.

    A snapshot is due at first, after silence, and when an event says so: its sequence number is
    not the one after the last, or its epoch is another. Events that the snapshot already holds
    are passed over.
    """

    def __init__(self, run: str) -> None:
        self.run = run
        self.last: Progress | None = None
        self._epoch = ""
        self._held: dict[str, int] = {}  # topic -> the last event that is known of

    @property
    def ended(self) -> bool:
        """Whether there is nothing more to come."""
        return self.last is not None and self.last.state.ended

    def snapshot(self, status: replies.Status, info: RunInfo) -> Progress | None:
        """The progress as of a snapshot, if that is news; `info` is the younger of the two."""
        self._epoch, self._held = status.epoch, dict(status.sequences)
        for there in (status.progress, status.reprocessing):
            if there is not None and there.run == self.run and there.state == info.state:
                return self._news(there)
        return self._news(self._of(info))

    def outdated_by(self, event: Event) -> bool:
        """Whether an event shows that others were lost, or that the daemon has restarted."""
        lost = event.sequence > self._held.get(event.topic, 0) + 1
        return lost or event.epoch != self._epoch

    def event(self, event: Event) -> Progress | None:
        """The progress after an event, if that is news of this run."""
        if event.sequence <= self._held.get(event.topic, 0):
            return None
        self._held[event.topic] = event.sequence
        match event.body:
            case Progressed(progress=progress) if progress.run == self.run:
                return self._news(progress)
            case RunChanged(run=info) if info.id == self.run:
                return self._news(self._of(info))
        return None

    def _of(self, info: RunInfo) -> Progress:
        """A run's own figures; what only the daemon's progress knows is kept from the last one."""
        last = self.last
        return Progress(
            run=info.id,
            state=info.state,
            recorded=info.recorded,
            planned=info.planned,
            missing=info.missing,
            rejected=info.rejected,
            fraction=1.0 if info.state is RunState.DONE else last.fraction if last else None,
            rate_hz=last.rate_hz if last and not info.state.ended else 0.0,
            remaining_s=0.0 if info.state.ended else last.remaining_s if last else None,
            phase=info.end.reason if info.end else info.state.value,
            summary=last.summary if last else {},
        )

    def _news(self, progress: Progress) -> Progress | None:
        if progress == self.last:
            return None
        self.last = progress
        return progress
