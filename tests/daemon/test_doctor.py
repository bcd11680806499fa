"""Each check of the doctor says what it must of a sound rig and of a broken one."""

from __future__ import annotations

import ctypes
import grp
import os
import stat
import time
from importlib import metadata
from pathlib import Path

import pytest

from daemon import config
from daemon.config import DeviceTable
from daemon.doctor import (
    clocks,
    devices,
    disk,
    display,
    exposing,
    keys,
    permissions,
    service,
    software,
)
from daemon.doctor.exposing import Shot
from drivers.clock import NS, RealClock, ScaledClock
from protocol import keys as curve
from protocol.messages.access import Role
from protocol.messages.findings import Check, Outcome
from protocol.messages.rig import DeviceInfo, Health

OK, WARNING, FAILED, SKIPPED = Outcome


def test_what_is_wrong_has_a_remedy() -> None:
    found = [
        software.configuration(Path("no.toml"), config.load(None)),
        disk.space(5, 10, None),
        keys.keys("/no/such/folder"),
        service.watchdog({"NOTIFY_SOCKET": "/run/x"}, None),
        display.refresh([0, 1, 2, 3], 60.0),
    ]
    assert all(c.outcome in (WARNING, FAILED) and c.remedy and c.message for c in found)


# ---------------------------------------------------------------- software


def test_python_daemon_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert software.environment().outcome is OK
    real = metadata.version
    monkeypatch.setattr(metadata, "version", lambda n: "3.1" if n == "python-daemon" else real(n))
    found = software.environment()
    assert found.outcome is FAILED
    assert "python-daemon 3.1" in found.message


def test_a_file_that_changed_since_the_start(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('[camera]\ndriver = "virtual"\n')
    in_force = config.load(path)
    assert software.configuration(path, in_force).outcome is OK
    path.write_text('[camera]\ndriver = "virtual"\nwidth = 320\n')
    assert software.configuration(path, in_force).outcome is WARNING
    path.write_text('[camera]\ndriver = "virtual"\nwdth = 320\n')
    broken = software.configuration(path, in_force)
    assert (broken.outcome, "camera.wdth" in broken.message) == (FAILED, True)
    assert software.configuration(None, in_force).outcome is OK


# ---------------------------------------------------------------- permissions


def table(driver: str, **options: object) -> DeviceTable:
    return DeviceTable(name="dev", kind="stage", driver=driver, options=dict(options))


def test_a_device_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    assert "no " + str(port) in permissions.node("p", port).message
    port.touch()
    assert permissions.node("p", port).outcome is OK
    monkeypatch.setattr(os, "access", lambda *_: False)
    forbidden = permissions.node("p", port)
    assert (forbidden.outcome, "usermod -aG" in forbidden.remedy) == (FAILED, True)


def test_groups_and_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(os, "getgroups", list)
    monkeypatch.setattr(os, "getegid", lambda: 1000)
    outside = permissions.member("p", "dialout")
    assert (outside.outcome, "dialout" in outside.remedy) == (WARNING, True)
    monkeypatch.setattr(os, "getgroups", lambda: [grp.getgrnam("dialout").gr_gid])
    assert permissions.member("p", "dialout").outcome is OK
    assert permissions.member("p", "no-such-group").outcome is SKIPPED
    rules = tmp_path / "71-umbra.rules"
    assert permissions.rules("p", [rules]).outcome is WARNING
    rules.touch()
    assert permissions.rules("p", [rules]).outcome is OK


def test_only_drivers_that_need_a_permission_are_checked() -> None:
    tables = [table("virtual"), table("grbl", port="socket://stage:23"), table("replay", path="x")]
    assert permissions.permissions(tables) == []
    assert len(permissions.permissions([table("grbl", port="usb:1a86:7523"), table("pylon")])) == 2


# ---------------------------------------------------------------- devices


def test_health_and_firmware() -> None:
    ready = DeviceInfo(
        name="camera", kind="camera", driver="x", health=Health.READY, model="M", serial="1",
        firmware="2.0",
    )  # fmt: skip
    lost = DeviceInfo(
        name="stage", kind="stage", driver="x", health=Health.LOST, message="no /dev/ttyUSB0"
    )
    sound, broken = devices.health([ready, lost])
    assert (sound.outcome, broken.outcome) == (OK, FAILED)
    assert "no /dev/ttyUSB0" in broken.message
    before = {"camera": {"model": "M", "serial": "1", "firmware": "1.9"}}
    [changed] = devices.firmware([ready, lost], before, "run-7")
    assert (changed.outcome, "run-7" in changed.message) == (WARNING, True)
    [other_one] = devices.firmware([ready], {"camera": {"model": "M", "serial": "2"}}, "run-7")
    assert other_one.outcome is OK


# ---------------------------------------------------------------- clocks, disk


def test_a_step_of_utc(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = RealClock()
    assert clocks.step(clock).outcome is OK
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + 3 * NS)
    stepped = clocks.step(clock)
    assert (stepped.outcome, "+3.000 s" in stepped.message) == (WARNING, True)
    assert clocks.step(ScaledClock(10.0)).outcome is SKIPPED


class _Kernel:
    def __init__(self, state: int) -> None:
        self.state = state

    def adjtimex(self, _: object) -> int:
        return self.state


@pytest.mark.parametrize(
    ("state", "stamp", "outcome"),
    [(0, False, OK), (5, True, WARNING), (-1, True, OK), (-1, False, SKIPPED)],
)
def test_ntp(
    state: int, stamp: bool, outcome: Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: _Kernel(state))
    monkeypatch.setattr(clocks, "TIMESYNC", tmp_path / "synchronized")
    if stamp:
        clocks.TIMESYNC.touch()
    assert clocks.synchronised().outcome is outcome


def test_the_kernel_is_really_asked() -> None:
    assert clocks.synchronised().outcome in (OK, WARNING, SKIPPED)


def test_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert disk.space(10**9, 10**9, 1000).outcome is FAILED
    assert disk.space(2 * 10**9, 10**9, 10**8).outcome is WARNING
    assert "10000 frames" in disk.space(2 * 10**9, 10**9, 10**5).message
    monkeypatch.setattr(disk, "_MOST", 8 << 20)
    assert disk.write_speed(tmp_path) > 0
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(disk, "write_speed", lambda _: 100e6)
    assert disk.speed(tmp_path, 10**6, 30.0).outcome is OK
    assert disk.speed(tmp_path, 10**6, 90.0).outcome is WARNING
    assert disk.speed(tmp_path, None, 0.0).outcome is OK
    monkeypatch.undo()
    assert disk.speed(tmp_path / "gone", 1, 1.0).outcome is FAILED


# ---------------------------------------------------------------- keys, watchdog


def test_keys_and_who_can_read_them(tmp_path: Path) -> None:
    assert keys.keys("").outcome is OK
    curve.new(tmp_path, curve.SERVER)
    assert "lets nobody in" in keys.keys(str(tmp_path)).message
    public, _ = curve.new(tmp_path / "client", "ada")
    curve.authorize(tmp_path, public, Role.OPERATOR)
    astray = keys.keys(str(tmp_path))
    assert (astray.outcome, "ada.key_secret" in astray.message) == (WARNING, True)
    (tmp_path / "client/ada.key_secret").unlink()
    assert keys.keys(str(tmp_path)).outcome is OK
    secret = tmp_path / f"{curve.SERVER}.key_secret"
    secret.chmod(0o644)
    assert "chmod 600" in keys.keys(str(tmp_path)).message
    secret.chmod(0o600)
    tmp_path.chmod(stat.S_IMODE(tmp_path.stat().st_mode) | stat.S_IWOTH)
    assert (keys.keys(str(tmp_path)).outcome, "others may write") == (
        FAILED,
        keys.keys(str(tmp_path)).message[:16],
    )


def test_the_watchdog() -> None:
    assert service.watchdog({}, None).outcome is SKIPPED
    assert service.watchdog({"NOTIFY_SOCKET": "/run/x"}, None).outcome is WARNING
    assert service.watchdog({"NOTIFY_SOCKET": "/run/x"}, 30.0).outcome is OK


# ---------------------------------------------------------------- by exposing


def flips(hz: float, missed: int = 0) -> list[int]:
    counts = [n + min(n, missed) for n in range(16)]
    return [round(n / hz * NS) for n in counts]


@pytest.mark.parametrize(
    ("measured", "outcome"),
    [
        (flips(60.0), OK),
        (flips(60.0, missed=2), OK),
        (flips(60.0, missed=9), WARNING),
        (flips(75.0), FAILED),
        (flips(50.0), FAILED),
        (flips(1000.0), FAILED),  # no vsync
    ],
)
def test_refresh(measured: list[int], outcome: Outcome) -> None:
    assert display.refresh(measured, 60.0).outcome is outcome


def shot(mean: float = 0.3, *, asked: float = 0.0, began: float = 0.1, sequence: int = 0,
         saturated: float = 0.0, here: float = 25.0) -> Shot:  # fmt: skip
    """Times in ms."""
    ms = NS // 1000
    return Shot(
        mean=mean, saturated=saturated, asked_ns=round(asked * ms), start_ns=round(began * ms),
        end_ns=round((began + 20) * ms), here_ns=round(here * ms), exposure_us=20_000.0,
        sequence=sequence,
    )  # fmt: skip


def test_triggers() -> None:
    sound = [shot(sequence=n) for n in range(4)]
    assert exposing.trigger(sound).outcome is OK
    assert exposing.trigger([shot(sequence=n) for n in (0, 2, 3)]).outcome is WARNING
    assert exposing.trigger([shot(began=-30.0, sequence=n) for n in range(3)]).outcome is FAILED
    assert exposing.trigger([shot(began=400, sequence=n) for n in range(3)]).outcome is WARNING


def test_a_camera_that_runs_free() -> None:
    found = exposing.stream([shot(began=40 * n) for n in range(4)])
    assert (found.outcome, "every 40.0 ms" in found.message) == (WARNING, True)


def test_light_and_its_latency() -> None:
    dark, bright = shot(0.02), shot(0.5)
    assert [c.outcome for c in exposing.lit("l", dark, bright)] == [OK]
    assert [c.outcome for c in exposing.lit("l", dark, shot(0.021))] == [FAILED]
    assert [c.outcome for c in exposing.lit("l", dark, shot(0.9, saturated=0.2))] == [WARNING]
    assert exposing.latency(dark, shot(0.5), bright, 0).outcome is OK
    late = exposing.latency(dark, shot(0.26), bright, 0)
    assert (late.outcome, "10.0 ms later" in late.message) == (FAILED, True)
    # A busy host: nothing is known of light that came before the frame began.
    busy = exposing.latency(dark, shot(0.5, began=30.0), bright, 0)
    assert (busy.outcome, "sooner than 30.0 ms after" in busy.message) == (WARNING, True)
    assert exposing.latency(dark, shot(0.26, began=30.0), bright, 0).outcome is FAILED


@pytest.mark.parametrize(
    ("exposure_us", "outcome"),
    [(1e6 / 60, OK), (2e6 / 60, OK), (20_000, WARNING), (5_000, WARNING)],
)
def test_exposures_of_whole_periods(exposure_us: float, outcome: Outcome) -> None:
    found: Check = exposing.periods(exposure_us, 60.0)
    assert found.outcome is outcome
