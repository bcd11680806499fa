"""Whether umbrad may open what rig.toml names: device nodes, groups, udev rules."""

from __future__ import annotations

import grp
import os
from collections.abc import Iterable
from pathlib import Path

from daemon.config import DeviceTable
from daemon.doctor.verdict import failed, ok, skipped, warning
from protocol.messages.findings import Check

GROUPS = {"grbl": "dialout", "tmcl": "dialout", "v4l2": "video", "gphoto2": "plugdev"}
"""The group that owns a driver's device nodes on Debian and its kin."""
USB = {"dlpc350", "dlpc900", "pylon", "aravis"}
"""Drivers that open USB devices themselves: systemd/udev/71-umbra.rules lets them."""
RULES = tuple(
    Path(folder) / "71-umbra.rules"
    for folder in ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
)


def permissions(tables: Iterable[DeviceTable]) -> list[Check]:
    """A check for each device whose driver needs a permission."""
    return [check for table in tables if (check := permission(table)) is not None]


def permission(table: DeviceTable) -> Check | None:
    """Of one device; None where its driver needs none that is known here."""
    name = f"permission: {table.name}"
    port = table.options.get("port")
    if isinstance(port, str) and port.startswith("/dev/"):
        return node(name, Path(port))
    if table.driver in USB:
        return rules(name, RULES)
    group = GROUPS.get(table.driver)
    if group is None or (isinstance(port, str) and "://" in port):
        return None
    return member(name, group)


def node(name: str, path: Path) -> Check:
    """A device node by its path."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return failed(
            name, f"there is no {path}", "check cable and power; `umbra devices --scan` shows ports"
        )
    except OSError as error:
        return failed(name, f"{path}: {error.strerror}", "let umbrad's user read the folder")
    if os.access(path, os.R_OK | os.W_OK):
        return ok(name, f"{path} may be read and written")
    owner = _group_name(status.st_gid)
    return failed(
        name,
        f"umbrad may not open {path}",
        f"usermod -aG {owner} {_user()}, and restart umbrad; or install the udev rules",
    )


def member(name: str, group: str) -> Check:
    """Whether this process is in a group, where which node it will open is not known."""
    if os.geteuid() == 0:
        return ok(name, "umbrad is root, and may open every device")
    try:
        gid = grp.getgrnam(group).gr_gid
    except KeyError:
        return skipped(name, f"this system has no group {group}", "see docs/operators-guide.md")
    if gid in {os.getegid(), *os.getgroups()}:
        return ok(name, f"umbrad is in the group {group}")
    return warning(
        name,
        f"umbrad is not in the group {group}, which owns such devices",
        f"usermod -aG {group} {_user()}, and restart umbrad",
    )


def rules(name: str, places: Iterable[Path]) -> Check:
    """Whether Umbra's udev rules are installed."""
    found = next((path for path in places if path.is_file()), None)
    if found is not None:
        return ok(name, f"udev rules: {found}")
    if os.geteuid() == 0:
        return ok(name, "umbrad is root, and may open every device")
    return warning(
        name,
        "Umbra's udev rules are not installed: USB devices belong to root",
        "cp systemd/udev/71-umbra.rules /etc/udev/rules.d/ && udevadm control --reload && "
        "udevadm trigger",
    )


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def _user() -> str:
    return os.environ.get("USER") or "umbra"
