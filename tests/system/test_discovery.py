"""`umbra devices --scan` with drivers that find, hang, crash, refuse and print."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from protocol.errors import Code, UmbraError
from protocol.messages.findings import Search
from protocol.messages.rig import Health
from tests.system.harness import ENDLESS, Daemon, recorded, until

pytestmark = pytest.mark.system

DRIVERS = """
import os, threading
from drivers.base.errors import DeviceRefused
from drivers.base.device import Options
from drivers.virtual.camera import VirtualCamera

class Needy(Options, frozen=True, kw_only=True):
    lens: str
    serial: str = ""

class Good(VirtualCamera):
    options_type = Needy
    @classmethod
    def discover(cls):
        print("the vendor's banner")
        return [{"model": 'Eye "2"', "serial": "007", "options": {"driver": "good", "serial": "007",
                 "roi": [0, 0, 8, 8]}}]

class Mine(VirtualCamera):
    @classmethod
    def discover(cls):
        return [{"model": "M", "serial": "mine-1", "options": {"serial": "mine-1"}}]

class Hangs(VirtualCamera):
    @classmethod
    def discover(cls):
        threading.Event().wait()

class Crashes(VirtualCamera):
    @classmethod
    def discover(cls):
        os.write(2, b"terminate called\\n")
        os.abort()

class Refuses(VirtualCamera):
    @classmethod
    def discover(cls):
        raise DeviceRefused("camera", "discover", "no permission", "install the udev rules")
"""
NAMES = ("good", "mine", "hangs", "crashes", "refuses")


@pytest.fixture
def drivers(daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Daemon:
    """Somebody's own package of drivers is installed; the rig uses one of them, and it is lost."""
    package = tmp_path / "site"
    (package / "bench_drivers-1.dist-info").mkdir(parents=True)
    (package / "bench_drivers.py").write_text(DRIVERS)
    (package / "bench_drivers-1.dist-info/METADATA").write_text(
        "Metadata-Version: 2.1\nName: bench-drivers\nVersion: 1\n"
    )
    points = [f"camera.{name} = bench_drivers:{name.title()}" for name in NAMES]
    missing = "camera.missing = no_such_sdk:Camera"
    (package / "bench_drivers-1.dist-info/entry_points.txt").write_text(
        "\n".join(["[umbra.drivers]", *points, missing, ""])
    )
    monkeypatch.setenv("PYTHONPATH", str(package))
    daemon.cold = True  # Python reads that as it starts
    text = daemon.config.read_text()
    text = text.replace(
        '[camera]\ndriver = "virtual"', '[camera]\ndriver = "mine"\nserial = "mine-1"'
    )
    daemon.config.write_text(text.replace("time_scale = 4", ""))
    return daemon


def by_driver(searches: tuple[Search, ...]) -> dict[str, Search]:
    return {search.driver: search for search in searches}


def test_what_is_attached_and_who_could_not_look(drivers: Daemon) -> None:
    text = drivers.config.read_text()
    drivers.config.write_text(text.replace('"mine-1"', '"mine-1"\nfaults = ["vanish@1*1000"]'))
    with drivers.start() as rig:
        with pytest.raises(UmbraError):
            rig.snap()  # the camera vanishes
        until(lambda: any(d.health is Health.LOST for d in rig.devices()))
        others = (name for name in NAMES if name != "hangs")
        searches = by_driver(rig.discover(*others, "missing", "virtual", timeout_s=30.0))
        [eye] = searches["good"].found
        assert (eye.model, eye.serial, eye.used_by) == ('Eye "2"', "007", "")
        assert tomllib.loads(eye.toml) == {
            "camera": {"driver": "good", "serial": "007", "roi": [0, 0, 8, 8]}
        }
        assert "# lens =" in eye.toml
        assert [f.used_by for f in searches["mine"].found] == ["camera"]
        [late] = rig.discover("hangs", timeout_s=1.0)
        assert "nothing after 1 s" in late.problem
        assert "terminate called" in searches["crashes"].problem
        assert "install the udev rules" in searches["refuses"].problem
        assert "pip install" in searches["missing"].problem
        assert "cannot tell" in searches["virtual"].problem


def test_refused_while_a_run_uses_the_devices(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(ENDLESS)
        recorded(rig, run.id, 2)
        with pytest.raises(UmbraError, match=run.id) as caught:
            rig.discover("grbl")
        assert caught.value.code is Code.BUSY
        rig.abort()
        run.wait(60, check=False)
        with pytest.raises(UmbraError, match="no driver 'grlb'") as caught:
            rig.discover("grlb")
        assert caught.value.code is Code.BAD_REQUEST


def test_the_command_line(drivers: Daemon) -> None:
    def scan(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "protocol.cli", "devices", "--rig", drivers.endpoint,
             *arguments],
            capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip

    with drivers.start():
        shown = scan("--scan", "good", "mine", "refuses")
        assert shown.returncode == 0
        [first, second] = shown.stdout.split("\n\n")[:2]
        assert first.startswith('# Eye "2", serial 007\n[camera]\ndriver = "good"\n')
        assert "(in use: camera)" in second
        assert (
            shown.stderr
            == "camera refuses: camera: discover: no permission; install the udev rules\n"
        )
        told = json.loads(scan("--scan", "good", "--json").stdout)
        assert told["searches"][0]["found"][0]["serial"] == "007"
        assert scan("good").returncode == 2
