"""Where a daemon is reached, and what a key may do there."""

from __future__ import annotations

import enum

DEFAULT_COMMAND = "tcp://127.0.0.1:5750"
DEFAULT_EVENTS = "tcp://127.0.0.1:5751"


class Role(enum.StrEnum):
    """What a key may do."""

    OBSERVER = "observer"  # read and subscribe
    OPERATOR = "operator"  # everything
