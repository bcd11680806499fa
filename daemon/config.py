"""rig.toml -> RigConfig, strict: an unknown key or a bad value is one line with the key's path."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from drivers import registry
from protocol.messages.access import DEFAULT_COMMAND, DEFAULT_EVENTS
from protocol.spelling import did_you_mean, fields_at

_T = TypeVar("_T", bound=msgspec.Struct)


class ConfigError(Exception):
    """The configuration cannot be used; the message is one line and names the key."""


class _Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


def _default_data() -> str:
    """systemd's StateDirectory, else the user's own state folder (XDG)."""
    if state := os.environ.get("STATE_DIRECTORY"):
        return state.split(":")[0]
    home = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return str(Path(home) / "umbra")


class RigSection(_Section, frozen=True, kw_only=True):
    """[rig]: what it is called, where its runs are kept."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")] = "umbra"
    data: str = msgspec.field(default_factory=_default_data)
    #: of a wholly virtual rig: how much faster than real its clock runs
    time_scale: Annotated[float, Meta(gt=0, le=1000)] = 1.0


class NetworkSection(_Section, frozen=True, kw_only=True):
    """[network]: the two endpoints, and the folder of keys that makes them CURVE."""

    command: str = DEFAULT_COMMAND
    events: str = DEFAULT_EVENTS
    keys: str = ""


class StorageSection(_Section, frozen=True, kw_only=True):
    """[storage]: what is kept, and how much room is left to others."""

    reserve_mb: Annotated[int, Meta(ge=0)] = 1024  # a run pauses before free space falls below
    keep_frames: bool = True  # False: a recording's own files are the originals
    keep_days: Annotated[float, Meta(gt=0)] | None = None  # older runs are deleted; None: never
    keep_gb: Annotated[float, Meta(gt=0)] | None = None  # ... and the oldest beyond this


class HooksSection(_Section, frozen=True, kw_only=True):
    """[hooks]: commands that are run when a run has ended, its JSON on their standard input."""

    done: tuple[str, ...] = ()  # the program and its arguments; no shell
    failed: tuple[str, ...] = ()  # also after an interruption
    timeout_s: Annotated[float, Meta(gt=0)] = 60.0


class SequencerSection(_Section, frozen=True, kw_only=True):
    """[sequencer]: how patient and how stubborn the step loop is."""

    attempts: Annotated[int, Meta(ge=1, le=100)] = 3  # exposures of a frame before it is missing
    ring_frames: Annotated[int, Meta(ge=2, le=4096)] = 16  # frames between camera and disk
    frame_timeout_s: Annotated[float, Meta(gt=0)] = 2.0  # beyond exposure and readout
    mode: Literal["auto", "hardware", "software", "free"] = "auto"  # see daemon.exposing.modes
    trigger_wired: bool = False  # the projector's trigger output goes to the camera's input
    period_us: Annotated[float, Meta(gt=0)] | None = None  # of a hardware-timed sequence


class CalibrationSection(_Section, frozen=True, kw_only=True):
    """[calibration]: for how long one is believed."""

    max_age_days: Annotated[float, Meta(gt=0)] = 90.0  # older ones are not applied


class DeviceTable(_Section, frozen=True, kw_only=True):
    """A device: its driver, and that driver's own keys (validated by it)."""

    name: str
    kind: str
    driver: str
    options: dict[str, Any]


class RigConfig(_Section, frozen=True, kw_only=True):
    """A whole rig. Devices are in the order camera, projector, stage, lights."""

    rig: RigSection
    network: NetworkSection
    storage: StorageSection
    sequencer: SequencerSection
    calibration: CalibrationSection
    hooks: HooksSection
    devices: tuple[DeviceTable, ...]

    def device(self, kind: str) -> DeviceTable | None:
        """The rig's device of a kind, if it has one."""
        return next((d for d in self.devices if d.kind == kind), None)


class _File(_Section, frozen=True, kw_only=True):
    """rig.toml as written; device tables are opened by their drivers."""

    rig: RigSection = RigSection()
    network: NetworkSection = NetworkSection()
    storage: StorageSection = StorageSection()
    sequencer: SequencerSection = SequencerSection()
    calibration: CalibrationSection = CalibrationSection()
    hooks: HooksSection = HooksSection()
    camera: dict[str, Any] | None = None
    projector: dict[str, Any] | None = None
    stage: dict[str, Any] | None = None
    light: tuple[dict[str, Any], ...] = ()


VIRTUAL = 'camera = {driver = "virtual"}\nprojector = {driver = "virtual"}\n'


def load(path: Path | None) -> RigConfig:
    """Read a file; None is the virtual rig on loopback. Raises ConfigError."""
    if path is None:
        return parse(VIRTUAL, "built-in")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(f"{path}: cannot be read: {reason}") from error
    return parse(text, str(path))


def parse(text: str, origin: str) -> RigConfig:
    """A configuration from TOML text. Raises ConfigError."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{origin}: not TOML: {error}") from error
    file = _convert(tables, _File, origin, "")
    devices = [
        _device(table, kind, kind, kind, origin)
        for kind in ("camera", "projector", "stage")
        if (table := getattr(file, kind)) is not None
    ]
    for i, table in enumerate(file.light):
        name = table.get("name")
        if not isinstance(name, str) or not name:
            raise ConfigError(f"{origin}: light[{i}].name: every light needs a name of its own")
        rest = {key: value for key, value in table.items() if key != "name"}
        devices.append(_device(rest, "light", name, f"light[{i}]", origin))
    named = [d.name for d in devices]
    if twice := {n for n in named if named.count(n) > 1}:
        raise ConfigError(f"{origin}: light.name: {sorted(twice)[0]!r} is taken")
    if file.rig.time_scale != 1.0 and any(d.driver != "virtual" for d in devices):
        raise ConfigError(f"{origin}: rig.time_scale: only a wholly virtual rig can be hurried")
    return RigConfig(
        rig=file.rig,
        network=file.network,
        storage=file.storage,
        sequencer=file.sequencer,
        calibration=file.calibration,
        hooks=file.hooks,
        devices=tuple(devices),
    )


def _device(table: dict[str, Any], kind: str, name: str, where: str, origin: str) -> DeviceTable:
    driver = table.get("driver")
    if not isinstance(driver, str):
        known = ", ".join(registry.names(kind))
        raise ConfigError(f"{origin}: {where}.driver: name one of {known}")
    options = {key: value for key, value in table.items() if key != "driver"}
    try:
        cls = registry.load(kind, driver)
    except registry.UnknownDriver as error:
        raise ConfigError(f"{origin}: {where}.driver: {error}") from error
    _convert(options, cls.options_type, origin, where)
    return DeviceTable(name=name, kind=kind, driver=driver, options=options)


def _convert(tables: Any, into: type[_T], origin: str, prefix: str) -> _T:
    try:
        return msgspec.convert(tables, into)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at `$")
        where = (prefix + path.rstrip("`")).lstrip(".")
        if problem.startswith("Object contains unknown field"):
            field = problem.split("`")[1]
            known = fields_at(into, path)
            where = f"{where}.{field}".lstrip(".")
            problem = "there is no such key" + did_you_mean(field, known)
        raise ConfigError(f"{origin}: {where}: {problem}") from error
