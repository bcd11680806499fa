"""GigE Vision and USB3 Vision cameras of any vendor through Aravis (extra `aravis`).

Needs Debian's `gir1.2-aravis-0.8` beside the extra. See drivers/streaming.py for states and retry
policy. Aravis itself repeats a register access five times in 2.5 s, and others wait behind it: so
before a call that must not hang the camera is asked for a sign of life, and one that does not
answer within a second is DeviceLost. Letting go of a lost camera takes Aravis up to 12 s, and there
is no way to hurry it: that goes on in a thread of its own, and until it has ended `connect` is
DeviceLost, because the old connection's end would take control away from the new one.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import gi
import numpy as np

from drivers.base.device import Context, Identity
from drivers.base.errors import DeviceLost, DeviceRefused
from drivers.sfnc import Nodes, SfncCamera, SfncOptions, Value
from drivers.streaming import Buffer

try:
    gi.require_version("Aravis", "0.8")
    from gi.repository import Aravis, GLib
except ValueError as error:  # the bindings are there, the library is not
    raise ImportError(
        "Aravis 0.8: apt install gir1.2-aravis-0.8", name="gir1.2-aravis-0.8"
    ) from error


ALIVE_S = 1.0  # a camera answers within milliseconds
LETTING_GO_S = 2.0  # so long `connect` waits for the end of a lost connection


class AravisOptions(SfncOptions, frozen=True, kw_only=True):
    """Keys of a `driver = "aravis"` camera."""

    address: str = ""  # a network camera's; asks nobody else on the network
    serial: str = ""  # else by serial number, searched on all interfaces; "": the only one there is
    packet_size: int = 0  # bytes of a GigE packet; 0: the largest that comes through


class _AravisNodes(Nodes):
    """Features of an Aravis device."""

    def __init__(self, device: Any) -> None:
        self._device = device

    def has(self, name: str) -> bool:
        return bool(self._device.is_feature_available(name))

    def get(self, name: str) -> Value:
        device, node = self._device, self._device.get_feature(name)
        if isinstance(node, Aravis.GcBoolean):
            return bool(device.get_boolean_feature_value(name))
        if isinstance(node, Aravis.GcString):  # enumerations too
            return str(device.get_string_feature_value(name))
        if isinstance(node, Aravis.GcFloat):
            return float(device.get_float_feature_value(name))
        return int(device.get_integer_feature_value(name))

    def set(self, name: str, value: Value) -> None:
        device, node = self._device, self._device.get_feature(name)
        if isinstance(node, Aravis.GcBoolean):
            device.set_boolean_feature_value(name, bool(value))
        elif isinstance(node, Aravis.GcString):
            device.set_string_feature_value(name, str(value))
        elif isinstance(node, Aravis.GcFloat):
            device.set_float_feature_value(name, float(value))
        else:
            device.set_integer_feature_value(name, int(value))

    def range(self, name: str) -> tuple[float, float, float]:
        device = self._device
        if isinstance(device.get_feature(name), Aravis.GcFloat):
            low, high = device.get_float_feature_bounds(name)
            return float(low), float(high), 0.0
        low, high = device.get_integer_feature_bounds(name)
        return float(low), float(high), float(device.get_integer_feature_increment(name))

    def entries(self, name: str) -> tuple[str, ...]:
        if not isinstance(self._device.get_feature(name), Aravis.GcEnumeration):
            return ()
        return tuple(self._device.dup_available_enumeration_feature_values_as_strings(name))

    def code(self, name: str) -> int:
        return int(self._device.get_integer_feature_value(name)) & 0xFFFFFFFF

    def execute(self, name: str) -> None:
        self._device.execute_command(name)


class AravisCamera(SfncCamera):
    """A GenICam camera. Frames that lost packets come `incomplete`."""

    options_type = AravisOptions
    options: AravisOptions

    def __init__(self, name: str, options: AravisOptions, context: Context) -> None:
        super().__init__(name, options, context)
        self._camera: Any = None
        self._stream: Any = None
        self._lost = threading.Event()
        self._asking: threading.Thread | None = None
        self._streams: list[Any] = []  # of a lost camera: dropping one takes seconds, too
        self._leaving: threading.Thread | None = None

    @classmethod
    def discover(cls) -> list[dict[str, Any]]:
        """See Device. Asks on all network interfaces by broadcast."""
        Aravis.update_device_list()
        found = []
        for i in range(Aravis.get_n_devices()):
            serial, address = Aravis.get_device_serial_nbr(i), Aravis.get_device_address(i)
            network = Aravis.get_device_protocol(i) == "GigEVision"
            which = {"address": str(address)} if network else {"serial": str(serial)}
            found.append(
                {
                    "model": f"{Aravis.get_device_vendor(i)} {Aravis.get_device_model(i)}",
                    "serial": str(serial),
                    "options": {"driver": "aravis", **which},
                }
            )
        return found

    def check(self) -> None:
        """See Camera."""
        self._nodes("check")
        self._still_there("check")

    # ------------------------------------------------------------ what a driver adds

    def _attach(self) -> tuple[Nodes, Identity]:
        self._until_gone()
        self._lost.clear()
        try:
            camera = Aravis.Camera.new(self._device_id())
        except GLib.Error as error:
            refused = error.matches(
                Aravis.DeviceError.quark(), Aravis.DeviceError.PROTOCOL_ERROR_ACCESS_DENIED
            )
            if refused:
                raise self._refused(
                    "connect", "another program controls it", "close that program"
                ) from error
            raise self._absent() from error
        self._camera = camera
        device = camera.get_device()
        lost = self._lost  # the callback must not keep the camera alive
        device.connect("control-lost", lambda *_: lost.set())
        if camera.is_gv_device():
            if not device.is_controller():
                raise self._refused("connect", "another program controls it", "close that program")
            if self.options.packet_size:
                camera.gv_set_packet_size(self.options.packet_size)
            else:
                camera.gv_auto_packet_size()
        identity = Identity(
            f"{camera.get_vendor_name()} {camera.get_model_name()}",
            str(camera.get_device_serial_number()),
        )
        if self.options.serial and identity.serial != self.options.serial:
            raise self._refused(
                "connect",
                f"it is {identity.serial}, not {self.options.serial}",
                "correct `address` or `serial`",
            )
        return _AravisNodes(device), identity

    def _device_id(self) -> str:
        """What names the camera to Aravis, which opens nothing that it has not listed before."""
        if self.options.address:
            return self.options.address
        Aravis.update_device_list()
        found = {
            str(Aravis.get_device_serial_nbr(i)): str(Aravis.get_device_id(i))
            for i in range(Aravis.get_n_devices())
        }
        if self.options.serial in found:
            return found[self.options.serial]
        seen = ", ".join(found) or "none"
        if self.options.serial or not found:
            raise self._absent(f" (found: {seen})")
        if len(found) > 1:
            raise self._refused("connect", f"several cameras: {seen}", "name one by `serial`")
        return next(iter(found.values()))

    def _begin(self) -> None:
        self._stream = self._camera.create_stream(None, None)
        size = self._camera.get_payload()
        for _ in range(self.options.buffers):
            self._stream.push_buffer(Aravis.Buffer.new_allocate(size))
        self._camera.start_acquisition()

    def _next(self, timeout_s: float) -> Buffer | None:
        if self._lost.is_set():
            raise self._gone("grab")
        stream = self._stream
        buffer = stream.timeout_pop_buffer(round(timeout_s * 1e6))
        if buffer is None:
            return None
        whole = buffer.get_status() == Aravis.BufferStatus.SUCCESS
        return Buffer(  # one that is not whole may hold the facts of the frame before it
            data=np.frombuffer(buffer.get_data() if whole else b"", np.uint8),
            width=int(buffer.get_image_width()) if whole else 0,
            height=int(buffer.get_image_height()) if whole else 0,
            block_id=int(buffer.get_frame_id()) if whole else None,
            device_ns=int(buffer.get_timestamp()) if whole else 0,
            release=lambda: stream.push_buffer(buffer),
            stride=self._stride(buffer) if whole else None,
            incomplete=not whole,
            pixel_code=int(buffer.get_image_pixel_format()) & 0xFFFFFFFF if whole else None,
        )

    def _stride(self, buffer: Any) -> int | None:
        padding, _ = buffer.get_image_padding()
        if not padding:
            return None
        layout = self._layout()
        return layout.row_bytes(int(buffer.get_image_width()) * layout.samples) + int(padding)

    def _end(self) -> None:
        stream, self._stream = self._stream, None  # its last reference ends its thread
        if stream is not None and self._answers():
            self._camera.stop_acquisition()
        elif stream is not None:
            self._streams.append(stream)

    def _release(self) -> None:
        held = [self._asking, self._nodes_or_none, self._camera, self._stream, *self._streams]
        self._asking = self._nodes_or_none = self._camera = self._stream = None
        self._streams = []
        if held[0] is None and not self._lost.is_set():
            return  # `held` was all that there was, and ends here

        def let_go() -> None:
            if isinstance(asking := held[0], threading.Thread):
                asking.join()  # it holds the camera, too
            held.clear()

        if any(held):
            self._leaving = threading.Thread(target=let_go, name=f"{self.name}-leave", daemon=True)
            self._leaving.start()
            if not self._lost.is_set():
                self._leaving.join()

    def _until_gone(self) -> None:
        """Wait for the end of the connection before."""
        leaving = self._leaving
        if leaving is not None:
            leaving.join(LETTING_GO_S)
            if leaving.is_alive():
                raise DeviceLost(
                    self.name,
                    "connect",
                    "the connection that was lost is still being closed",
                    "connect again in a few seconds",
                )
        self._leaving = None

    def _ready(self) -> None:
        self._still_there("trigger")

    def _still_there(self, phase: str) -> None:
        """A camera that lost its power says nothing, and its stream only stays empty: ask it."""
        if not self._answers():
            raise self._gone(phase)

    def _answers(self) -> bool:
        """Whether the camera answers within a second; if not, it is lost."""
        nodes = self._nodes("check")
        answered = threading.Event()

        def ask() -> None:
            with contextlib.suppress(GLib.Error):  # no answer is the answer
                nodes.get("Width")
                answered.set()

        if not self._lost.is_set():
            self._asking = threading.Thread(target=ask, name=f"{self.name}-ask", daemon=True)
            self._asking.start()
            if not answered.wait(ALIVE_S):
                self._lost.set()
        return not self._lost.is_set()

    @contextlib.contextmanager
    def _errors(self, phase: str) -> Iterator[None]:
        try:
            yield
        except GLib.Error as error:
            kinds = Aravis.DeviceError
            if self._lost.is_set() or any(
                error.matches(kinds.quark(), kind)
                for kind in (kinds.TIMEOUT, kinds.NOT_CONNECTED, kinds.NOT_FOUND)
            ):
                self._lost.set()
                raise self._gone(phase) from error
            raise DeviceRefused(
                self.name, phase, str(error.message), "choose another value, or connect again"
            ) from error

    def _gone(self, phase: str) -> DeviceLost:
        return DeviceLost(
            self.name, phase, "it no longer answers", "check cable and power, then connect again"
        )

    def _absent(self, more: str = "") -> DeviceLost:
        which = self.options.address or self.options.serial or "at all"
        return DeviceLost(
            self.name,
            "connect",
            f"no camera {which}{more}",
            "check cable, power and that its address is in this computer's network",
        )
