"""A virtual rig of few pixels, with its device threads, and nothing of the daemon above it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from daemon import config
from daemon.devices.rig import Rig

_RIG = """
[rig]
time_scale = {time_scale}
[projector]
driver = "virtual"
width = 64
height = 48
[camera]
driver = "virtual"
width = 64
height = 48
{camera}
{more}
"""


@contextmanager
def small_rig(*, time_scale: float, camera: str = "", more: str = "") -> Iterator[Rig]:
    """Connected; `camera` are more of its keys, `more` further tables of rig.toml."""
    written = _RIG.format(time_scale=time_scale, camera=camera, more=more)
    rig = Rig(config.parse(written, "test"), lambda _: None)
    rig.connect()
    try:
        yield rig
    finally:
        rig.close()
