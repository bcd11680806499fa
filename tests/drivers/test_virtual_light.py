"""The virtual scene: linear, honest about its two parts, and hard where the paper says so."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, CameraSettings
from drivers.base.device import Context
from drivers.base.pixelformat import PixelFormat
from drivers.clock import ScaledClock
from drivers.registry import build
from drivers.virtual.camera import VirtualCamera
from drivers.virtual.light import VirtualLight
from drivers.virtual.projector import VirtualProjector
from drivers.virtual.transport import Transport, mosaic, transport
from drivers.virtual.view import view

F32 = NDArray[np.float32]


class Rig:
    """A projector and a camera that take one picture at a time."""

    def __init__(self, projector: dict[str, Any], camera: dict[str, Any]) -> None:
        self.context = Context(clock=ScaledClock(50))
        self.projector = cast(
            VirtualProjector, build("projector", "virtual", "projector", projector, self.context)
        )
        self.camera = cast(
            VirtualCamera, build("camera", "virtual", "camera", camera, self.context)
        )
        for device in (self.projector, self.camera):
            device.connect()
        self.camera.start(Acquisition.SOFTWARE)

    def take(self, image: NDArray[np.uint8] | None) -> NDArray[Any]:
        info = self.camera.info()
        out = np.zeros(info.shape, info.pixel_format.dtype)
        if image is None:
            self.projector.safe()
        else:
            self.projector.show(image)
        self.camera.trigger()
        self.camera.grab(out, 5)
        return out

    def linear(self, image: NDArray[np.uint8] | None) -> F32:
        return self.take(image).astype(np.float32) - np.float32(self.camera.info().black_level)

    def solid(self, level: int) -> NDArray[np.uint8]:
        info = self.projector.info()
        return np.full((info.height, info.width), level, np.uint8)


def checker(width: int, height: int, size: int, dx: int, dy: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[:height, :width]
    return np.asarray(((x + dx) // size + (y + dy) // size) % 2 * 255, np.uint8)


SMALL_P = {"width": 128, "height": 96}
SMALL_C = {"width": 160, "height": 120, "pixel_format": "RGB16", "noise": False}


@pytest.fixture(scope="module")
def operator() -> Transport:
    rig = Rig(SMALL_P, SMALL_C)
    return transport(160, 120, rig.projector.pinhole)


def test_transport_is_linear(operator: Transport) -> None:
    rng = np.random.default_rng(3)
    one, two = (rng.random((96, 128), np.float32) for _ in range(2))
    parts = []
    for emission in (one, two, 0.3 * one + 0.6 * two):
        parts.append(operator.render(operator.light(np.asarray(emission, np.float32)), "G"))
    for first, second, both in zip(*parts, strict=True):
        np.testing.assert_allclose(0.3 * first + 0.6 * second, both, atol=2e-5)


def test_correspondence_says_which_projector_pixel_lights_a_point(operator: Transport) -> None:
    x, y = operator.correspondence
    emission = np.zeros((96, 128), np.float32)
    emission[:, :64] = 1
    direct, _ = operator.render(operator.light(emission), "G")
    reached = operator.reached
    assert 0.7 < reached.mean() < 1
    assert (direct[reached & (x < 63)] > 0).all()
    assert (direct[x > 64] == 0).all()
    assert (direct[~reached & (x > 1) & (y > 1) & (y < 94)] == 0).all()


def test_light_is_never_negative_and_dark_gives_dark(operator: Transport) -> None:
    nothing = np.zeros((96, 128), np.float32)
    assert all(np.all(part == 0) for part in operator.render(operator.light(nothing), "R"))
    spot = nothing.copy()
    spot[40:48, 60:68] = 1
    direct, others = operator.render(operator.light(spot), "R")
    assert direct.min() >= 0
    assert others.min() > -1e-3  # smooth enlargement overshoots by a trace
    assert np.count_nonzero(others > 1e-5) > 5 * np.count_nonzero(direct)  # it goes everywhere


def test_frames_add_up() -> None:
    rig = Rig(SMALL_P | {"leakage": 0.0}, SMALL_C)
    board = checker(128, 96, 4, 0, 0)
    lit, unlit = rig.linear(board), rig.linear(255 - board)
    white, black = rig.linear(rig.solid(255)), rig.linear(rig.solid(0))
    unsaturated = white.max(-1) < 64000
    assert unsaturated.mean() > 0.95
    np.testing.assert_allclose((lit + unlit - black)[unsaturated], white[unsaturated], atol=3)


def test_leakage_shows_and_the_safe_state_is_darker_than_black() -> None:
    rig = Rig(SMALL_P | {"leakage": 0.05}, SMALL_C)
    off, black, white = (rig.linear(i) for i in (None, rig.solid(0), rig.solid(255)))
    bright = (white - off > 5000) & (white < 64000)
    assert float(np.median((black - off)[bright] / (white - off)[bright])) == pytest.approx(
        0.05, abs=0.001
    )


def test_gamma_bends_the_scale() -> None:
    rig = Rig(SMALL_P | {"gamma": 2.2, "leakage": 0.0, "defocus_px": 0.0}, SMALL_C)
    off, half, white = (rig.linear(i) for i in (None, rig.solid(128), rig.solid(255)))
    bright = (white - off > 5000) & (white < 64000)
    ratio = float(np.median((half - off)[bright] / (white - off)[bright]))
    assert ratio == pytest.approx((128 / 255) ** 2.2, rel=0.01)


def test_white_is_well_exposed_by_default() -> None:
    rig = Rig({}, {"noise": False})
    out = rig.take(rig.solid(255))
    scale = rig.camera.info().pixel_format.full_scale
    assert 0.72 < np.percentile(out, 99.8) / scale < 0.9
    assert np.mean(out == scale) < 0.001


@pytest.mark.parametrize("layout", ["RG", "GR", "GB", "BG"])
def test_bayer_is_rgb_with_two_colours_left_out(layout: str) -> None:
    rig = Rig(SMALL_P, SMALL_C)
    white = checker(128, 96, 8, 1, 2)
    colours = rig.take(white)
    rig.camera.stop()
    rig.camera.configure(CameraSettings(pixel_format=PixelFormat(f"Bayer{layout}16")))
    rig.camera.start(Acquisition.SOFTWARE)
    mosaicked = rig.take(white)
    channel = mosaic(layout, mosaicked.shape)
    wanted = np.take_along_axis(colours, channel[..., None], -1)[..., 0]
    assert np.abs(wanted.astype(int) - mosaicked).max() <= 1
    cell = "".join("RGB"[k] for k in channel[:2, :2].ravel())
    assert cell.startswith(layout)
    assert sorted(cell) == ["B", "G", "G", "R"]


def separate(rig: Rig, checkers: int, step: int, b: float) -> tuple[F32, F32]:
    """25 shifts of a checkerboard by max and min (paper, Eq. 9 with leakage)."""
    info = rig.projector.info()
    room = rig.linear(None)
    frames = [
        rig.linear(checker(info.width, info.height, checkers, step * i, step * j)) - room
        for i in range(5)
        for j in range(5)
    ]
    most, least = np.maximum.reduce(frames), np.minimum.reduce(frames)
    both = (1 + b) / 2
    return (most - least) / (1 - b), (least - b * most) / ((1 - b) * both)


def test_shifts_separate_into_the_truth_but_not_in_the_mirror() -> None:
    rig = Rig({}, {"pixel_format": "RGB16", "noise": False})
    direct, others = separate(rig, 8, 3, 0.02)
    truth = rig.camera.truth()
    scale = rig.camera.info().pixel_format.full_scale
    unsaturated = (truth["direct"] + truth["global"]).max(-1) < 0.95 * scale
    smooth = view(640, 480).smooth & unsaturated
    mirror = ~view(640, 480).smooth & unsaturated
    for got, want in ((direct, truth["direct"]), (others, truth["global"])):
        error = (got - want) / scale
        assert np.sqrt((error[smooth] ** 2).mean()) < 0.01
        assert np.sqrt((error[mirror] ** 2).mean()) > 0.05
    assert mirror.sum() > 5000


def test_a_cast_shadow_has_global_light_only() -> None:
    truth = Rig({}, {"pixel_format": "RGB16"}).camera.truth()
    shadow = (truth["direct"].max(-1) == 0) & view(640, 480).smooth
    assert 0.01 < shadow.mean() < 0.3
    assert truth["global"][shadow].max(-1).min() > 0


def test_wax_is_mostly_global_and_water_glows() -> None:
    truth = Rig({}, {"pixel_format": "RGB16"}).camera.truth()
    seen = view(640, 480)
    candle = seen.seen.index == 3
    lit = candle & (truth["direct"].max(-1) > 500)
    assert np.median(truth["global"][lit].sum(-1) / truth["direct"][lit].sum(-1)) > 1
    water = seen.water.region
    wall = truth["global"][20:60, 500:560].mean()
    assert water.cut(truth["global"])[60:100, 20:60].mean() > 3 * wall


def lamplight(rig: Rig, **options: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """What the left lamp adds to a picture, and what its truth says, direct and global together."""
    lamp = cast(VirtualLight, build("light", "virtual", "left", options, rig.context))
    lamp.connect()
    off = rig.linear(None)
    lamp.set(True)
    truth = rig.camera.truth(("left",))
    return rig.linear(None) - off, truth["direct"] + truth["global"]


def test_a_strong_lamp_has_as_strong_a_truth() -> None:
    on, whole = lamplight(Rig(SMALL_P, SMALL_C | {"exposure_us": 4000.0}), strength=3.0)
    dim = whole < 60000
    assert np.mean(dim) > 0.9
    np.testing.assert_allclose(on[dim], whole[dim], atol=3)


def test_the_truth_is_that_of_the_light_under_the_occluder() -> None:
    rig = Rig({}, SMALL_C)
    bench = rig.camera.bench
    del bench.sources["projector"]
    for name in ("left", "right"):
        build("light", "virtual", name, {}, rig.context)
    assert bench.main_sources() == ("left", "right")
    build("stage", "virtual", "stage", {"light": "right"}, rig.context)
    assert bench.main_sources() == ("right",)


def test_each_lamp_has_a_truth_of_its_own() -> None:
    rig = Rig(SMALL_P, SMALL_C)
    on, whole = lamplight(rig)
    dim = whole < 60000
    np.testing.assert_allclose(on[dim], whole[dim], atol=3)
    assert np.abs(whole - sum(rig.camera.truth().values())).max() > 5000
