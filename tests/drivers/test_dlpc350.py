"""The DLPC350 driver, unmodified, over an emulated USB cable."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec
import numpy as np
import pytest
import usb.core
from numpy.typing import NDArray

from drivers import dlpc350, dlpc350_board, dlpc_hid, dmd
from drivers import dlpc350_protocol as p
from drivers.base.device import Context
from drivers.base.errors import DeviceError, DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.base.projector import LoadedSequence
from drivers.clock import NS, Clock
from drivers.dlpc350 import Dlpc350Projector
from drivers.registry import build
from tests.drivers.dlpc350_peer import Board, Usb
from tests.drivers.xserver import screenshot, xvfb
from tests.jumping import Jumping

SIZE = (dmd.ROWS, dmd.COLUMNS)
Image = NDArray[np.uint8]
BLACK, WHITE = np.zeros(SIZE, np.uint8), np.full(SIZE, 255, np.uint8)


@pytest.fixture(scope="module")
def frames() -> list[Image]:
    """What is in flash: three images of 24 patterns."""
    rng = np.random.default_rng(2)
    return [np.kron(rng.integers(0, 256, (38, 38, 3), np.uint8), np.ones((30, 24, 1), np.uint8))
            for _ in range(3)]  # fmt: skip


@pytest.fixture(scope="module")
def files(frames: list[Image], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("flash")
    names = [str(folder / f"{k}.png") for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(name, frame[..., ::-1])
    return names


@pytest.fixture
def board(frames: list[Image]) -> Board:
    return Board(frames)


@pytest.fixture
def bus(board: Board) -> Usb:
    return Usb(board)


@pytest.fixture
def make(bus: Usb, files: list[str]) -> Callable[..., Dlpc350Projector]:
    def make(clock: Clock | None = None, **options: Any) -> Dlpc350Projector:
        options = {"flash": files[:1], "layout": "native"} | options
        context = Context(clock=clock or Jumping(), shared={"usb": bus})
        return cast(Dlpc350Projector, build("projector", "dlpc350", "projector", options, context))

    return make


@pytest.fixture
def projector(make: Callable[..., Dlpc350Projector]) -> Dlpc350Projector:
    device = make()
    device.connect()
    return device


@pytest.fixture
def three(make: Callable[..., Dlpc350Projector], files: list[str]) -> Dlpc350Projector:
    """With three images in its flash."""
    device = make(flash=files)
    device.connect()
    return device


def patterns(frames: list[Image], *places: tuple[int, int]) -> list[Image]:
    return [dmd.plane(frames[index], number) for index, number in places]


def assert_played(board: Board, expected: list[Image], led: int = 7) -> None:
    assert [lit for _, lit in board.played] == [led] * len(expected)
    for (shown, _), image in zip(board.played, expected, strict=True):
        np.testing.assert_array_equal(shown, image)


# ---------------------------------------------------------------- the wire


def test_reports_are_framed_as_the_controller_wants_them() -> None:
    (report,) = dlpc_hid.message(0xC0, 5, 0x1A0A, b"")
    assert report[:8] == bytes((0xC0, 5, 2, 0, 0x0A, 0x1A, 0, 0))
    assert len(report) == 64
    first, second = dlpc_hid.message(0x40, 6, 0x1A34, bytes(range(1, 60)))
    assert first[2:4] == bytes((61, 0))
    assert (first + second)[6:65] == bytes(range(1, 60))
    assert not any(second[1:])
    assert len(dlpc_hid.message(0x40, 0, 0x1A34, bytes(58))) == 1  # just full


def test_connect_takes_it_from_the_kernel_wakes_it_and_leaves_it_dark(
    board: Board, bus: Usb, projector: Dlpc350Projector
) -> None:
    assert not bus.driver
    assert board.registers[p.Command.POWER] == b"\0"
    assert board.dark
    identity = projector.connect()
    assert (identity.model, identity.serial) == ("DLP LightCrafter 4500", "LCR-1")
    assert identity.firmware == "4.4.0"
    projector.close()
    projector.close()
    assert not bus.claimed


def test_the_status_is_told_in_words(board: Board, projector: Dlpc350Projector) -> None:
    projector.show(WHITE)
    projector.check()
    assert projector.facts()["status"] == ["sequencer running"]
    board.hardware = 0b1000_0101
    with pytest.raises(DeviceRefused, match="check: the DMD controller has an error, its sequencer "
                       "has an error; switch it off and on"):  # fmt: skip
        projector.check()
    board.hardware = 0
    with pytest.raises(DeviceRefused, match="not finished its start"):
        projector.check()


@pytest.mark.parametrize("after", range(0, 40, 8))
def test_a_pulled_cable_is_a_loss_wherever_it_happens(
    after: int, board: Board, bus: Usb, projector: Dlpc350Projector, frames: list[Image]
) -> None:
    identity = projector.connect()
    bus.unplug_after = after
    images = patterns(frames, (0, 1), (0, 2))

    def work() -> None:
        projector.load(images, 1000, 1000)
        projector.run()
        projector.stop()
        projector.check()

    with pytest.raises(DeviceLost, match=r"USB: No such device.*; check cable"):
        work()
    with pytest.raises(DeviceLost, match="not connected"):
        projector.check()
    with pytest.raises(DeviceLost, match="no DLP LightCrafter 4500 like the one before"):
        projector.connect()
    bus.unplug_after = -1
    again = Board(frames)
    again.port = (3,)  # another socket
    bus.boards.append(again)
    assert projector.connect() == identity
    with pytest.raises(DeviceRefused, match="no sequence is loaded"):
        projector.run()
    projector.load(images, 1000, 1000)
    projector.run()
    assert_played(again, images)


def test_another_board_does_not_take_its_place(
    board: Board, bus: Usb, projector: Dlpc350Projector
) -> None:
    bus.boards[:] = [Board(serial="LCR-2")]
    projector.close()
    with pytest.raises(DeviceLost, match=r"there are: serial LCR-2 at port 1-4.2"):
        projector.connect()
    bus.boards.append(board)
    assert projector.connect().serial == "LCR-1"


def test_boards_without_a_serial_number_are_known_by_their_port(
    bus: Usb, make: Callable[..., Dlpc350Projector]
) -> None:
    first, second = Board(serial=""), Board(serial="")
    second.port = (1, 3)
    bus.boards[:] = [first, second]
    with pytest.raises(DeviceRefused, match=r"there are 2 of them: serial none at port 1-4.2"):
        make().connect()
    chosen = make(port="1-1.3")
    assert chosen.connect().serial == "1-1.3"
    bus.boards.remove(second)
    with pytest.raises(DeviceLost):
        chosen.check()
    with pytest.raises(DeviceLost, match="like the one before"):
        chosen.connect()


@pytest.mark.parametrize(
    ("attribute", "value", "kind", "says"),
    [
        ("taken", True, DeviceRefused, "another program has the DLP LightCrafter 4500; close TI"),
        ("allowed", False, DeviceRefused, "no permission.*71-umbra.rules"),
        ("boards", [], DeviceLost, "no DLP LightCrafter 4500; check its power"),
    ],
)
def test_a_board_that_cannot_be_had_says_why(
    bus: Usb, make: Callable[..., Dlpc350Projector], attribute: str, value: Any,
    kind: type[DeviceError], says: str,
) -> None:  # fmt: skip
    setattr(bus, attribute, value)
    with pytest.raises(kind, match=f"projector: connect: {says}"):
        make().connect()


def test_without_libusb_the_remedy_is_named(
    make: Callable[..., Dlpc350Projector], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(**_: Any) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", none)
    with pytest.raises(DeviceRefused, match="libusb is not installed; apt install libusb"):
        make().connect()
    assert Dlpc350Projector.discover() == []


def test_discovery_gives_what_to_paste(bus: Usb, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.boards.append(Board(serial=""))
    monkeypatch.setattr(dlpc350, "attached", lambda product: dlpc_hid.attached(product, bus))
    found = Dlpc350Projector.discover()
    assert [entry["options"] for entry in found] == [{"serial": "LCR-1"}, {"port": "1-4.2"}]


def test_refusals_stale_answers_silence_and_nonsense(
    board: Board, bus: Usb, projector: Dlpc350Projector
) -> None:
    hid = projector._hid
    with pytest.raises(DeviceRefused, match="test: the controller refused command 1A99; it does"):
        hid.write(0x1A99, "test", b"")
    with pytest.raises(DeviceRefused, match="1A29"):
        hid.write(p.Command.TIMING, "test", b"short")
    bus.mangle = lambda _: []
    with pytest.raises(DeviceTimeout, match="test: no answer within 1000 ms"):
        hid.write(p.Command.LEDS, "test", b"\x07")
    late = bytes((0, hid._sequence, 0, 0)) + bytes(60)  # the answer after all
    bus.mangle = lambda answer: [late, answer]
    assert hid.read(p.Command.LEDS, "test") == b"\x07"
    bus.mangle = lambda answer: [late] * 20
    with pytest.raises(DeviceGarbled, match="makes no sense"):
        hid.read(p.Command.LEDS, "test")
    bus._answers.clear()
    bus.mangle = lambda answer: [answer[:3]]
    with pytest.raises(DeviceGarbled, match="makes no sense"):
        hid.read(p.Command.LEDS, "test")
    bus.mangle = lambda answer: [answer]
    projector.check()


def test_sequence_numbers_wrap(projector: Dlpc350Projector) -> None:
    for _ in range(300):
        projector._hid.read(p.Command.LEDS, "test")


# ---------------------------------------------------------------- from flash


def test_what_is_in_flash_is_found_by_its_content(
    board: Board, three: Dlpc350Projector, frames: list[Image]
) -> None:
    grey = dmd.plane(frames[1], 2, 8)
    images = [*patterns(frames, (2, 5), (0, 23)), BLACK, WHITE, grey]
    for image in images:
        before = three.clock.now_ns()
        lit = three.show(image)
        assert lit - before >= round(three.info().latency_s * NS) == 200_000_000
    assert_played(board, images)
    count = len(board.log)
    three.show(grey)  # it is up already
    assert len(board.log) == count
    with pytest.raises(DeviceRefused, match="not in flash; add it to the firmware"):
        three.show(np.eye(*SIZE, dtype=np.uint8))
    three.safe()
    assert board.dark


def test_a_sequence_plays_each_pattern_once_in_order(
    board: Board, three: Dlpc350Projector, frames: list[Image]
) -> None:
    places = [(0, k) for k in range(20)] + [(1, k) for k in range(20)]
    images = [BLACK, *patterns(frames, *places), WHITE]
    loaded = three.load(images, 4000.4, 5000)
    assert loaded == LoadedSequence(42, 4000, 5000)
    assert board.dark
    for _ in range(2):
        board.played.clear()
        three.run()
        assert_played(board, images)
    assert board.registers[p.Command.TABLE] == bytes((41, 0, 41, 1))
    assert board.images == bytes((0, 1))
    assert len(board.patterns) * 3 > 64  # the table took several reports
    three.stop()
    assert board.dark
    assert board.registers[p.Command.PLAY] == b"\0"


def test_a_third_flash_image_must_be_fetched_in_time(
    board: Board, three: Dlpc350Projector, frames: list[Image]
) -> None:
    images = patterns(frames, *[(k // 10, k) for k in range(24)])
    with pytest.raises(DeviceRefused, match=r"takes 200 ms to fetch.*80 ms only; choose a long"):
        three.load(images, 20_000, 20_000)
    three.load(images, 50_000, 50_000)
    three.run()
    assert_played(board, images)
    assert board.images == bytes((0, 1, 2))


def test_black_and_white_alone_need_no_flash(board: Board, projector: Dlpc350Projector) -> None:
    projector.load([WHITE, BLACK, WHITE], 1000, 2000)
    projector.run()
    assert_played(board, [WHITE, BLACK, WHITE])


@pytest.mark.parametrize(
    ("count", "exposure", "period", "says"),
    [
        (0, 1000, 1000, "give 1 to 128"),
        (129, 1000, 1000, "give 1 to 128"),
        (2, 100, 100, "give 235 to"),
        (2, 900, 1000, "from 235 us to 230 us less"),
        (2, 1100, 1000, "from 235 us to 230 us less"),
        (2, 200, 1000, "from 235 us to 230 us less"),
    ],
)
def test_times_that_it_cannot_keep_are_refused_before_anything_is_sent(
    board: Board, projector: Dlpc350Projector, count: int, exposure: int, period: int, says: str
) -> None:
    sent = len(board.log)
    with pytest.raises(DeviceRefused, match=f"projector: load: .*{says}"):
        projector.load([WHITE] * count, exposure, period)
    assert len(board.log) == sent


def test_what_the_board_says_of_its_patterns_comes_in_words(
    board: Board, projector: Dlpc350Projector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Board, "invalid", lambda self: 0b0001_0111)
    with pytest.raises(DeviceRefused) as caught:
        projector.load([WHITE], 1000, 1000)
    for bit in (0, 1, 2, 4):
        assert p.INVALID[bit] in str(caught.value)
    assert board.dark
    with pytest.raises(DeviceRefused, match="no sequence is loaded"):
        projector.run()
    monkeypatch.setattr(Board, "invalid", lambda self: 0b0000_1000)
    projector.load([WHITE], 1000, 1000)
    assert projector.facts()["warnings"] == [p.INVALID[3]]


def test_grey_levels_are_no_sequence(projector: Dlpc350Projector, frames: list[Image]) -> None:
    with pytest.raises(DeviceRefused, match="image 1 has grey levels"):
        projector.load([WHITE, frames[0][..., 0]], 1000, 1000)
    with pytest.raises(DeviceRefused, match="draw it for the size"):
        projector.show(np.zeros((10, 10), np.uint8))


def test_trigger_output_and_led_are_as_configured(
    board: Board, make: Callable[..., Dlpc350Projector]
) -> None:
    device = make(led="green", trigger_delay_us=-10.0, trigger_active_low=True)
    device.connect()
    device.load([WHITE], 1000, 1000)
    device.run()
    assert_played(board, [WHITE], led=2)
    edge = 0xBB - round(10 / 0.1072)
    assert board.registers[p.Command.TRIGGER_OUT_1] == bytes((1, edge, 0xBB))
    assert board.registers[p.Command.TRIGGER_OUT_2] == bytes((1, edge))
    with pytest.raises(ValueError, match=r"-20.05 to 2.787"):
        p.trigger_edge(3.0)


def test_patterns_drawn_on_the_square_grid_are_laid_out_on_the_diamond(
    board: Board, bus: Usb, make: Callable[..., Dlpc350Projector], tmp_path: Path
) -> None:
    y, x = np.mgrid[: dmd.ROWS, : 2 * dmd.COLUMNS]
    checker = ((x // 40 + y // 40) % 2 * 255).astype(np.uint8)
    frame = dmd.pack([BLACK, dmd.to_mirrors(checker, odd_rows_right=False)])
    cv2.imwrite(str(tmp_path / "one.png"), frame[..., ::-1])
    board.flash = [frame]
    device = make(layout="square", odd_rows_right=False, flash=[str(tmp_path / "one.png")])
    device.connect()
    info = device.info()
    assert (info.width, info.height) == (1824, 1140)
    device.show(checker)
    assert_played(board, [dmd.to_mirrors(checker, odd_rows_right=False)])


def test_the_safe_state_may_be_standby(board: Board, make: Callable[..., Dlpc350Projector]) -> None:
    device = make(standby=True)
    device.connect()
    device.show(WHITE)
    for _ in range(2):
        device.safe()
        assert board.registers[p.Command.POWER] == b"\x01"
    device.check()
    assert device.facts()["status"] == ["mirrors parked"]
    device.stop()
    device.load([WHITE], 1000, 1000)
    device.run()
    assert board.registers[p.Command.POWER] == b"\0"
    device.safe()
    with pytest.raises(DeviceRefused, match="in standby; load the sequence again"):
        device.run()


def test_a_board_that_does_not_wake_is_named_and_halt_ends_the_wait(
    board: Board, make: Callable[..., Dlpc350Projector], monkeypatch: pytest.MonkeyPatch
) -> None:
    device = make()
    monkeypatch.setattr(Board, "read", lambda self, command: bytes((1,)) * 16)
    with pytest.raises(DeviceTimeout, match="did not wake from standby within 5 s; try again"):
        device.connect()
    waits: list[float] = []

    def halting(seconds: float, wake: Any = None) -> bool:
        waits.append(seconds)
        device.halt()
        return True

    monkeypatch.setattr(device.clock, "wait", halting)
    with pytest.raises(DeviceTimeout, match="halted before it could wake"):
        device.connect()
    assert len(waits) == 1


@pytest.mark.parametrize(
    ("content", "says"), [("missing", "is no picture"), ("small", "is 20 x 10; give the 912 x")]
)
def test_flash_files_that_do_not_fit_are_named(
    make: Callable[..., Dlpc350Projector], tmp_path: Path, content: str, says: str
) -> None:
    path = tmp_path / "flash-0.png"
    if content == "small":
        cv2.imwrite(str(path), np.zeros((10, 20, 3), np.uint8))
    with pytest.raises(DeviceRefused, match=f"flash-0.png, {says}"):
        make(flash=[str(path)]).connect()


@pytest.mark.parametrize("options", [{"flash": []}, {"display": {}}, {"flash": [], "display": {
    "colour": 1}}])  # fmt: skip
def test_one_way_for_pictures(
    make: Callable[..., Dlpc350Projector], options: dict[str, Any]
) -> None:
    pytest.importorskip("pygame", reason="needs the extra: pip install 'umbra-rig[display]'")
    with pytest.raises(msgspec.ValidationError, match=r"one of them|colour"):
        make(**options)


# ---------------------------------------------------------------- over HDMI


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    pytest.importorskip("pygame", reason="needs the extra: pip install 'umbra-rig[display]'")
    with xvfb(dmd.COLUMNS, dmd.ROWS) as name:
        yield name


@pytest.fixture
def hdmi(
    server: str, board: Board, make: Callable[..., Dlpc350Projector],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Dlpc350Projector]:  # fmt: skip
    """The board's video port is the X server's real picture."""
    from drivers.clock import RealClock

    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    monkeypatch.setenv("DISPLAY", server)
    monkeypatch.setattr(dlpc350_board, "POLL_S", 0.001)
    board.video = lambda: screenshot(server)
    device = make(RealClock(), flash=[], display={"latency_frames": 1.0}, layout="square")
    device.connect()
    yield device
    device.close()


def test_any_picture_goes_over_hdmi(hdmi: Dlpc350Projector, board: Board, server: str) -> None:
    rng = np.random.default_rng(4)
    info = hdmi.info()
    assert info.latency_s == pytest.approx(2 / info.refresh_hz)
    for _ in range(2):
        image = rng.integers(0, 256, (info.height, info.width), np.uint8)
        hdmi.show(image)
        np.testing.assert_array_equal(screenshot(server)[..., 1], dmd.to_mirrors(image))
    starts = [data for kind, command, data in board.log if (kind, command) == ("write", 0x1A24)]
    assert starts.count(b"\x02") == 1  # the second picture needed no USB
    assert [(first & 3, first >> 2, second) for first, second, _ in board.patterns] == [
        (1, 0, 8 | 7 << 4)
    ]
    hdmi.safe()
    assert board.dark


def test_a_sequence_travels_as_bit_planes_of_one_frame(
    hdmi: Dlpc350Projector, board: Board
) -> None:
    rng = np.random.default_rng(6)
    info = hdmi.info()
    images = [
        rng.integers(0, 2, (info.height, info.width), np.uint8) * np.uint8(255) for _ in range(24)
    ]
    assert info.sequence is not None
    assert (info.sequence.images, info.sequence.bits) == (24, 1)
    loaded = hdmi.load(images, 400, 400)
    assert loaded.images == 24
    hdmi.run()
    assert_played(board, [dmd.to_mirrors(image) for image in images])
    with pytest.raises(DeviceRefused, match="longer than a video frame; they must fit into"):
        hdmi.load(images, 5000, 5000)
    hdmi.show(images[0])  # a single picture again
    assert hdmi.facts()["source"] == "hdmi"
