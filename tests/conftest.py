"""The surroundings of all tests: the same from a terminal, in the background, on a busy host."""

from __future__ import annotations

import os
import signal
import sys

import pytest
from hypothesis import HealthCheck, settings

# As many processes as cores run tests, and some start daemons: threads of a linear algebra
# library would spin for cores that others need. Read where NumPy is first imported, here or there.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Containers often forbid bytecode; every process that a test starts would compile all of Umbra anew
# then, which takes longer than most tests of one.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

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
