"""The surroundings of all tests: the same from a terminal, in the background, on a busy host."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# As many processes as cores run tests, and some start daemons: threads of a linear algebra
# library would spin for cores that others need. Read where NumPy is first imported, here or there.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Containers often forbid bytecode; every process that a test starts would compile all of Umbra anew
# then, which takes longer than most tests of one.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What is committed is fsynced, a thousand times a minute here: milliseconds on a disk, nothing in
# memory, where there is room and a test may build a program.
_MEMORY = Path("/dev/shm")
if os.access(_MEMORY, os.W_OK):
    _facts = os.statvfs(_MEMORY)
    if _facts.f_bavail * _facts.f_frsize > 4 << 30 and not _facts.f_flag & os.ST_NOEXEC:
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))

# The same examples each time, and as slow as the machine is: a test fails for what it has found.
settings.register_profile(
    "umbra",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("umbra")


def pytest_runtest_setup() -> None:
    """Hear Ctrl-C: what a shell starts in the background ignores it, and so do its children; and a
    GenTL library that a test before has loaded puts a handler of its own below Python's."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of real processes first: they are the longest, and a worker at the end has short ones
    to share out (`make test` keeps this order)."""
    items.sort(key=lambda item: item.get_closest_marker("system") is None)
