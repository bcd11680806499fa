"""Room on the disk for the run under way: a lack of it pauses the run, and ends nothing."""

from __future__ import annotations

import time

from daemon.exposing.control import Control
from daemon.storage.durable import StorageError
from daemon.storage.store import Store
from protocol.errors import Code, UmbraError

_LOOK_S = 1.0  # from one look at the disk to the next


class Room:
    """Pauses a run before the reserve is touched, or when the disk takes no more. `look` is for
    the sequencer's thread, `refused` for the recorder's, `require` for any."""

    def __init__(self, store: Store, control: Control) -> None:
        self._store = store
        self._control = control
        self._looked = 0.0
        self._lacking = False  # the pause is for lack of room

    def look(self) -> None:
        """Pause where there is no more than the reserve; called at each step, cheap."""
        now = time.monotonic()
        if now - self._looked < _LOOK_S:
            return
        self._looked = now
        if not self._control.paused and not self._store.room_for(0):
            self._lacking = True
            self._control.pause(self._problem())

    def refused(self, error: StorageError) -> str:
        """Pause, as the disk took no more, reserve or not; gives the reason."""
        reason = f"{error.message.partition(';')[0]}; free some, then `umbra resume`"
        self._lacking = True
        self._control.pause(reason)
        return reason

    def require(self) -> None:
        """The pause is to end. Raises UmbraError(storage_full) if there is still no room."""
        if self._lacking and not self._store.room_for(0):
            raise UmbraError(Code.STORAGE_FULL, self._problem())
        self._lacking = False

    def _problem(self) -> str:
        return (
            f"only {self._store.free_bytes() / 1e6:.0f} MB are free in {self._store.data}, less "
            "than the reserve: free some, then `umbra resume`"
        )
