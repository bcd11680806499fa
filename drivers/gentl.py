"""Any vendor's cameras through its GenTL producer, a .cti file (extra `gentl`): FLIR, IDS ...

harvesters speaks to the producer. See drivers/streaming.py for states and retry policy. What a
producer says about a camera that was unplugged differs; an I/O error and an invalid handle are
DeviceLost. A producer opens once a process: while a camera is connected, `discover` finds none.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from genicam import genapi, gentl

from drivers.base.device import Context, Identity
from drivers.base.errors import DeviceLost, DeviceRefused, DeviceTimeout
from drivers.sfnc import Nodes, SfncCamera, SfncOptions, Value
from drivers.streaming import Buffer

with warnings.catch_warnings():  # it changes the whole program's filters
    from harvesters.core import Callback, Harvester, ImageAcquirer

PRODUCERS = "GENICAM_GENTL64_PATH"  # where vendors' installers say that their producers are
NAMESPACES = {  # of pixel formats: those with the numbers that a camera's PixelFormat has
    gentl.PIXELFORMAT_NAMESPACE_IDS.PIXELFORMAT_NAMESPACE_GEV,
    gentl.PIXELFORMAT_NAMESPACE_IDS.PIXELFORMAT_NAMESPACE_PFNC_32BIT,
}
READABLE = 2  # access modes from here on: write only, read only, read and write


class GentlOptions(SfncOptions, frozen=True, kw_only=True):
    """Keys of a `driver = "gentl"` camera."""

    producer: str = ""  # the vendor's .cti file; "": all that GENICAM_GENTL64_PATH names
    serial: str = ""  # "": the only camera there is


class _GenApiNodes(Nodes):
    """Features of a GenApi node map."""

    def __init__(self, node_map: Any) -> None:
        self._map = node_map

    def has(self, name: str) -> bool:
        return (
            bool(self._map.has_node(name))
            and self._map.get_node(name).get_access_mode() >= READABLE
        )

    def get(self, name: str) -> Value:
        value: Value = self._map.get_node(name).value
        return value

    def set(self, name: str, value: Value) -> None:
        node = self._map.get_node(name)
        if isinstance(node, genapi.IInteger):
            value = int(value)
        elif isinstance(node, genapi.IFloat):
            value = float(value)
        node.value = value

    def range(self, name: str) -> tuple[float, float, float]:
        node = self._map.get_node(name)
        step = float(node.inc) if isinstance(node, genapi.IInteger) else 0.0
        return float(node.min), float(node.max), step

    def entries(self, name: str) -> tuple[str, ...]:
        node = self._map.get_node(name)
        if not isinstance(node, genapi.IEnumeration):
            return ()
        return tuple(e.symbolic for e in node.entries if e.get_access_mode() >= READABLE)

    def code(self, name: str) -> int:
        return int(self._map.get_node(name).get_int_value()) & 0xFFFFFFFF

    def execute(self, name: str) -> None:
        self._map.get_node(name).execute()


class _Count(Callback):  # type: ignore[misc]
    """How often an event came."""

    def __init__(self) -> None:
        super().__init__()
        self.times = 0

    def emit(self, context: Any) -> None:
        """Called by harvesters in our own thread, within a fetch."""
        del context
        self.times += 1


class GentlCamera(SfncCamera):
    """A GenICam camera. A frame with missing parts comes `incomplete`, without its pixels."""

    options_type = GentlOptions
    options: GentlOptions

    def __init__(self, name: str, options: GentlOptions, context: Context) -> None:
        super().__init__(name, options, context)
        self._harvester: Harvester | None = None
        self._acquirer: Any = None
        self._broken = _Count()
        self._told = 0

    @classmethod
    def discover(cls, producer: str = "") -> list[dict[str, Any]]:
        """See Device. Asks every producer that GENICAM_GENTL64_PATH names, or the one given."""
        found = []
        for path in [producer] if producer else _producers():
            harvester = Harvester()
            try:
                harvester.add_file(path)
                harvester.update()
                found += [
                    {
                        "model": f"{info.vendor} {info.model}",
                        "serial": str(info.serial_number),
                        "options": {
                            "driver": "gentl",
                            "producer": path,
                            "serial": str(info.serial_number),
                        },
                    }
                    for info in harvester.device_info_list
                ]
            finally:
                harvester.reset()
        return found

    # ------------------------------------------------------------ what a driver adds

    def _attach(self) -> tuple[Nodes, Identity]:
        harvester = self._harvester = Harvester()
        for path in self._cti_files():
            harvester.add_file(path)
        harvester.update()
        found = list(harvester.device_info_list)
        serial = self.options.serial
        wanted = [info for info in found if serial in {"", str(info.serial_number)}]
        info = self._only(
            wanted,
            serial,
            (info.serial_number for info in found),
            "check cable, power and `serial`, and close other programs that use its producer",
        )
        self._acquirer = harvester.create(found.index(info))
        self._broken, self._told = _Count(), 0
        self._acquirer.add_callback(ImageAcquirer.Events.INCOMPLETE_BUFFER, self._broken)
        identity = Identity(
            f"{info.vendor} {info.model}", str(info.serial_number), str(info.version or "")
        )
        return _GenApiNodes(self._acquirer.remote_device.node_map), identity

    def _cti_files(self) -> list[str]:
        if self.options.producer:
            path = Path(self.options.producer).expanduser()
            if not path.is_file():
                raise self._refused("connect", f"no producer {path}", "check `producer`")
            return [str(path)]
        found = _producers()
        if not found:
            raise self._refused(
                "connect",
                f"no `producer` was given and {PRODUCERS} names none",
                "install the vendor's software, or name its .cti file as `producer`",
            )
        return found

    def _begin(self) -> None:
        self._acquirer.num_buffers = self.options.buffers
        self._acquirer.start()

    def _next(self, timeout_s: float) -> Buffer | None:
        raw = None
        if self._broken.times == self._told:
            raw = self._acquirer.try_fetch(
                timeout=max(timeout_s, 0.001), is_raw=True
            )  # 0: for ever
        if raw is None:
            if self._broken.times == self._told:
                return None
            self._told += 1  # harvesters keeps a buffer with missing parts, and only counts it
            nothing = np.empty(0, np.uint8)
            return Buffer(nothing, 0, 0, None, 0, lambda: None, incomplete=True)
        data = np.frombuffer(raw.raw_buffer, np.uint8)
        layout = self._layout()
        padding = int(raw.padding_x)
        return Buffer(
            data=data[raw.image_offset : raw.image_offset + raw.size_filled],
            width=int(raw.width),
            height=int(raw.height),
            block_id=int(raw.frame_id),
            device_ns=_timestamp_ns(raw),
            release=lambda: raw.parent.queue_buffer(raw),
            stride=layout.row_bytes(int(raw.width) * layout.samples) + padding if padding else None,
            pixel_code=_pixel_code(raw),
        )

    def _end(self) -> None:
        if self._acquirer is not None:
            self._acquirer.stop()

    def _release(self) -> None:
        acquirer, self._acquirer, self._nodes_or_none = self._acquirer, None, None
        harvester, self._harvester = self._harvester, None
        # It is gone: nothing to close.
        with contextlib.suppress(genapi.GenericException, gentl.GenericException):
            if acquirer is not None:
                acquirer.destroy()
        with contextlib.suppress(genapi.GenericException, gentl.GenericException):
            if harvester is not None:
                harvester.reset()

    @contextlib.contextmanager
    def _errors(self, phase: str) -> Iterator[None]:
        try:
            yield
        except (genapi.TimeoutException, gentl.TimeoutException) as error:
            raise DeviceTimeout(self.name, phase, _first_line(error), "try again") from error
        except (gentl.AccessDeniedException, gentl.ResourceInUseException) as error:
            raise self._refused(phase, "another program controls it", "close it") from error
        except (gentl.IoException, gentl.InvalidHandleException) as error:
            raise DeviceLost(
                self.name, phase, _first_line(error), "check its cable, then connect again"
            ) from error
        except (genapi.GenericException, gentl.GenericException) as error:
            raise DeviceRefused(
                self.name, phase, _first_line(error), "choose another value, or connect again"
            ) from error


def _producers() -> list[str]:
    folders = filter(None, os.environ.get(PRODUCERS, "").split(os.pathsep))
    return [str(path) for folder in folders for path in sorted(Path(folder).glob("*.cti"))]


def _timestamp_ns(raw: Any) -> int:
    try:
        return int(raw.timestamp_ns)
    except gentl.GenericException:  # it has no clock, or does not say how fast it goes
        return 0


def _pixel_code(raw: Any) -> int | None:
    """The frame's own pixel format, where its producer counts formats as cameras do."""
    try:
        if int(raw.pixel_format_name_space) not in NAMESPACES:
            return None
        return int(raw.pixel_format) & 0xFFFFFFFF
    except gentl.GenericException:  # it does not say
        return None


def _first_line(error: Exception) -> str:
    """What went wrong, without the place in the library's own source."""
    return str(error).split(" : ", maxsplit=1)[0].split("\n", maxsplit=1)[0].rstrip(".")
