"""A daemon of one's own: `umbra demo` and `umbra separate` start one, use it and stop it.

It listens on IPC endpoints in a private folder and ends with its owner: its standard input is a
pipe from this process, and `umbrad --until-eof` stops when that closes, however this one dies.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from protocol.client import Client
from protocol.errors import Code, UmbraError

START_S = 30.0  # a cold start imports OpenCV and Zarr
ANSWER_S = 30.0  # of one that is there: its machine may be busy
STOP_S = 10.0
MAX_PATH = 100  # of a Unix socket, with a little room: the system's limit is 107


@contextmanager
def private_daemon(config: Mapping[str, Any]) -> Iterator[Client]:
    """A client of a fresh daemon with this rig.toml (devices; network and data are added).

    Raises UmbraError: bad_input for a configuration that the daemon refuses, unreachable when it
    does not start. The daemon and everything it stored are gone afterwards.
    """
    folder = _private_folder()
    try:
        file = folder / "rig.toml"
        file.write_text(toml(configured(config, folder)), encoding="utf-8")
        with (folder / "log").open("wb") as log:
            process = subprocess.Popen(
                # -P: a file in the user's folder must not pass for one of the daemon's modules
                [sys.executable, "-P", "-m", "daemon.app", "--config", str(file), "--until-eof"],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env={k: v for k, v in os.environ.items() if k != "NOTIFY_SOCKET"},
                start_new_session=True,  # Ctrl-C is for us: we stop it in good order
            )
        try:
            with (
                _ends_in_order(),
                _when_ready(process, f"ipc://{folder}/command", folder / "log") as client,
            ):
                yield client
        finally:
            _stop(process)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def configured(config: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A whole rig.toml: these tables, and everything that is written kept within the folder."""
    return {
        **config,
        "rig": {**config.get("rig", {}), "name": "private", "data": f"{folder}/data"},
        "network": {"command": f"ipc://{folder}/command", "events": f"ipc://{folder}/events"},
    }


@contextmanager
def _ends_in_order() -> Iterator[None]:
    """SIGTERM and SIGHUP become SystemExit in here, so that what was started is cleared away."""

    def leave(number: int, _frame: object) -> None:
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, leave) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _private_folder() -> Path:
    for parent in (None, "/tmp"):  # TMPDIR may be too long
        folder = Path(tempfile.mkdtemp(prefix="umbra-", dir=parent))
        if len(str(folder / "command")) <= MAX_PATH:
            return folder
        folder.rmdir()
    raise AssertionError("/tmp is a short path")


def _when_ready(process: subprocess.Popen[bytes], endpoint: str, log: Path) -> Client:
    """Say hello until it is answered. Raises UmbraError if the daemon dies, or takes too long."""
    deadline = time.monotonic() + START_S
    while True:
        if process.poll() is not None:
            code = Code.BAD_INPUT if process.returncode == 2 else Code.UNREACHABLE
            raise UmbraError(code, f"the private daemon did not start: {_last_line(log)}")
        try:
            client = Client(endpoint, keys=False, timeout_s=0.5)
        except UmbraError as error:
            if error.code is not Code.UNREACHABLE:
                raise
            if time.monotonic() > deadline:
                raise UmbraError(
                    Code.UNREACHABLE,
                    f"the private daemon is silent after {START_S:.0f} s: {_last_line(log)}",
                ) from error
        else:
            client.timeout_s = ANSWER_S
            return client


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def toml(tables: Mapping[str, Any]) -> str:
    """A configuration as TOML: tables of strings, numbers, booleans and lists of those, and lists
    of such tables."""
    lines = []
    for name, found in tables.items():
        several = isinstance(found, list)
        for table in found if several else [found]:
            lines.append(f"[[{name}]]" if several else f"[{name}]")
            lines += [f"{key} = {_value(it)}" for key, it in table.items() if it is not None]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    # JSON's strings, numbers, booleans and arrays are TOML's, but for DEL, which TOML escapes
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
