"""Basler cameras through Basler's own pylon (extra `pylon`): GigE, USB3 and the SDK's emulation.

See drivers/streaming.py for states and retry policy. A camera that is in use by another program is
DeviceRefused; one that is unplugged is DeviceLost in the call that waits, or in the next.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from pypylon import genicam, pylon

from drivers.base.device import Context, Identity
from drivers.base.errors import DeviceLost, DeviceRefused, DeviceTimeout
from drivers.sfnc import Nodes, SfncCamera, SfncOptions, Value
from drivers.streaming import HALT_SLICE_S, Buffer

READY_TIMEOUT_S = 2.0  # beyond the exposure: a camera that is not ready by then has lost a trigger


class PylonOptions(SfncOptions, frozen=True, kw_only=True):
    """Keys of a `driver = "pylon"` camera."""

    serial: str = ""  # as printed on the camera; "": the only one there is
    user_id: str = ""  # the name that was stored in it
    transport: str = ""  # BaslerGigE, BaslerUsb, BaslerCamEmu; "": all (asks the whole network)


class _PylonNodes(Nodes):
    """Features of a pylon node map."""

    def __init__(self, node_map: Any) -> None:
        self._map = node_map

    def has(self, name: str) -> bool:
        return bool(genicam.IsAvailable(self._map.GetNode(name)))

    def get(self, name: str) -> Value:
        value: Value = self._map.GetNode(name).GetValue()
        return value

    def set(self, name: str, value: Value) -> None:
        node = self._map.GetNode(name)
        if type(node).__name__ == "IntegerParameter":
            value = int(value)
        elif type(node).__name__ == "FloatParameter":
            value = float(value)
        node.SetValue(value)

    def range(self, name: str) -> tuple[float, float, float]:
        node = self._map.GetNode(name)
        whole = type(node).__name__ == "IntegerParameter"
        return float(node.GetMin()), float(node.GetMax()), float(node.GetInc()) if whole else 0.0

    def entries(self, name: str) -> tuple[str, ...]:
        node = self._map.GetNode(name)
        if type(node).__name__ != "EnumParameter":
            return ()
        return tuple(str(entry) for entry in node.GetSettableValues())

    def code(self, name: str) -> int:
        return int(self._map.GetNode(name).GetIntValue()) & 0xFFFFFFFF

    def execute(self, name: str) -> None:
        self._map.GetNode(name).Execute()


class PylonCamera(SfncCamera):
    """A Basler camera. Timestamps come from the camera's clock where it can be latched."""

    options_type = PylonOptions
    options: PylonOptions

    def __init__(self, name: str, options: PylonOptions, context: Context) -> None:
        super().__init__(name, options, context)
        self._camera: Any = None

    @classmethod
    def discover(cls, transport: str = "") -> list[dict[str, Any]]:
        """See Device. Without a `transport` this asks the whole network by broadcast."""
        return [
            {
                "model": str(info.GetModelName()),
                "serial": str(info.GetSerialNumber()),
                "options": {
                    "driver": "pylon",
                    "serial": str(info.GetSerialNumber()),
                    "transport": str(info.GetDeviceClass()),
                },
            }
            for info in _enumerate(transport)
        ]

    def check(self) -> None:
        """See SfncCamera; pylon knows of an unplugged camera without asking it."""
        super().check()
        self._still_there("check")

    # ------------------------------------------------------------ what a driver adds

    def _attach(self) -> tuple[Nodes, Identity]:
        options = self.options
        found = _enumerate(options.transport)
        wanted = [
            info
            for info in found
            if (not options.serial or info.GetSerialNumber() == options.serial)
            and (not options.user_id or info.GetUserDefinedName() == options.user_id)
        ]
        info = self._only(
            wanted,
            options.serial or options.user_id,
            (info.GetSerialNumber() for info in found),
            "check cable and power, and `serial`",
        )
        self._camera = pylon.InstantCamera(_transport(info).CreateDevice(info))
        self._camera.Open()
        identity = Identity(
            str(info.GetModelName()),
            str(info.GetSerialNumber()),
            str(info.GetDeviceVersion()) if info.IsDeviceVersionAvailable() else "",
        )
        return _PylonNodes(self._camera.GetNodeMap()), identity

    def _begin(self) -> None:
        self._camera.MaxNumBuffer.SetValue(self.options.buffers)
        self._camera.StartGrabbing(pylon.GrabStrategy_OneByOne)

    def _next(self, timeout_s: float) -> Buffer | None:
        result = self._camera.RetrieveResult(round(timeout_s * 1000), pylon.TimeoutHandling_Return)
        if not result.IsValid():
            self._still_there("grab")
            return None
        if not result.GrabSucceeded():
            self._still_there("grab")
        padding = int(result.PaddingX)
        aligned, stride = result.GetStride()
        return Buffer(
            data=np.frombuffer(result.GetBuffer(), np.uint8),
            width=int(result.Width),
            height=int(result.Height),
            block_id=int(result.BlockID),
            device_ns=round(result.GetTimeStamp() * self._tick_ns),
            release=result.Release,
            stride=int(stride) if padding and aligned else None,
            incomplete=not result.GrabSucceeded(),
            pixel_code=int(result.GetPixelType()) & 0xFFFFFFFF,
        )

    def _end(self) -> None:
        if self._camera is not None:
            self._camera.StopGrabbing()

    def _release(self) -> None:
        camera, self._camera, self._nodes_or_none = self._camera, None, None
        if camera is not None:
            with contextlib.suppress(genicam.GenericException):  # it is gone: nothing to close
                camera.DestroyDevice()

    def _ready(self) -> None:
        if not self._camera.CanWaitForFrameTriggerReady():
            return
        deadline = self.clock.now_ns() + self._exposure_ns + round(READY_TIMEOUT_S * 1e9)
        while not self._camera.WaitForFrameTriggerReady(
            round(HALT_SLICE_S * 1000), pylon.TimeoutHandling_Return
        ):
            self._unless_halted("trigger")
            self._still_there("trigger")
            if self.clock.now_ns() > deadline:
                raise DeviceTimeout(
                    self.name, "trigger", "it is not ready for a trigger", "start it again"
                )

    @contextlib.contextmanager
    def _errors(self, phase: str) -> Iterator[None]:
        try:
            yield
        except genicam.TimeoutException as error:
            raise DeviceTimeout(self.name, phase, _first_line(error), "try again") from error
        except genicam.GenericException as error:
            self._still_there(phase)
            if phase == "connect" and isinstance(error, genicam.RuntimeException):
                raise DeviceRefused(
                    self.name,
                    phase,
                    _first_line(error),
                    "close other programs that use it, and check its power",
                ) from error
            raise DeviceRefused(
                self.name, phase, _first_line(error), "choose another value, or connect again"
            ) from error

    def _still_there(self, phase: str) -> None:
        if self._camera is not None and self._camera.IsCameraDeviceRemoved():
            raise DeviceLost(self.name, phase, "it was unplugged", "plug it in, then connect again")


def _enumerate(transport: str) -> list[Any]:
    factory = pylon.TlFactory.GetInstance()
    if not transport:
        return list(factory.EnumerateDevices())
    layer = factory.CreateTl(transport)
    return list(layer.EnumerateDevices()) if layer is not None else []


def _transport(info: Any) -> Any:
    return pylon.TlFactory.GetInstance().CreateTl(info.GetDeviceClass())


def _first_line(error: Exception) -> str:
    """What went wrong, without the place in pylon's own source."""
    return str(error).split(" : ", maxsplit=1)[0].split("\n", maxsplit=1)[0].rstrip(".")
