"""What pylon, Aravis and GenTL share, over a camera of features in a dict and buffers in a list:
the parts that the vendors' emulations do not have (packed formats, clocks, pulses, old names)."""

from __future__ import annotations

import contextlib
from collections import deque
from contextlib import AbstractContextManager
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.camera import Acquisition, CameraSettings, Frame
from drivers.base.device import Context, Identity
from drivers.base.errors import DeviceGarbled, DeviceRefused
from drivers.base.pixelformat import PixelFormat
from drivers.clock import Clock
from drivers.sfnc import LATCH_EVERY_NS, Nodes, SfncCamera, SfncOptions, Value
from drivers.streaming import Buffer

MS = 1_000_000


class Hands(Clock):
    """A clock that only moves when it is told to."""

    def __init__(self) -> None:
        self.at = 5_000 * MS

    def now_ns(self) -> int:
        return self.at

    def utc_ns(self) -> int:
        return self.at + 10**18

    def wait_until(self, deadline_ns: int, wake: Any = None) -> bool:
        self.at = max(self.at, deadline_ns)
        return False


class DictNodes(Nodes):
    """Features in a dict: a value, or a value with its range or entries."""

    def __init__(self, clock: Hands, **features: Any) -> None:
        self.clock = clock
        self.features: dict[str, Any] = {
            "Width": (64, 16, 64, 16),
            "Height": (48, 2, 48, 2),
            "OffsetX": (0, 0, 48, 4),
            "OffsetY": (0, 0, 46, 2),
            "WidthMax": 64,
            "HeightMax": 48,
            "ExposureTime": (4000.0, 20.0, 1e6, 0),
            "Gain": (0.0, 0.0, 24.0, 0),
            "PixelFormat": ("Mono8", "Mono8", "BayerRG12", "BayerRG12p", "BayerRG12Packed"),
            "AcquisitionMode": ("SingleFrame", "SingleFrame", "Continuous"),
            "TriggerSelector": ("FrameBurstStart", "FrameBurstStart", "FrameStart"),
            "TriggerMode": ("Off", "Off", "On"),
            "TriggerSource": ("Software", "Software", "Line1", "Line3"),
            "TriggerActivation": ("FallingEdge", "RisingEdge", "FallingEdge"),
            "TriggerSoftware": None,
            "ExposureAuto": ("Continuous", "Off", "Continuous"),
            "GammaEnable": True,
        } | features
        self.done: list[tuple[str, Value]] = []
        self.device_ns = 0  # added to the rig's clock on a latch

    def has(self, name: str) -> bool:
        return name in self.features

    def get(self, name: str) -> Value:
        kept = self.features[name]
        value: Value = kept[0] if isinstance(kept, tuple) else kept
        return value

    def set(self, name: str, value: Value) -> None:
        kept = self.features[name]
        self.features[name] = (value, *kept[1:]) if isinstance(kept, tuple) else value
        self.done.append((name, value))

    def range(self, name: str) -> tuple[float, float, float]:
        _, low, high, step = self.features[name]
        return low, high, step

    def entries(self, name: str) -> tuple[str, ...]:
        kept = self.features[name]
        return tuple(kept[1:]) if isinstance(kept, tuple) and isinstance(kept[0], str) else ()

    def code(self, name: str) -> int:
        return self.entries(name).index(str(self.get(name)))

    def execute(self, name: str) -> None:
        self.done.append((name, True))
        self.clock.at += 2 * MS  # there and back
        if name == "TimestampLatch":
            self.features["TimestampLatchValue"] = self.clock.at - MS + self.device_ns
        if name == "GevTimestampControlLatch":  # in ticks of 8 ns
            self.features["GevTimestampValue"] = (self.clock.at - MS + self.device_ns) // 8


class DictCamera(SfncCamera):
    """Hands out the buffers of `to_come`, and counts those that came back."""

    def __init__(self, nodes: DictNodes, **options: Any) -> None:
        super().__init__("cam", msgspec.convert(options, SfncOptions), Context(clock=nodes.clock))
        self.nodes = nodes
        self.to_come: deque[Buffer] = deque()
        self.back = 0
        self.began = 0

    def send(
        self,
        data: bytes,
        *,
        block_id: int | None = 1,
        device_ns: int = 0,
        stride: int | None = None,
        incomplete: bool = False,
        size: tuple[int, int] | None = None,
    ) -> None:
        width, height = size or (self.info().width, self.info().height)
        flat = np.frombuffer(data, np.uint8)
        self.to_come.append(
            Buffer(flat, width, height, block_id, device_ns, self._returned, stride, incomplete)
        )

    def _returned(self) -> None:
        self.back += 1

    def _attach(self) -> tuple[Nodes, Identity]:
        return self.nodes, Identity("Dict", "1")

    def _begin(self) -> None:
        self.began += 1

    def _next(self, timeout_s: float) -> Buffer | None:
        self.clock.wait(timeout_s)
        return self.to_come.popleft() if self.to_come else None

    def _end(self) -> None:
        self.to_come.clear()

    def _release(self) -> None:
        self._nodes_or_none = None

    def _errors(self, phase: str) -> AbstractContextManager[None]:
        return contextlib.nullcontext()


def connected(nodes: DictNodes | None = None, **options: Any) -> DictCamera:
    cam = DictCamera(nodes or DictNodes(Hands()), **options)
    cam.connect()
    return cam


def grab(cam: DictCamera) -> Frame:
    info = cam.info()
    return cam.grab(np.empty(info.shape, info.pixel_format.dtype), 0.1)


def pack12(mosaic: NDArray[Any], native: str) -> bytes:
    first, second = mosaic.ravel()[0::2], mosaic.ravel()[1::2]
    if native.endswith("p"):
        three = (first & 255, first >> 8 | (second & 15) << 4, second >> 4)
    else:
        three = (first >> 4, first & 15 | (second & 15) << 4, second >> 4)
    return np.stack(three, axis=-1).astype(np.uint8).tobytes()


# ---------------------------------------------------------------- pixels


@pytest.mark.parametrize("native", ["BayerRG12", "BayerRG12p", "BayerRG12Packed"])
@pytest.mark.parametrize("padding", [0, 5])
def test_12_bit_mosaics_come_out_the_same_however_they_were_packed(
    native: str, padding: int
) -> None:
    mosaic = np.random.default_rng(0).integers(0, 4096, (48, 64), np.uint16)
    cam = connected(pixel_format=native)
    assert cam.info().pixel_format is PixelFormat.BAYER_RG12
    rows = [row.tobytes() if native == "BayerRG12" else pack12(row, native) for row in mosaic]
    cam.start(Acquisition.FREE)
    stride = len(rows[0]) + padding if padding else None
    cam.send(b"".join(row + bytes(padding) for row in rows), stride=stride)
    np.testing.assert_array_equal(grab(cam).pixels, mosaic)
    assert cam.back == 1


def test_asked_for_a_format_it_stays_packed_or_else_takes_the_plain_one() -> None:
    cam = connected()
    cam.configure(CameraSettings(pixel_format=PixelFormat.BAYER_RG12))
    assert cam.facts()["pixel_format"] == "BayerRG12"
    cam = connected(pixel_format="BayerRG12p")
    cam.configure(CameraSettings(pixel_format=PixelFormat.BAYER_RG12))
    assert cam.facts()["pixel_format"] == "BayerRG12p"


def test_a_format_that_cannot_be_used_gives_way_to_one_that_can() -> None:
    cam = connected(DictNodes(Hands(), PixelFormat=("YUV422_8", "YUV422_8", "Mono8")))
    assert cam.info().pixel_format is PixelFormat.MONO8
    with pytest.raises(DeviceRefused, match="none but unknown pixel formats: YUV422_8"):
        connected(DictNodes(Hands(), PixelFormat=("YUV422_8", "YUV422_8")))


def test_buffers_that_make_no_sense_are_garbled_and_given_back() -> None:
    cam = connected()
    cam.start(Acquisition.FREE)
    cam.send(bytes(100))
    with pytest.raises(DeviceGarbled, match="a 64 x 48 Mono8 takes 3072 bytes, not 100"):
        grab(cam)
    cam.send(bytes(3072), size=(32, 96))
    with pytest.raises(DeviceGarbled, match="a frame of 32 x 96 came; it was set to 64 x 48"):
        grab(cam)
    assert cam.back == 2
    cam.send(bytes(100), incomplete=True)
    assert grab(cam).incomplete


def test_frames_are_numbered_by_the_cameras_own_count() -> None:
    cam = connected()
    cam.start(Acquisition.FREE)
    for block_id in (65533, 65534, None, 1, 2, 5):  # the third came broken and says nothing
        cam.send(bytes(3072), block_id=block_id, incomplete=block_id is None)
    assert [grab(cam).sequence for _ in range(6)] == [0, 1, 2, 3, 4, 7]
    cam.start(Acquisition.FREE)
    cam.send(bytes(3072), block_id=900)
    assert grab(cam).sequence == 0


# ---------------------------------------------------------------- settings


def test_automatic_corrections_are_switched_off() -> None:
    cam = connected()
    assert ("ExposureAuto", "Off") in cam.nodes.done
    assert ("GammaEnable", False) in cam.nodes.done


def test_old_cameras_names_win_because_the_new_ones_are_aliases() -> None:
    nodes = DictNodes(
        Hands(),
        ExposureTimeAbs=(1000.0, 100.0, 1e5, 0),
        GainRaw=(10, 0, 500, 1),
        Gain=(1.0, 0, 9, 0),
    )
    cam = connected(nodes, exposure_us=2000.0)
    assert cam.nodes.get("ExposureTimeAbs") == 2000.0
    assert cam.info().exposure_range_us == (100.0, 1e5)


@pytest.mark.parametrize(
    ("roi", "says"),
    [
        ((0, 0, 40, 48), "Width 40 is not possible; choose 16 to 64 in steps of 16"),
        ((0, 0, 64, 47), "Height 47 is not possible"),
        ((6, 0, 32, 48), "OffsetX 6 is not possible with Width 32; choose 0 to 32 in steps of 4"),
        ((36, 0, 32, 48), "OffsetX 36 is not possible with Width 32"),
        ((0, -2, 64, 46), "OffsetY -2 is not possible"),
    ],
)
def test_regions_are_checked_before_anything_is_set(
    roi: tuple[int, int, int, int], says: str
) -> None:
    cam = connected()
    cam.nodes.done.clear()
    with pytest.raises(DeviceRefused, match=says):
        cam.configure(CameraSettings(exposure_us=100.0, roi=roi))
    assert cam.nodes.done == []
    assert cam.configure(CameraSettings(roi=(32, 2, 32, 46))).roi == (32, 2, 32, 46)


# ---------------------------------------------------------------- triggers


def test_a_pulse_on_the_line_and_edge_that_were_named() -> None:
    cam = connected(trigger_line="Line3", trigger_edge="rising")
    cam.nodes.done.clear()
    cam.start(Acquisition.HARDWARE)
    assert cam.nodes.get("TriggerSelector") == "FrameStart"
    assert cam.nodes.get("TriggerSource") == "Line3"
    assert cam.nodes.get("TriggerActivation") == "RisingEdge"
    assert cam.nodes.get("AcquisitionMode") == "Continuous"
    assert cam.nodes.done[-1] == ("TriggerMode", "On")  # last, so that no other line is listened to
    cam.start(Acquisition.FREE)
    assert cam.nodes.get("TriggerMode") == "Off"


# ---------------------------------------------------------------- times


@pytest.mark.parametrize(
    "clock",
    [
        {"TimestampLatch": None, "TimestampLatchValue": 0},
        {
            "GevTimestampControlLatch": None,
            "GevTimestampValue": 0,
            "GevTimestampTickFrequency": 125_000_000,
        },
    ],
)
def test_a_latched_clock_gives_the_exposure_on_the_rigs(clock: dict[str, Any]) -> None:
    nodes = DictNodes(Hands(), **clock)
    nodes.device_ns = 77_000 * MS
    cam = connected(nodes)
    cam.start(Acquisition.FREE)
    for k in range(3):
        exposed = cam.clock.now_ns()
        nodes.clock.at += (30 + 20 * k) * MS  # however long it is on its way
        cam.send(bytes(3072), block_id=k + 1, device_ns=exposed + nodes.device_ns)
        frame = grab(cam)
        assert abs(frame.start_ns - exposed) <= 8
        assert frame.end_ns - frame.start_ns == 4 * MS
        assert frame.utc_ns == frame.start_ns + 10**18
    nodes.clock.at += LATCH_EVERY_NS
    nodes.device_ns += 3 * MS  # the clocks have drifted apart
    exposed = cam.clock.now_ns()
    cam.send(bytes(3072), block_id=4, device_ns=exposed + nodes.device_ns)
    assert abs(grab(cam).start_ns - exposed) <= 8


def test_a_clock_that_cannot_be_latched_is_paired_with_the_least_delayed_arrival() -> None:
    nodes = DictNodes(Hands(), SensorReadoutTime=6000.0)
    cam = connected(nodes)
    assert cam.info().readout_s == 0.006
    cam.start(Acquisition.FREE)
    off = 12_345 * MS
    errors = []
    for k, delay in enumerate((9, 1, 14, 3, 8)):
        exposed = nodes.clock.at
        nodes.clock.at += (4 + 6 + delay) * MS
        cam.send(bytes(3072), block_id=k + 1, device_ns=exposed + off)
        cam._next, handed = lambda timeout_s: cam.to_come.popleft(), cam._next  # type: ignore[method-assign]
        errors.append(grab(cam).start_ns - exposed)
        cam._next = handed  # type: ignore[method-assign]
    assert errors == [9 * MS, MS, MS, MS, MS]


def test_without_a_clock_a_trigger_bounds_the_exposure() -> None:
    cam = connected()
    cam.start(Acquisition.SOFTWARE)
    before = cam.clock.now_ns()
    start, end = cam.trigger()
    assert (start, end) == (before, before + 2 * MS + 4 * MS)  # sent, taken, exposed
    cam.send(bytes(3072))
    frame = grab(cam)
    assert (frame.start_ns, frame.end_ns) == (start, end)
