"""The display's window on a real X server: what is asked for is on the screen, pixel for pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.devices.devicethread import DeviceThread
from drivers.base.device import Context
from drivers.base.errors import DeviceLost, DeviceRefused
from tests.drivers.xserver import screenshot, xvfb

pygame = pytest.importorskip("pygame", reason="needs the extra: pip install 'umbra-rig[display]'")

from drivers import displaywindow, sdl  # noqa: E402
from drivers.displaywindow import DisplayOptions, DisplayWindow  # noqa: E402

WIDTH, HEIGHT = 640, 480
Thread = DeviceThread[DisplayWindow]


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with xvfb(WIDTH, HEIGHT) as name:
        yield name


@pytest.fixture
def screen(server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    for name in ("SDL_VIDEODRIVER", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", server)
    monkeypatch.setattr(displaywindow, "MEASURED", 4)
    return server


@pytest.fixture
def make(screen: str) -> Iterator[Callable[..., Thread]]:
    """Projectors in threads of their own, as the daemon has them."""
    threads: list[Thread] = []

    def make(**options: Any) -> Thread:
        device = DisplayWindow("projector", msgspec.convert(options, DisplayOptions), Context())
        threads.append(DeviceThread(device))
        return threads[-1]

    yield make
    for thread in threads:
        thread.call(lambda d: d.close(), 10)
        assert thread.close(10)


def noise(*shape: int) -> NDArray[np.uint8]:
    return np.random.default_rng(5).integers(0, 256, shape, np.uint8)


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(image[..., None], 3, axis=2)


def test_every_pixel_is_on_the_screen_as_it_was_asked_for(
    make: Callable[..., Thread], screen: str
) -> None:
    thread = make()
    identity = thread.call(lambda d: d.connect(), 20)
    info = thread.device.info()
    assert (info.width, info.height) == (WIDTH, HEIGHT)
    assert f"{WIDTH}x{HEIGHT}" in identity.model
    assert not screenshot(screen).any()  # black from the beginning
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    checker = ((x + y) % 2 * 255).astype(np.uint8)  # any scaling or filter would make it grey
    ramp = (x % 256).astype(np.uint8)
    turned = noise(WIDTH, HEIGHT).T  # columns are contiguous, not rows
    for image in (checker, 255 - checker, ramp, noise(HEIGHT, WIDTH), turned[:, ::-1]):
        thread.call(lambda d, image=image: d.show(image), 10)  # type: ignore[misc]
        np.testing.assert_array_equal(screenshot(screen), grey(image))
    thread.call(lambda d: d.safe(), 10)
    assert not screenshot(screen).any()


def test_nothing_else_is_seen_and_flips_wait(make: Callable[..., Thread]) -> None:
    """A screenshot has no cursor in it: what SDL was told has to do."""
    thread = make()
    thread.call(lambda d: d.connect(), 20)
    asked = ("mouse.get_visible", "display.get_allow_screensaver", "display.is_vsync")

    def told(_: DisplayWindow) -> list[bool]:
        return [getattr(getattr(pygame, a), b)() for a, b in (name.split(".") for name in asked)]

    assert thread.call(told, 10) == [False, False, True]


def test_without_a_gpu_it_says_that_a_timer_paces_flips(
    make: Callable[..., Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SDL_RENDER_DRIVER", "software")
    thread = make()
    thread.call(lambda d: d.connect(), 20)
    assert thread.device.facts()["flips_by"] == "timer"


def test_it_stays_for_as_long_as_nothing_else_is_shown(
    make: Callable[..., Thread], screen: str
) -> None:
    thread = make()
    thread.call(lambda d: d.connect(), 20)
    image = noise(HEIGHT, WIDTH)
    thread.call(lambda d: d.show(image), 10)
    for _ in range(50):  # minutes of a rig's idle checks
        thread.call(lambda d: d.check(), 10)
    assert thread.call(lambda _: pygame.event.get(), 10) == []
    np.testing.assert_array_equal(screenshot(screen), grey(image))


@pytest.mark.parametrize(("channel", "kept"), [("red", 0), ("green", 1), ("blue", 2)])
def test_one_channel_alone(
    make: Callable[..., Thread], screen: str, channel: str, kept: int
) -> None:
    thread = make(channel=channel)
    thread.call(lambda d: d.connect(), 20)
    image = noise(HEIGHT, WIDTH)
    thread.call(lambda d: d.show(image), 10)
    expected = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    expected[..., kept] = image
    np.testing.assert_array_equal(screenshot(screen), expected)


def test_three_planes_for_bit_patterns(make: Callable[..., Thread], screen: str) -> None:
    thread = make(channel="green")
    thread.call(lambda d: d.connect(), 20)
    image = noise(HEIGHT, WIDTH, 3)
    thread.call(lambda d: d.show(image), 10)
    np.testing.assert_array_equal(screenshot(screen), image)


def test_flips_tell_when_light_comes(make: Callable[..., Thread]) -> None:
    thread = make(latency_frames=2.5)
    thread.call(lambda d: d.connect(), 20)
    info = thread.device.info()
    assert 0 < info.refresh_hz < displaywindow.FASTEST_HZ
    assert info.latency_s == pytest.approx(2.5 / info.refresh_hz)
    image = noise(HEIGHT, WIDTH)
    moments = []
    for _ in range(4):
        before = thread.device.clock.now_ns()
        moments.append(thread.call(lambda d: d.show(image), 10))
        after = thread.device.clock.now_ns()
        flipped = moments[-1] - round(info.latency_s * 1e9)
        assert before <= flipped + 1
        assert flipped - 1 <= after
    assert all(b > a for a, b in pairwise(moments))


def test_safe_is_over_when_the_light_is_black(make: Callable[..., Thread]) -> None:
    thread = make(latency_frames=3)
    thread.call(lambda d: d.connect(), 20)
    lit = thread.call(lambda d: d.show(noise(HEIGHT, WIDTH)), 10)
    thread.call(lambda d: d.safe(), 10)
    assert thread.device.clock.now_ns() > lit


def test_halt_ends_the_wait_for_black(make: Callable[..., Thread], screen: str) -> None:
    thread = make(latency_frames=100_000)
    thread.call(lambda d: d.connect(), 20)
    thread.call(lambda d: d.show(noise(HEIGHT, WIDTH)), 10)
    safe = thread.submit(lambda d: d.safe(), 60)
    while not safe.done():  # a halt that comes before the call is not remembered
        thread.device.halt()
    safe.result()
    assert not screenshot(screen).any()


def test_a_window_to_try_things_in(make: Callable[..., Thread], screen: str) -> None:
    thread = make(windowed=True, size=[200, 100], refresh_hz=100)
    thread.call(lambda d: d.connect(), 20)
    assert thread.device.info().refresh_hz == 100
    image = np.maximum(noise(100, 200), np.uint8(1))
    thread.call(lambda d: d.show(image), 10)
    picture = screenshot(screen)
    rows, columns = np.nonzero(picture.any(2))
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == image.shape
    here = picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    np.testing.assert_array_equal(here, grey(image))


@pytest.mark.parametrize(
    ("options", "kind", "says"),
    [
        ({"output": 3}, DeviceLost, r"no output 3; there are 0 \(.+\); is it plugged in"),
        ({"output": "HDMI-9"}, DeviceLost, "no output 'HDMI-9'"),
        ({"size": [912, 1140]}, DeviceRefused, "is 640 x 480, not 912 x 1140; set the output's"),
        ({"refresh_hz": 400.0}, DeviceRefused, "not at refresh_hz = 400"),
        ({"video_driver": "dummy"}, DeviceLost, r"no display was found \(its dummy driver"),
        ({"video_driver": "vga"}, DeviceLost, "projector: connect: SDL: .*vga.*DISPLAY"),
    ],
)
def test_what_cannot_be_is_refused_by_name(
    make: Callable[..., Thread], options: dict[str, Any], kind: type[Exception], says: str
) -> None:
    thread = make(**options)
    with pytest.raises(kind, match=says):
        thread.call(lambda d: d.connect(), 20)


def test_an_output_can_be_named(make: Callable[..., Thread], screen: str) -> None:
    (found,) = DisplayWindow.discover()
    assert isinstance(found["options"]["output"], str)
    thread = make(**found["options"])
    assert thread.call(lambda d: d.connect(), 20).model == found["model"]
    assert DisplayWindow.discover() == []  # hands off while it shows something


def test_flips_that_do_not_wait_are_refused(
    make: Callable[..., Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(displaywindow, "FASTEST_HZ", 1e-3)
    with pytest.raises(DeviceRefused, match=r"do not wait for the refresh.*KMSDRM"):
        make().call(lambda d: d.connect(), 20)


def test_without_any_display_the_remedy_is_named(
    make: Callable[..., Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY")
    with pytest.raises(DeviceLost, match=r"projector: connect: SDL: .*; set DISPLAY for a desk"):
        make().call(lambda d: d.connect(), 20)
    assert DisplayWindow.discover() == []


def test_one_display_a_process(make: Callable[..., Thread]) -> None:
    first, second = make(), make()
    first.call(lambda d: d.connect(), 20)
    with pytest.raises(DeviceRefused, match="another device of this rig has the display"):
        second.call(lambda d: d.connect(), 20)
    second.call(lambda d: d.close(), 20)
    first.call(lambda d: d.check(), 10)  # it was not closed with the other
    first.call(lambda d: d.close(), 20)
    second.call(lambda d: d.connect(), 20)


def test_a_closed_window_is_a_loss_and_can_be_opened_again(
    make: Callable[..., Thread], screen: str
) -> None:
    thread = make()
    identity = thread.call(lambda d: d.connect(), 20)
    thread.call(lambda _: pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE)), 10)
    with pytest.raises(DeviceLost, match="check: the window was closed"):
        thread.call(lambda d: d.check(), 10)
    assert thread.call(lambda d: d.connect(), 20) == identity
    image = noise(HEIGHT, WIDTH)
    thread.call(lambda d: d.show(image), 10)
    np.testing.assert_array_equal(screenshot(screen), grey(image))


def test_images_of_another_size_and_calls_too_early_are_refused(
    make: Callable[..., Thread],
) -> None:
    thread = make()
    for call in (lambda d: d.check(), lambda d: d.safe()):
        with pytest.raises(DeviceLost, match="not connected"):
            thread.call(call, 10)
    assert thread.device.info().latency_s == 0
    thread.call(lambda d: d.connect(), 20)
    for image in (noise(HEIGHT, WIDTH - 1), np.zeros((HEIGHT, WIDTH), np.float32)):
        with pytest.raises(DeviceRefused, match="draw it for the size"):
            thread.call(lambda d, image=image: d.show(image), 10)  # type: ignore[misc]


def test_connectors_are_named_in_the_kernels_order(tmp_path: Any) -> None:
    for name, status, number in (
        ("card0-HDMI-A-1", "connected", "95"),
        ("card0-eDP-1", "connected", "88"),
        ("card0-DP-1", "disconnected", "70"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "status").write_text(status + "\n")
        (folder / "connector_id").write_text(number + "\n")
    assert sdl.connectors(tmp_path) == ["eDP-1", "HDMI-A-1"]
