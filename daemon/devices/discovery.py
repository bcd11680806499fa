"""What is attached: each driver is asked in a process of its own, with a deadline.

Vendors' libraries enumerate for seconds, print, hang and crash, and what one does to enumerate can
disturb a camera that it has open in the same process. In a process of its own none of that reaches
the daemon: one that is late is killed, and its failure is a line among the others.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import Iterable
from typing import Any

import msgspec
import structlog

from daemon.config import DeviceTable
from drivers import registry
from drivers.base.device import Device
from drivers.base.errors import DeviceError
from protocol.errors import Code, UmbraError
from protocol.messages.findings import Found, Search
from protocol.messages.rig import DeviceInfo

_START_S = 60.0  # for a process to start, one of many, on a busy machine
_ASKED = b"\n"  # what the process says first, when the driver is about to be asked

KINDS = ("camera", "projector", "stage", "light")

log = structlog.get_logger(__name__)


class _Answer(msgspec.Struct, frozen=True, kw_only=True):
    """What the process says on its standard output."""

    able: bool = True  # False: a driver that cannot tell (virtual, replay, a network address)
    found: tuple[dict[str, Any], ...] = ()
    needed: tuple[str, ...] = ()  # keys without a default, that a person must add
    problem: str = ""


async def discover(
    wanted: Iterable[str],
    timeout_s: float,
    tables: Iterable[DeviceTable],
    devices: Iterable[DeviceInfo],
) -> tuple[Search, ...]:
    """Ask the drivers named, or every installed one. Raises UmbraError(bad_request) for a name
    that no driver has. Failures are in the searches, never raised."""
    named = set(wanted)
    installed = [(kind, driver) for kind in KINDS for driver in registry.names(kind)]
    if unknown := named - {driver for _, driver in installed}:
        known = ", ".join(sorted({driver for _, driver in installed}))
        raise UmbraError(
            Code.BAD_REQUEST,
            f"no driver {sorted(unknown)[0]!r}: there are {known}",
            "$.command.drivers",
        )
    chosen = [pair for pair in installed if not named or pair[1] in named]
    answers = await asyncio.gather(*(_ask(kind, driver, timeout_s) for kind, driver in chosen))
    own = _Own(tables, devices)
    return tuple(
        _search(kind, driver, answer, own)
        for (kind, driver), answer in zip(chosen, answers, strict=True)
        if answer.able or driver in named
    )


async def _ask(kind: str, driver: str, timeout_s: float) -> _Answer:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "daemon.devices.discovery",
        kind,
        driver,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    try:
        # Thirteen Pythons at once start slowly on a small or busy machine: the driver's time is its
        # library's, and begins when it is asked.
        await asyncio.wait_for(process.stdout.read(1), _START_S)
        said, complaint = await asyncio.wait_for(process.communicate(), timeout_s)
    except TimeoutError:
        return _Answer(problem=f"it had found nothing after {timeout_s:g} s, and was ended")
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode != 0 or not said:
        last = complaint.decode(errors="replace").strip().splitlines()[-1:]
        log.warning("discovery failed", driver=driver, status=process.returncode, said=last)
        return _Answer(
            problem=f"its library ended with status {process.returncode}"
            + (f": {last[0]}" if last else "")
        )
    return msgspec.json.decode(said, type=_Answer)


class _Own:
    """Which device of the rig something found is."""

    def __init__(self, tables: Iterable[DeviceTable], devices: Iterable[DeviceInfo]) -> None:
        serials = {info.name: info.serial for info in devices}
        self._mine = [(table, serials.get(table.name, "")) for table in tables]

    def name(self, kind: str, driver: str, serial: str, options: dict[str, Any]) -> str:
        """The device's name in rig.toml; "": it is none of this rig's."""
        for table, own_serial in self._mine:
            if (table.kind, table.driver) != (kind, driver):
                continue
            told = {key: table.options[key] for key in options if key in table.options}
            if (serial and serial == own_serial) or (
                told and all(_same(told[key], options[key]) for key in told)
            ):
                return table.name
        return ""


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, str) and isinstance(other, str) and one.startswith("/dev/"):
        return os.path.realpath(one) == os.path.realpath(other)
    return bool(one == other)


def _search(kind: str, driver: str, answer: _Answer, own: _Own) -> Search:
    if not answer.able:
        problem = "this driver cannot tell what is attached: name the device in rig.toml"
        return Search(kind=kind, driver=driver, problem=problem)
    found = []
    for item in answer.found:
        options = {k: v for k, v in item.get("options", {}).items() if k != "driver"}
        serial = str(item.get("serial", ""))
        found.append(
            Found(
                model=str(item.get("model", "")),
                serial=serial,
                toml=toml(kind, driver, options, answer.needed),
                used_by=own.name(kind, driver, serial, options),
            )
        )
    return Search(kind=kind, driver=driver, found=tuple(found), problem=answer.problem)


def toml(kind: str, driver: str, options: dict[str, Any], needed: Iterable[str] = ()) -> str:
    """A device's table for rig.toml; `needed` keys that are not known are left to fill in."""
    head = '[[light]]\nname = "light"' if kind == "light" else f"[{kind}]"
    lines = [head, f"driver = {_value(driver)}"]
    lines += [f"{key} = {_value(value)}" for key, value in options.items()]
    lines += [f"# {key} =            # needed" for key in needed if key not in options]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """A TOML value. JSON's strings, numbers, booleans and lists are TOML's as well."""
    return json.dumps(value, ensure_ascii=False)


# ---------------------------------------------------------------- the process


def _look(kind: str, driver: str) -> _Answer:
    try:
        cls = registry.load(kind, driver)
    except registry.UnknownDriver as error:
        return _Answer(problem=str(error))
    if cls.discover.__func__ is Device.discover.__func__:  # type: ignore[attr-defined]
        return _Answer(able=False)
    needed = tuple(
        field.encode_name for field in msgspec.structs.fields(cls.options_type) if field.required
    )
    try:
        return _Answer(found=tuple(cls.discover()), needed=needed)
    except DeviceError as error:
        return _Answer(problem=str(error))


def main(kind: str, driver: str) -> None:
    """Look, and say it on what was standard output; libraries that print go to standard error."""
    answer = os.dup(1)
    os.dup2(2, 1)
    os.write(answer, _ASKED)
    os.write(answer, msgspec.json.encode(_look(kind, driver)))
    os.close(answer)


if __name__ == "__main__":
    main(*sys.argv[1:])
