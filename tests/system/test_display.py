"""A daemon whose projector is on an X server, and what is left of it when that server ends."""

from __future__ import annotations

import subprocess

import pytest

import umbra
from protocol.errors import UmbraError
from protocol.messages.rig import Health
from tests.drivers.xserver import xvfb
from tests.system.harness import Daemon, until

pytest.importorskip("pygame", reason="needs the extra: pip install 'umbra-rig[display]'")
pytestmark = pytest.mark.system


def health(rig: umbra.Client) -> Health:
    (projector,) = [d for d in rig.status().devices if d.name == "projector"]
    return projector.health


def test_the_daemon_outlives_the_x_server_and_uses_the_next(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SDL_VIDEODRIVER", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    text = daemon.config.read_text().replace("time_scale = 4", "")
    virtual = '[projector]\ndriver = "virtual"\nwidth = 128\nheight = 96\n'
    assert virtual in text
    daemon.config.write_text(
        text.replace(virtual, '[projector]\ndriver = "display"\nlatency_frames = 1\n')
    )
    with xvfb(320, 240) as screen:
        monkeypatch.setenv("DISPLAY", screen)
        rig = daemon.start()
        rig.show(umbra.WHITE)
        assert health(rig) is Health.READY
    try:
        with pytest.raises(UmbraError, match="projector"):
            rig.show(umbra.WHITE)
        until(lambda: health(rig) is Health.LOST)
        again = subprocess.Popen(
            ["Xvfb", screen, "-screen", "0", "320x240x24", "-nolisten", "tcp", "-noreset"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            until(lambda: health(rig) is Health.READY, 40)
            rig.show(umbra.WHITE)
            rig.close()
            assert daemon.stop() == 0
        finally:
            again.terminate()
            again.wait(60)
    finally:
        rig.close()
