"""Hardware-timed sequences on the virtual bench: frame k shows image k, or it is noticed."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, Frame
from drivers.base.device import Context
from drivers.base.errors import DeviceRefused, DeviceTimeout
from drivers.base.projector import LoadedSequence, Projector
from drivers.clock import Clock, ScaledClock
from drivers.registry import build
from drivers.sequence import mismatch
from drivers.virtual.camera import VirtualCamera
from drivers.virtual.faults import Fault
from drivers.virtual.projector import VirtualProjector
from tests.jumping import Jumping

SIZE = (96, 128)
COUNT = 12
PERIOD_US = 4000.0


def stripes() -> list[NDArray[np.uint8]]:
    """Images that no two frames can be confused about."""
    rng = np.random.default_rng(3)
    return [
        np.kron(rng.integers(0, 2, (6, 8)), np.ones((16, 16))).astype(np.uint8) * 255
        for _ in range(COUNT)
    ]


def rig(clock: Clock, faults: tuple[str, ...] = (), **projector: Any) -> tuple[Any, Any]:
    context = Context(clock=clock)
    size = {"height": SIZE[0], "width": SIZE[1], "leakage": 0.0}
    camera = {"width": 160, "height": 120, "pixel_format": "Mono12", "noise": False}
    more = {"exposure_us": 3000.0, "readout_ms": 0.5, "ambient": 0.0, "faults": faults}
    pair = (
        cast(VirtualProjector, build("projector", "virtual", "p", size | projector, context)),
        cast(VirtualCamera, build("camera", "virtual", "c", camera | more, context)),
    )
    for device in pair:
        device.connect()
    return pair


def collect(camera: VirtualCamera, most: int, timeout_s: float = 0.05) -> list[Frame]:
    """All frames until one is late."""
    frames = []
    info = camera.info()
    for _ in range(most):
        try:
            frames.append(camera.grab(np.zeros(info.shape, info.pixel_format.dtype), timeout_s))
        except DeviceTimeout:
            break
    return frames


def references(projector: VirtualProjector, camera: VirtualCamera) -> list[NDArray[Any]]:
    """What each image looks like, one by one."""
    camera.start(Acquisition.SOFTWARE)
    pictures = []
    for image in stripes():
        projector.show(image)
        camera.trigger()
        pictures += [frame.pixels for frame in collect(camera, 1)]
    camera.stop()
    assert len({picture.tobytes() for picture in pictures}) == COUNT
    return pictures


def test_a_sequence_gives_each_image_once_in_order_with_no_host_in_the_loop() -> None:
    projector, camera = rig(Jumping())
    expected = references(projector, camera)
    loaded = projector.load(stripes(), 3500, PERIOD_US)
    assert loaded == LoadedSequence(COUNT, 3500, PERIOD_US)
    for _ in range(2):  # it can be run again
        camera.start(Acquisition.HARDWARE)
        began = projector.run()
        frames = collect(camera, COUNT + 5)
        camera.stop()
        assert mismatch(loaded, frames, began) == ""
        assert len(frames) == COUNT
        for frame, picture in zip(frames, expected, strict=True):
            np.testing.assert_array_equal(frame.pixels, picture)
        assert frames[0].start_ns == began + 50_000


def test_a_grab_that_waits_in_its_own_thread_hears_the_pulses() -> None:
    projector, camera = rig(ScaledClock(2))
    images = [np.full(SIZE, level, np.uint8) for level in (0, 80, 160, 255)]
    loaded = projector.load(images, 50_000, 50_000)
    camera.start(Acquisition.HARDWARE)
    frames: list[Frame] = []
    thread = threading.Thread(target=lambda: frames.extend(collect(camera, 4, timeout_s=20)))
    thread.start()
    began = projector.run()
    thread.join()
    assert mismatch(loaded, frames, began) == ""
    means = [float(frame.pixels.mean()) for frame in frames]
    assert means == sorted(means)
    assert means[3] > means[2] + 50 > means[1] + 100


@pytest.mark.parametrize(
    ("faults", "problem"),
    [
        (("drop-trigger@1",), "11 frames for 12 images"),
        (("drop-trigger@7",), "11 frames for 12 images"),
        (("drop-trigger@12",), "11 frames for 12 images"),
        (("duplicate-frame@4",), "lost frames before frame 3"),
        (("incomplete-frame@5",), "frame 4 is incomplete"),
    ],
)
def test_what_goes_wrong_on_the_way_is_named(faults: tuple[str, ...], problem: str) -> None:
    projector, camera = rig(Jumping(), faults)
    loaded = projector.load(stripes(), 3500, PERIOD_US)
    camera.start(Acquisition.HARDWARE)
    began = projector.run()
    frames = collect(camera, COUNT)
    assert problem in mismatch(loaded, frames, began)
    camera.stop()
    camera.start(Acquisition.HARDWARE)  # all of it again
    began = projector.run()
    assert mismatch(loaded, collect(camera, COUNT), began) == ""


def test_a_missed_pulse_and_a_false_one_do_not_cancel() -> None:
    projector, camera = rig(Jumping())
    loaded = projector.load(stripes(), 3500, PERIOD_US)
    camera.start(Acquisition.HARDWARE)
    began = projector.run()
    frames = collect(camera, COUNT)
    for missed in range(1, COUNT):
        left = [frame for k, frame in enumerate(frames) if k != missed]
        last = left[-1]
        false = replace(last, start_ns=last.start_ns + 10**6, end_ns=last.end_ns + 10**6)
        several = [replace(frame, sequence=k) for k, frame in enumerate([*left, false])]
        assert "off its place" in mismatch(loaded, several, began)
    assert "before the sequence" in mismatch(loaded, frames, began + 10**9)
    long = replace(frames[3], end_ns=frames[3].end_ns + 10**8)
    assert "longer than the period" in mismatch(loaded, [*frames[:3], long, *frames[4:]], began)


def test_a_camera_too_slow_for_the_period_does_not_hear_every_pulse() -> None:
    projector, camera = rig(Jumping())
    loaded = projector.load(stripes(), 2000, 2000)
    camera.start(Acquisition.HARDWARE)
    began = projector.run()
    frames = collect(camera, COUNT)
    assert len(frames) == COUNT // 2
    assert "frames for 12 images" in mismatch(loaded, frames, began)


def test_light_that_comes_a_period_late_slips_the_pictures_by_one() -> None:
    """Time stamps cannot show it: this is what a scan's proof of step is for."""
    projector, camera = rig(Jumping(), faults=())
    expected = references(projector, camera)
    projector.faults.inject(Fault.LATE_FLIP, "run")
    projector.load(stripes(), PERIOD_US, PERIOD_US)
    camera.start(Acquisition.HARDWARE)
    projector.run()
    frames = collect(camera, COUNT)
    assert len(frames) == COUNT
    for frame, picture in zip(frames[1:], expected, strict=False):
        np.testing.assert_array_equal(frame.pixels, picture)


@pytest.mark.parametrize("end", ["stop", "safe", "show", "load", "close"])
def test_what_ends_a_sequence_ends_its_triggers(end: str) -> None:
    projector, camera = rig(Jumping())
    projector.load(stripes(), 3500, PERIOD_US)
    camera.start(Acquisition.HARDWARE)
    projector.run()
    assert len(collect(camera, 3)) == 3
    if end == "show":
        projector.show(stripes()[0])
    elif end == "load":
        projector.load(stripes(), 3500, PERIOD_US)
    else:
        getattr(projector, end)()
    more = collect(camera, COUNT)
    assert len(more) <= 1  # one may have been under way
    if end != "show":
        camera.stop()
        camera.start(Acquisition.SOFTWARE)
        camera.trigger()
        assert collect(camera, 1)[0].pixels.max() <= camera.info().black_level + 1


def test_halt_ends_the_wait_for_a_pulse() -> None:
    _, camera = rig(ScaledClock(0.01))
    camera.start(Acquisition.HARDWARE)
    raised: list[str] = []

    def work() -> None:
        try:
            camera.grab(np.zeros((120, 160), np.uint16), 60)
        except DeviceTimeout as error:
            raised.append(str(error))

    thread = threading.Thread(target=work)
    thread.start()
    while thread.is_alive():  # a halt that comes before the call blocks is not remembered
        camera.halt()
        thread.join(0.01)
    assert "halted" in raised[0]


@pytest.mark.parametrize(
    ("count", "exposure", "period", "says"),
    [
        (0, 1000, 1000, "1 to 256 images"),
        (257, 1000, 1000, "1 to 256 images"),
        (2, 1000, 100, "period of 200 to"),
        (2, 2000, 1000, "no longer than the period"),
    ],
)
def test_sequences_beyond_the_limits_are_refused(
    count: int, exposure: float, period: float, says: str
) -> None:
    projector, _ = rig(Jumping())
    with pytest.raises(DeviceRefused, match=says):
        projector.load([np.zeros(SIZE, np.uint8)] * count, exposure, period)
    with pytest.raises(DeviceRefused, match="no sequence is loaded; load one"):
        projector.run()
    with pytest.raises(DeviceRefused, match="uint8"):
        projector.load([np.zeros((2, 2), np.uint8)], 1000, 1000)


def test_a_projector_without_sequences_says_so() -> None:
    class Plain(Projector):
        def connect(self) -> Any: ...
        def check(self) -> None: ...
        def safe(self) -> None: ...
        def halt(self) -> None: ...
        def close(self) -> None: ...
        def info(self) -> Any: ...
        def show(self, image: Any) -> int:
            return 0

    plain = Plain("plain", Plain.options_type(), Context())
    with pytest.raises(DeviceRefused, match=r"plain: load: .* by itself; show the images"):
        plain.load([], 1, 1)
    with pytest.raises(DeviceRefused, match="plain: run"):
        plain.run()
    plain.stop()


def test_a_camera_alone_on_the_bench_has_no_trigger_line() -> None:
    camera = build("camera", "virtual", "c", {"width": 64, "height": 48}, Context())
    camera.connect()
    assert isinstance(camera, VirtualCamera)
    assert camera.info().triggers == ("software", "none")
    with pytest.raises(DeviceRefused, match="sends it triggers"):
        camera.start(Acquisition.HARDWARE)
