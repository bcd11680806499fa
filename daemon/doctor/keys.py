"""Who may talk to the rig: the folder of keys, and who can read its secret."""

from __future__ import annotations

import stat
from pathlib import Path

from daemon.doctor.verdict import failed, ok, warning
from protocol import keys as curve
from protocol.errors import UmbraError
from protocol.messages.findings import Check


def keys(folder: str) -> Check:
    """The daemon's [network] keys; "" is none."""
    name = "keys"
    if not folder:
        return ok(name, "none: this machine only, and everybody on it")
    for path in (Path(folder), *(Path(folder) / each for each in curve.FOLDERS.values())):
        if path.exists() and path.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            return failed(
                name, f"others may write to {path}, and let themselves in", f"chmod go-w {path}"
            )
    try:
        curve.load_server(folder)
    except UmbraError as error:
        return failed(name, error.message, "the secret must be its owner's alone")
    secrets = [p for p in sorted(Path(folder).rglob("*.key_secret")) if p.stem != curve.SERVER]
    if secrets:
        return warning(
            name,
            f"{secrets[0]} is a client's secret: it has no business here",
            "move it to its client; the rig needs the public halves only",
        )
    allowed = curve.allowed(folder)
    if not allowed:
        return warning(
            name, f"{folder} lets nobody in", "umbra keys authorize NAME.key --role operator"
        )
    return ok(name, f"{len(allowed)} keys may come in; the secret is umbrad's alone")
