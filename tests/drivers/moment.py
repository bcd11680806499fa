"""What another thread does when its moment has come, however long that takes on a busy machine."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def once(true: Callable[[], bool], act: Callable[[], object]) -> Iterator[None]:
    """Within it `act` is done, once, as soon as something is true."""
    over = threading.Event()

    def wait() -> None:
        while not true():
            if over.wait(0.002):
                return
        act()

    thread = threading.Thread(target=wait)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def until(true: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until something is true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not come true in time"
        time.sleep(0.005)
