"""The display projector: a window in a process of its own, that X servers and signals may end."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.device import Context
from drivers.base.errors import DeviceLost, DeviceRefused
from tests.drivers.xserver import screenshot, xvfb

pytest.importorskip("pygame", reason="needs the extra: pip install 'umbra-rig[display]'")

from drivers import display
from drivers.display import DisplayProjector
from drivers.registry import build

WIDTH, HEIGHT = 320, 240


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., DisplayProjector]]:
    for name in ("SDL_VIDEODRIVER", "WAYLAND_DISPLAY", "DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    devices: list[DisplayProjector] = []

    def make(screen: str = "", **options: Any) -> DisplayProjector:
        if screen:
            monkeypatch.setenv("DISPLAY", screen)
        device = build("projector", "display", "projector", options, Context())
        assert isinstance(device, DisplayProjector)
        devices.append(device)
        return device

    yield make
    for device in devices:
        device.close()


def noise(*shape: int) -> NDArray[np.uint8]:
    return np.random.default_rng(5).integers(0, 256, shape, np.uint8)


def flips(projector: DisplayProjector) -> list[int]:
    return [projector.show(noise(HEIGHT, WIDTH)) for _ in range(100)]


def test_pictures_reach_the_screen_through_its_process(
    make: Callable[..., DisplayProjector],
) -> None:
    with xvfb(WIDTH, HEIGHT) as screen:
        projector = make(screen, latency_frames=2)
        identity = projector.connect()
        assert f"{WIDTH}x{HEIGHT}" in identity.model
        info = projector.info()
        assert (info.width, info.height) == (WIDTH, HEIGHT)
        assert info.latency_s == pytest.approx(2 / info.refresh_hz)
        assert projector.facts()["video_driver"] == "x11"
        assert "assumed_latency_s" not in projector.facts()
        for image in (noise(HEIGHT, WIDTH), noise(WIDTH, HEIGHT).T, noise(HEIGHT, WIDTH, 3)):
            before = projector.clock.now_ns()
            lit = projector.show(image) - round(info.latency_s * 1e9)
            assert before <= lit <= projector.clock.now_ns()
            seen = image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)
            np.testing.assert_array_equal(screenshot(screen), seen)
        projector.check()
        with pytest.raises(DeviceRefused, match=r"projector: show: .*draw it for the size in info"):
            projector.show(noise(HEIGHT, WIDTH + 1))
        projector.safe()
        assert not screenshot(screen).any()
        projector.close()
        projector.close()
        with pytest.raises(DeviceLost, match="not connected"):
            projector.show(noise(HEIGHT, WIDTH))


def test_the_end_of_the_x_server_is_a_loss_and_a_new_one_is_used(
    make: Callable[..., DisplayProjector],
) -> None:
    with xvfb(WIDTH, HEIGHT) as screen:
        projector = make(screen)
        identity = projector.connect()
        projector.show(noise(HEIGHT, WIDTH))
    for call in (projector.check, projector.safe):
        with pytest.raises(DeviceLost, match=r"projector: (check|safe): "):
            call()
    with pytest.raises(DeviceLost, match=r"projector: connect: SDL: .*set DISPLAY"):
        projector.connect()
    with xvfb(WIDTH, HEIGHT) as screen:
        os.environ["DISPLAY"] = screen
        assert projector.connect() == identity
        image = noise(HEIGHT, WIDTH)
        projector.show(image)
        np.testing.assert_array_equal(screenshot(screen)[..., 1], image)
        projector.close()


def test_a_latency_that_nobody_told_is_assumed_and_said_to_be(
    make: Callable[..., DisplayProjector],
) -> None:
    with xvfb(WIDTH, HEIGHT) as screen:
        projector = make(screen)
        projector.connect()
        assumed_s = projector.facts()["assumed_latency_s"]
        assert assumed_s == pytest.approx(6 / projector.info().refresh_hz, rel=1e-3)
        assert projector.info().latency_s == 0
        lit = projector.show(noise(HEIGHT, WIDTH))
        assert lit <= projector.clock.now_ns()  # the flip itself
        projector.safe()
        assert projector.clock.now_ns() >= lit + round(assumed_s * 1e9)
        projector.close()


def test_what_ended_it_is_told(make: Callable[..., DisplayProjector]) -> None:
    with xvfb(WIDTH, HEIGHT) as screen:
        projector = make(screen)
        projector.connect()
        assert projector._process is not None
        projector._process.send_signal(signal.SIGTERM)  # the service manager's, to all
        projector._process.send_signal(signal.SIGINT)  # a terminal's
        projector.check()
        projector._process.kill()
        with pytest.raises(DeviceLost, match=r"has ended \(exit status -9\); start the X server"):
            projector.show(noise(HEIGHT, WIDTH))
        projector.connect()
        assert projector._process is not None
    with pytest.raises(DeviceLost, match=r"has ended: .*(X connection|X server|IO error)"):
        flips(projector)


def test_a_window_that_hangs_is_lost_and_its_process_ended(
    make: Callable[..., DisplayProjector], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(display, "CALL_S", 0.2)
    with xvfb(WIDTH, HEIGHT) as screen:
        projector = make(screen)
        identity = projector.connect()
        process = projector._process
        assert process is not None
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(DeviceLost, match="did not answer within"):
            projector.check()
        assert process.poll() == -signal.SIGKILL
        assert projector.connect() == identity


def test_the_process_ends_with_the_one_that_started_it(
    make: Callable[..., DisplayProjector],
) -> None:
    with xvfb(WIDTH, HEIGHT) as screen:
        projector = make(screen)
        projector.connect()
        process = projector._process
        assert process is not None
        projector._calls.close()  # as when the daemon is killed
        projector._calls = None
        assert process.wait(60) == 0


def test_without_any_display_the_remedy_is_named(make: Callable[..., DisplayProjector]) -> None:
    with pytest.raises(DeviceLost, match=r"projector: connect: SDL: .*; set DISPLAY for a desk"):
        make().connect()
