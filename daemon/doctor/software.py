"""The environment and the configuration that umbrad runs with."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from daemon import config
from daemon.config import ConfigError, RigConfig
from daemon.doctor.verdict import failed, ok, warning
from protocol.messages.findings import Check


def environment() -> Check:
    """python-daemon brings a package `daemon` too: whichever was installed last has overwritten
    files of the other."""
    name = "environment"
    try:
        version = metadata.version("python-daemon")
    except metadata.PackageNotFoundError:
        return ok(name, f"umbra-rig {metadata.version('umbra-rig')}, no other package `daemon`")
    return failed(
        name,
        f"python-daemon {version} is in this environment, and its package `daemon` is Umbra's too",
        "give Umbra an environment of its own; or pip uninstall python-daemon, then "
        "pip install --force-reinstall --no-deps umbra-rig",
    )


def configuration(path: Path | None, in_force: RigConfig) -> Check:
    """Whether rig.toml is still good, and still what the daemon was started with."""
    name = "configuration"
    if path is None:
        return ok(name, "built-in: a virtual rig on loopback")
    try:
        now = config.load(path)
    except ConfigError as error:
        return failed(
            name,
            f"{error} (umbrad still runs with what the file said before)",
            f"correct it and check: umbrad --check --config {path}",
        )
    if now != in_force:
        return warning(name, f"{path} has changed since umbrad started", "restart umbrad")
    return ok(name, f"{path} is good, and in force")
