"""Keys: strangers get no reply, observers look, operators act, and a revoked key ends at once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import umbra
from protocol import keys, reference
from protocol.errors import Code, UmbraError
from protocol.messages.access import Role
from tests.system.harness import Daemon

pytestmark = pytest.mark.system


def client_keys(folder: Path, server: Path, name: str) -> keys.ClientKeys:
    """A client's folder of its own: its pair, and the rig's public key."""
    keys.new(folder, name)
    (folder / "server.key").write_bytes((server / "server.key").read_bytes())
    return keys.ClientKeys.load(folder)


def test_roles_and_revocation(daemon: Daemon, tmp_path: Path) -> None:
    server = tmp_path / "keys"
    keys.new(server, "server")
    ada, bob, eve = (client_keys(tmp_path / n, server, n) for n in ("ada", "bob", "eve"))
    keys.authorize(server, tmp_path / "ada" / "ada.key", Role.OPERATOR)
    keys.authorize(server, tmp_path / "bob" / "bob.key", Role.OBSERVER)
    daemon.config.write_text(
        daemon.config.read_text().replace("[network]", f'[network]\nkeys = "{server}"')
    )
    daemon.launch()
    with daemon.connect(keys=ada) as operator, daemon.connect(keys=bob) as observer:
        assert operator.hello().role is Role.OPERATOR
        run = operator.scan(umbra.TwoImage())
        assert observer.run(run.id).wait(60).state == "done"
        with pytest.raises(UmbraError, match="bob") as caught:
            observer.show(umbra.WHITE)
        assert caught.value.code is Code.FORBIDDEN
        for stranger in (eve, False):
            with pytest.raises(UmbraError) as unheard:
                umbra.connect(daemon.endpoint, keys=stranger, timeout_s=0.4)
            assert unheard.value.code is Code.UNREACHABLE
        keys.revoke(server, "ada")
        operator.timeout_s = 2.0  # no answer ever comes: no need to wait long for it
        with pytest.raises(UmbraError) as ended:
            operator.status()
        assert ended.value.code is Code.UNREACHABLE
        assert observer.status().rig == "bench"


def test_an_open_door_to_the_network_is_refused(daemon: Daemon) -> None:
    text = daemon.config.read_text().replace(f"ipc://{tmp(daemon)}/c", "tcp://0.0.0.0:0")
    daemon.config.write_text(text)
    assert daemon.launch().wait(60) == 2
    assert "umbra keys new" in daemon.log()


def tmp(daemon: Daemon) -> str:
    return str(daemon.folder)


def test_thirty_lines_of_pyzmq_and_json_scan(daemon: Daemon, tmp_path: Path) -> None:
    script = tmp_path / "thirty.py"
    script.write_text(reference.CLIENT)
    with daemon.start():
        done = subprocess.run(
            [sys.executable, script, daemon.endpoint],
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("done (120, 160, 3) brightest")
