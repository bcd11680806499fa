"""The virtual camera and projector in time: what frames integrate and count, how they fail."""

from __future__ import annotations

import threading
from itertools import pairwise
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, CameraSettings, Frame
from drivers.base.device import Context
from drivers.base.errors import DeviceGarbled, DeviceLost, DeviceRefused, DeviceTimeout, OutOfRange
from drivers.base.pixelformat import PixelFormat
from drivers.clock import NS, ScaledClock
from drivers.registry import build
from drivers.virtual.camera import VirtualCamera
from drivers.virtual.faults import Fault
from drivers.virtual.projector import VirtualProjector
from drivers.virtual.timeline import Forgotten, Timeline
from tests.jumping import Jumping

BLACK = np.zeros((96, 128), np.uint8)
WHITE = np.full((96, 128), 255, np.uint8)
LEFT = np.repeat(np.where(np.arange(128) < 64, 255, 0).astype(np.uint8)[None], 96, axis=0)


def rig(
    speed: float = 0, projector: dict[str, Any] | None = None, **camera: Any
) -> tuple[VirtualProjector, VirtualCamera]:
    context = Context(clock=ScaledClock(speed) if speed else Jumping())
    p = {"width": 128, "height": 96, "leakage": 0.0} | (projector or {})
    c = {"width": 160, "height": 120, "pixel_format": "RGB16", "noise": False} | camera
    pair = (
        cast(VirtualProjector, build("projector", "virtual", "projector", p, context)),
        cast(VirtualCamera, build("camera", "virtual", "camera", c, context)),
    )
    for device in pair:
        device.connect()
    return pair


def grab(camera: VirtualCamera, timeout_s: float = 5) -> tuple[NDArray[Any], Frame]:
    info = camera.info()
    out = np.zeros(info.shape, info.pixel_format.dtype)
    return out, camera.grab(out, timeout_s)


def shoot(camera: VirtualCamera) -> NDArray[np.float32]:
    camera.trigger()
    return grab(camera)[0].astype(np.float32) - np.float32(camera.info().black_level)


# ---------------------------------------------------------------- time


def test_flips_happen_at_the_refresh_and_tell_when() -> None:
    projector, _ = rig(projector={"refresh_hz": 50, "latency_ms": 7})
    moments = [projector.show(image) for image in (BLACK, WHITE, LEFT)]
    for a, b in pairwise(moments):
        assert (b - a) % (NS // 50) in {0, 1, NS // 50 - 1}
        assert b > a
    assert projector.clock.now_ns() >= moments[-1] - 7_000_000


@pytest.mark.parametrize("speed", [0, 200])
def test_a_frame_holds_what_was_shown_while_it_was_exposed(speed: float) -> None:
    """Torn frames are told apart by clock times alone, whatever the clock's speed."""
    projector, camera = rig(speed, exposure_us=50_000)
    camera.start(Acquisition.SOFTWARE)
    projector.show(WHITE)
    white = shoot(camera)
    projector.show(BLACK)
    black = shoot(camera)
    start, end = camera.trigger()
    seen = projector.show(WHITE)  # while it is exposing, or after it
    torn = grab(camera)[0].astype(np.float32) - np.float32(camera.info().black_level)
    part = min(max((end - seen) / (end - start), 0), 1)
    assert speed or 0.3 < part < 1
    use = white - black > 3000
    assert np.median(((torn - black) / np.maximum(white - black, 1))[use]) == pytest.approx(
        part, abs=0.002
    )


def test_hidden_latency_tears_a_frame_that_trusts_what_it_was_told() -> None:
    projector, camera = rig(projector={"hidden_latency_ms": 10}, ambient=0.0)
    camera.start(Acquisition.SOFTWARE)
    projector.show(BLACK)
    projector.clock.wait(0.1)
    projector.show(WHITE)
    early = shoot(camera)
    late = shoot(camera)
    assert early.mean() == pytest.approx(0.4 * late.mean(), rel=0.01)  # 10 of 16.7 ms were dark


def test_a_late_flip_is_not_told() -> None:
    projector, camera = rig(exposure_us=10_000, ambient=0.0)
    camera.start(Acquisition.SOFTWARE)
    projector.show(BLACK)
    projector.faults.inject(Fault.LATE_FLIP)
    projector.show(WHITE)
    first = shoot(camera)
    camera.clock.wait(0.05)
    assert first.max() == 0
    assert shoot(camera).max() > 10_000


def test_frames_carry_their_times() -> None:
    _, camera = rig(exposure_us=2500, trigger_latency_us=100)
    camera.start(Acquisition.SOFTWARE)
    before = camera.clock.now_ns()
    start, end = camera.trigger()
    _, frame = grab(camera)
    assert (frame.start_ns, frame.end_ns) == (start, end)
    assert start >= before + 100_000
    assert end - start == 2_500_000
    assert camera.clock.now_ns() >= end + round(camera.info().readout_s * NS)
    assert frame.exposure_us == 2500


def test_a_trigger_during_an_exposure_waits_for_its_end() -> None:
    _, camera = rig(exposure_us=20_000)
    camera.start(Acquisition.SOFTWARE)
    (_, end), (start, _) = camera.trigger(), camera.trigger()
    assert start >= end
    assert [grab(camera)[1].sequence for _ in range(2)] == [0, 1]


def test_free_running_frames_are_evenly_spaced() -> None:
    _, camera = rig(frame_rate_hz=50, exposure_us=1000)
    camera.start(Acquisition.FREE)
    frames = [grab(camera)[1] for _ in range(20)]
    assert [f.sequence for f in frames] == list(range(20))
    assert {b.start_ns - a.start_ns for a, b in pairwise(frames)} == {NS // 50}


def test_an_overrun_leaves_a_gap_in_the_sequence() -> None:
    _, camera = rig(frame_rate_hz=100, exposure_us=1000, buffers=3)
    camera.start(Acquisition.FREE)
    camera.clock.wait(1.0)
    numbers = [grab(camera)[1].sequence for _ in range(5)]
    assert numbers[:3] == [0, 1, 2]
    assert numbers[3] == 100


def test_what_was_forgotten_is_incomplete_not_wrong() -> None:
    line: Timeline[int] = Timeline(0, length=4)
    for moment in range(10, 100, 10):
        line.change(moment, moment)
    assert len(line) == 4
    assert line.spans(75, 85) == [(75, 80, 70), (80, 85, 80)]
    with pytest.raises(Forgotten):
        line.spans(20, 30)
    line.change(75, -1)
    assert line.spans(70, 1000) == [(70, 75, 70), (75, 1000, -1)]


# ---------------------------------------------------------------- counts


def test_exposure_and_gain_scale_light_not_black() -> None:
    projector, camera = rig()
    projector.show(WHITE)
    pictures = []
    for exposure, gain in ((4000.0, 0.0), (8000.0, 0.0), (4000.0, 6.0206)):
        camera.stop()
        camera.configure(CameraSettings(exposure_us=exposure, gain=gain))
        camera.start(Acquisition.SOFTWARE)
        pictures.append(shoot(camera))
    one, longer, amplified = pictures
    np.testing.assert_allclose(longer, 2 * one, atol=3)
    np.testing.assert_allclose(amplified, 2 * one, atol=3)


def test_noise_follows_its_model() -> None:
    projector, camera = rig(noise=True, pixel_format="Mono12", full_well_e=8000, read_noise_e=5)
    projector.show(WHITE)
    camera.start(Acquisition.SOFTWARE)
    stack = np.stack([shoot(camera) for _ in range(60)])
    mean, variance = stack.mean(0), stack.var(0, ddof=1)
    per_electron = (4095 - camera.info().black_level) / 8000
    model = per_electron * mean + (5 * per_electron) ** 2 + 1 / 12
    middle = (mean > 100) & (mean < 3500)
    assert np.mean(variance[middle] / model[middle]) == pytest.approx(1, abs=0.02)
    dark, bright = mean < np.quantile(mean, 0.3), mean > np.quantile(mean, 0.7)
    for part in (dark & middle, bright & middle):
        assert np.mean(variance[part] / model[part]) == pytest.approx(1, abs=0.04)


def test_the_same_seed_gives_the_same_bits() -> None:
    def pictures(seed: int) -> list[NDArray[np.float32]]:
        projector, camera = rig(noise=True, seed=seed, shake_px=0.5)
        projector.show(LEFT)
        camera.start(Acquisition.SOFTWARE)
        camera.clock.wait(0.1)
        return [shoot(camera) for _ in range(3)]

    first, second, other = pictures(7), pictures(7), pictures(8)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], other[0])


def test_shake_moves_the_picture() -> None:
    projector, camera = rig(shake_px=1.0, pixel_format="BayerRG12")
    projector.show(LEFT)
    camera.start(Acquisition.SOFTWARE)
    assert np.abs(shoot(camera) - shoot(camera)).max() > 50


@pytest.mark.parametrize("pixel_format", list(PixelFormat))
def test_every_format_uses_its_scale(pixel_format: PixelFormat) -> None:
    projector, camera = rig(pixel_format=pixel_format.value)
    projector.show(WHITE)
    camera.start(Acquisition.SOFTWARE)
    out = shoot(camera) + camera.info().black_level
    assert 0.5 * pixel_format.full_scale < out.max() <= pixel_format.full_scale
    assert out.min() >= 0


def test_a_region_of_interest_is_a_part_of_the_picture() -> None:
    projector, camera = rig()
    projector.show(LEFT)
    camera.start(Acquisition.SOFTWARE)
    whole, truth = shoot(camera), camera.truth()["direct"]
    camera.stop()
    camera.configure(CameraSettings(roi=(30, 20, 64, 48)))
    camera.start(Acquisition.SOFTWARE)
    np.testing.assert_array_equal(shoot(camera), whole[20:68, 30:94])
    np.testing.assert_array_equal(camera.truth()["direct"], truth[20:68, 30:94])


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        (CameraSettings(exposure_us=1.0), "from 20 to"),
        (CameraSettings(gain=99.0), "from 0 to 36"),
        (CameraSettings(roi=(100, 0, 100, 10)), "within 160 x 120"),
        (CameraSettings(roi=(1, 0, 20, 10), pixel_format=PixelFormat.BAYER_GB8), "even"),
    ],
)
def test_settings_out_of_range_are_refused(wanted: CameraSettings, says: str) -> None:
    _, camera = rig()
    before = camera.settings()
    with pytest.raises(OutOfRange, match=says):
        camera.configure(wanted)
    assert camera.settings() == before
    camera.start(Acquisition.SOFTWARE)
    with pytest.raises(DeviceRefused, match="stop it first"):
        camera.configure(CameraSettings(gain=1.0))


# ---------------------------------------------------------------- faults


def test_a_dropped_trigger_times_out_and_the_next_works() -> None:
    _, camera = rig(faults=["drop-trigger@1"])
    camera.start(Acquisition.SOFTWARE)
    camera.trigger()
    with pytest.raises(DeviceTimeout, match="camera: grab: no frame"):
        grab(camera, 0.5)
    camera.trigger()
    assert grab(camera)[1].sequence == 0


def test_duplicate_and_incomplete_frames_are_recognisable() -> None:
    _, camera = rig(faults=["duplicate-frame@2", "incomplete-frame@3"])
    camera.start(Acquisition.SOFTWARE)
    for _ in range(2):
        camera.trigger()
    frames = [grab(camera)[1] for _ in range(3)]
    assert [f.sequence for f in frames] == [0, 0, 1]
    assert [f.incomplete for f in frames] == [False, False, True]


def test_garbage_and_time_out_name_device_phase_and_remedy() -> None:
    projector, camera = rig(0, {"faults": ["garbage@2"]}, faults=["timeout@1"])
    projector.show(BLACK)
    with pytest.raises(DeviceGarbled, match=r"projector: show: .*; connect again"):
        projector.show(BLACK)
    projector.show(BLACK)
    camera.start(Acquisition.SOFTWARE)
    camera.trigger()
    with pytest.raises(DeviceTimeout, match="camera: grab: no answer within 1 s; check"):
        grab(camera, 1)
    grab(camera)


def test_a_device_vanishes_and_comes_back_perhaps_as_another() -> None:
    _, camera = rig(faults=["vanish:check@1*2", "rename:check@2"])
    identity = camera.connect()
    with pytest.raises(DeviceLost, match="gone"):
        camera.check()
    with pytest.raises(DeviceLost, match="not connected"):
        camera.start(Acquisition.SOFTWARE)
    for _ in range(2):
        with pytest.raises(DeviceLost, match="no such device"):
            camera.connect()
    assert camera.connect() == identity
    with pytest.raises(DeviceLost):
        camera.check()
    camera.faults.come_back()
    again = camera.connect()
    assert again.model == identity.model
    assert again.serial != identity.serial


@pytest.mark.parametrize("fault", ["stall@1", ""])
def test_halt_ends_a_blocked_grab_from_another_thread(fault: str) -> None:
    _, camera = rig(0.01, faults=[fault] if fault else [])
    camera.start(Acquisition.SOFTWARE)
    raised: list[BaseException] = []
    inside = threading.Event()

    def work() -> None:
        inside.set()
        try:
            grab(camera, 60)  # 6000 s of real time
        except DeviceTimeout as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    inside.wait()
    while thread.is_alive():  # a halt that comes before the call blocks is not remembered
        camera.halt()
        thread.join(0.01)
    assert "halted" in str(raised[0])


def test_a_schedule_that_makes_no_sense_is_refused() -> None:
    with pytest.raises(ValueError, match="vanish@12"):
        rig(faults=["explode@3"])
    with pytest.raises(msgspec.ValidationError, match="colour"):
        rig(colour="red")


def test_the_wrong_picture_or_buffer_is_refused() -> None:
    projector, camera = rig()
    with pytest.raises(DeviceRefused, match="uint8"):
        projector.show(np.zeros((10, 10), np.uint8))
    with pytest.raises(DeviceRefused, match="start it first"):
        grab(camera)
    camera.start(Acquisition.SOFTWARE)
    with pytest.raises(DeviceRefused, match="buffer"):
        camera.grab(np.zeros((1, 1), np.uint8), 1)
