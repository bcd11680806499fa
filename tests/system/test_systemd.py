"""The service: its unit as systemd reads it, and umbrad under a real service manager.

The second part needs root and namespaces: systemd runs as PID 1 of its own, with an /etc, /opt and
/var/lib that hold nothing but what the installation guide puts there, and a network of its own. The
unit is started as it is shipped; only the tests' drop-in (a log file, a shorter watchdog) is added.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
SYSTEMD = REPOSITORY / "systemd"
UNIT = SYSTEMD / "umbrad.service"
EXPOSURE = 1.6  # measured with systemd 252; of it .7 is the network, .4 the devices

pytestmark = pytest.mark.system


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
        stdin=subprocess.DEVNULL,
    )


# ---------------------------------------------------------------- the unit as it is read

analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)


@analyze
def test_the_unit_verifies(tmp_path: Path) -> None:
    # systemd looks for the executable too, which is installed elsewhere here.
    there = UNIT.read_text().replace("/opt/umbra/bin/umbrad", sys.executable)
    (tmp_path / UNIT.name).write_text(there)
    done = run("systemd-analyze", "verify", "--recursive-errors=no", tmp_path / UNIT.name)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


@analyze
def test_a_wrong_key_would_be_found(tmp_path: Path) -> None:
    (tmp_path / UNIT.name).write_text(
        UNIT.read_text()
        .replace("/opt/umbra/bin/umbrad", sys.executable)
        .replace("WatchdogSec=", "WatchdogSecs=")
    )
    done = run("systemd-analyze", "verify", "--recursive-errors=no", tmp_path / UNIT.name)
    assert "WatchdogSecs" in done.stderr


@analyze
def test_the_exposure_is_low() -> None:
    done = run(
        "systemd-analyze", "security", "--no-pager", "--offline=yes",
        f"--threshold={round(EXPOSURE * 10)}", UNIT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-200:]
    overall = float(done.stdout.rsplit("umbrad.service: ", 1)[1].split()[0])
    assert overall <= EXPOSURE


@pytest.mark.skipif(
    shutil.which("udevadm") is None or "verify" not in run("udevadm", "--help").stdout,
    reason="udevadm verify (systemd 254) is not installed",
)
def test_udevadm_accepts_the_rules() -> None:
    done = run("udevadm", "verify", "--resolve-names=never", SYSTEMD / "udev/71-umbra.rules")
    assert done.returncode == 0, done.stderr


def test_each_udev_rule_is_well_formed() -> None:
    key = r"[A-Z]+(\{[\w/]+\})?\s*(==|!=|\+=|:=|=)\s*\"[^\"]*\""
    rules = (SYSTEMD / "udev/71-umbra.rules").read_text()
    lines = [line for line in rules.splitlines() if line and not line.startswith("#")]
    assert [line for line in lines if not re.fullmatch(rf"{key}(, {key})*", line)] == []
    assert set(re.findall(r'GOTO="(\w+)"', rules)) == set(re.findall(r'LABEL="(\w+)"', rules))


# ---------------------------------------------------------------- under a real service manager

BOOT = """
set -eu
mount -t cgroup2 none /sys/fs/cgroup
mount -t tmpfs -o mode=755 none /run
mount -t tmpfs -o mode=755 none /var/lib
mount --bind "$1" "$5/opt/python"
mount --bind "$2" "$5/opt/source"
mount --bind "$3" "$5/opt/pure"
mount --bind "$4" "$5/opt/plat"
mount --rbind "$5/opt" /opt
mount --bind "$5/etc" /etc
exec env -i container=umbra-tests PATH=/usr/sbin:/usr/bin:/sbin:/bin \\
    SYSTEMD_UNIT_PATH=/etc/systemd/system SYSTEMD_LOG_TARGET=console \\
    /lib/systemd/systemd --system --unit=multi-user.target
"""

TARGETS = ("basic", "multi-user", "network", "shutdown", "sysinit", "time-sync")

SCRIPTS = {"umbrad": "daemon.app", "umbra": "protocol.cli"}
SCRIPT = """#!/opt/umbra/bin/python
import sys
from {module} import main
sys.exit(main())
"""

DROP_IN = """
[Service]
StandardOutput=append:/var/lib/umbrad.log
StandardError=inherit
WatchdogSec=3
RestartSec=200ms
"""


class Machine:
    """A systemd as PID 1 of its own namespaces, with Umbra installed as the guide says."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lay_out()
        self.console = folder / "console"
        python = Path(sys.base_prefix)
        paths = [python, REPOSITORY, sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
        with self.console.open("wb") as console:
            self._unshare = subprocess.Popen(
                ["unshare", "-fmpuiCn", "--mount-proc", "--kill-child", "sh", "-c", BOOT, "boot",
                 *map(str, paths), str(folder)],
                stdin=subprocess.DEVNULL, stdout=console, stderr=subprocess.STDOUT,
            )  # fmt: skip
        self.pid = 0

    def _lay_out(self) -> None:
        """/opt and /etc as they are after docs/operators-guide.md, "As a service"."""
        python = Path(os.path.realpath(sys.executable)).relative_to(Path(sys.base_prefix).resolve())
        opt = self.folder / "opt"
        for mounted in ("python", "source", "pure", "plat"):
            (opt / mounted).mkdir(parents=True)
        version = f"python{sys.version_info.major}.{sys.version_info.minor}"
        packages = opt / "umbra/lib" / version / "site-packages"
        packages.mkdir(parents=True)
        (packages / "umbra.pth").write_text("/opt/source\n/opt/pure\n/opt/plat\n")
        (opt / "umbra/bin").mkdir()
        (opt / "umbra/bin/python").symlink_to(Path("/opt/python") / python)
        home = (Path("/opt/python") / python).parent
        (opt / "umbra/pyvenv.cfg").write_text(f"home = {home}\n")
        for script, module in SCRIPTS.items():
            (opt / "umbra/bin" / script).write_text(SCRIPT.format(module=module))
            (opt / "umbra/bin" / script).chmod(0o755)

        etc = self.folder / "etc"
        units = etc / "systemd/system"
        (units / "umbrad.service.d").mkdir(parents=True)
        shutil.copy(UNIT, units)
        (units / "umbrad.service.d/tests.conf").write_text(DROP_IN)
        for target in TARGETS:
            (units / f"{target}.target").write_text(f"[Unit]\nDescription={target}\n")
        for file in ("passwd", "group", "ld.so.cache", "localtime"):
            if Path("/etc", file).exists():
                shutil.copy(Path("/etc", file), etc)
        (etc / "nsswitch.conf").write_text("passwd: files\ngroup: files\nhosts: files\n")
        (etc / "hosts").write_text("127.0.0.1 localhost\n")
        (etc / "machine-id").write_text("0123456789abcdef0123456789abcdef\n")
        root = f"--root={self.folder}"
        for tool, options in (("sysusers", []), ("tmpfiles", ["--create"])):
            configuration = self.folder / f"usr/lib/{tool}.d"
            configuration.mkdir(parents=True)
            shutil.copy(SYSTEMD / f"{tool}.d" / "umbra.conf", configuration)
            done = run(f"systemd-{tool}", root, *options, "umbra.conf")
            assert done.returncode == 0, done.stderr
        self.configure((SYSTEMD / "rig.toml").read_text())

    def configure(self, toml: str) -> None:
        (self.folder / "etc/umbra/rig.toml").write_text(toml)

    def wait_for_boot(self) -> None:
        """Skips the tests where the machine does not let a systemd run."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and self._unshare.poll() is None:
            children = Path(f"/proc/{self._unshare.pid}/task/{self._unshare.pid}/children")
            self.pid = int((children.read_text().split() or ["0"])[0])
            if self.pid and self.systemctl("is-system-running").stdout.strip() == "running":
                return
            time.sleep(0.05)
        pytest.skip(f"no systemd of our own here: {self.console.read_text()[-500:]}")

    def inside(self, *command: str) -> subprocess.CompletedProcess[str]:
        return run("nsenter", "-t", str(self.pid), "-a", *command)

    def systemctl(self, *command: str) -> subprocess.CompletedProcess[str]:
        return self.inside("systemctl", "--no-pager", *command)

    def show(self, name: str) -> str:
        return self.systemctl("show", "umbrad", "--value", "-p", name).stdout.strip()

    def log(self) -> str:
        return self.inside("cat", "/var/lib/umbrad.log").stdout

    def start(self) -> int:
        """Start the service unless it runs; gives its main process's id as the machine sees it."""
        self.systemctl("reset-failed", "umbrad")
        done = self.systemctl("start", "umbrad")
        assert done.returncode == 0, done.stderr + self.log()
        return int(self.show("MainPID"))

    def restarted(self, first: int) -> int:
        """Wait until another process than the first one is active; gives its id."""

        def again() -> bool:
            return self.show("SubState") == "running" and self.show("MainPID") != str(first)

        self.until(again)
        return int(self.show("MainPID"))

    def until(self, what: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 90
        while not what():
            assert time.monotonic() < deadline, self.systemctl("status", "umbrad").stdout
            time.sleep(0.05)

    def close(self) -> None:
        if self.pid:
            os.kill(self.pid, signal.SIGKILL)  # and with PID 1 all that runs inside
        self._unshare.kill()
        self._unshare.wait(60)


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    pytest.importorskip("daemon.app")
    if os.geteuid() != 0:
        pytest.skip("a service manager of our own needs root")
    for tool in ("unshare", "nsenter", "systemctl", "systemd-sysusers", "systemd-tmpfiles"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed")
    if not Path("/lib/systemd/systemd").exists():
        pytest.skip("systemd is not installed")
    machine = Machine(tmp_path_factory.mktemp("machine"))
    try:
        machine.wait_for_boot()
        yield machine
    finally:
        machine.close()


def test_it_says_when_it_is_ready_and_what_it_does(machine: Machine) -> None:
    machine.start()
    assert machine.show("ActiveState") == "active"
    assert "idle" in machine.show("StatusText")


def test_a_scan_works_within_the_sandbox(machine: Machine) -> None:
    machine.start()
    done = machine.inside("/opt/umbra/bin/umbra", "scan", "two-image", "--wait")
    assert done.returncode == 0, done.stderr + machine.log()
    run = f"/var/lib/umbra/runs/{done.stdout.split()[-1]}"
    listed = machine.inside("stat", "-c", "%U %a", run, f"{run}/direct.tiff").stdout.splitlines()
    assert [line.split()[0] for line in listed] == ["umbra", "umbra"]
    assert {line.split()[1][-1] for line in (listed[0],)} == {"0"}  # nothing for others


def test_a_hang_and_a_crash_end_in_a_restart(machine: Machine) -> None:
    first = machine.start()
    machine.inside("kill", "-STOP", str(first))
    second = machine.restarted(first)
    assert "Fatal Python error: Aborted" in machine.log()  # with the threads' tracebacks
    machine.inside("kill", "-KILL", str(second))
    machine.restarted(second)
    machine.until(lambda: int(machine.show("NRestarts")) >= 2)


def test_it_stops_when_it_is_told_to(machine: Machine) -> None:
    machine.start()
    assert machine.systemctl("stop", "umbrad").returncode == 0
    assert machine.show("ActiveState") == "inactive"
    assert machine.show("Result") == "success"
    assert machine.show("ExecMainStatus") == "0"


def test_a_wrong_configuration_is_not_tried_again(machine: Machine) -> None:
    machine.systemctl("stop", "umbrad")
    machine.systemctl("reset-failed", "umbrad")
    machine.configure('[rig]\nname = "bench-1"\ncolour = "grey"\n')
    try:
        assert machine.systemctl("start", "umbrad").returncode != 0
        machine.until(lambda: machine.show("ActiveState") == "failed")
        assert machine.show("ExecMainStatus") == "2"
        assert machine.show("NRestarts") == "0"
        assert "rig.colour" in machine.log()
    finally:
        machine.configure((SYSTEMD / "rig.toml").read_text())
