"""`umbra doctor` on real daemons whose rigs are sound, broken, busy, or not there."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

import umbra
from protocol.errors import Code, UmbraError
from protocol.messages.findings import Check, Outcome
from protocol.messages.rig import RigState
from tests.system.harness import ENDLESS, Daemon, recorded

pytestmark = pytest.mark.system


def outcomes(checks: tuple[Check, ...]) -> dict[str, Outcome]:
    return {check.name: check.outcome for check in checks}


def test_a_sound_rig(daemon: Daemon) -> None:
    daemon.configure(more='[[light]]\nname = "left"\ndriver = "virtual"', scale=1)
    with daemon.start() as rig:
        rig.show(umbra.WHITE)  # what is shown by hand is taken down
        checks = rig.examine()
        found = outcomes(checks)
        assert Outcome.FAILED not in found.values(), checks
        exposed = {
            "projector: refresh", "camera: trigger", "projector: light", "projector: latency",
            "camera: exposure", "camera: trigger wire", "light: left",
        }  # fmt: skip
        assert exposed <= set(found)
        for name in ("camera: trigger", "camera: trigger wire", "light: left"):
            assert found[name] is Outcome.OK, checks
        assert rig.status().state is RigState.IDLE


def test_light_that_comes_later_than_the_projector_says(daemon: Daemon) -> None:
    daemon.configure(projector="hidden_latency_ms = 9", scale=0.5)  # 18 ms, for a host that is busy
    with daemon.start() as rig:
        found = {c.name: c for c in rig.examine()}
        late, wire = found["projector: latency"], found["camera: trigger wire"]
        assert late.outcome is Outcome.FAILED
        assert "calibrate latency" in late.remedy
        assert "do not take turns" in wire.message


def test_a_camera_that_hears_no_trigger(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["drop-trigger@2"]\nexposure_us = 10000')
    with daemon.start() as rig:
        found = {c.name: c for c in rig.examine()}
        assert found["camera: trigger"].outcome is Outcome.FAILED
        assert "triggered" in found["camera: trigger"].remedy
        assert found["projector: light"].outcome is Outcome.OK  # the rest was looked at
        assert found["camera: exposure"].outcome is Outcome.WARNING


def test_a_wire_that_loses_a_pulse(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["drop-trigger:pulse@2"]\nexposure_us = 10000', scale=1)
    with daemon.start() as rig:
        found = {c.name: c for c in rig.examine()}
        assert found["camera: trigger"].outcome is Outcome.OK
        wire = found["camera: trigger wire"]
        assert wire.outcome is Outcome.FAILED
        assert wire.message == "3 frames for 4 images: a trigger was missed or false"
        assert "trigger_line" in wire.remedy


def test_a_rig_in_the_dark(daemon: Daemon) -> None:
    daemon.configure(camera="exposure_us = 20")
    with daemon.start() as rig:
        assert outcomes(rig.examine())["projector: light"] is Outcome.FAILED


def test_only_passive_while_a_run_goes_on(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(ENDLESS)
        recorded(rig, run.id, 2)
        with pytest.raises(UmbraError, match=run.id) as caught:
            rig.examine()
        assert caught.value.code is Code.BUSY
        found = outcomes(rig.examine(passive=True))
        assert found["disk: speed"] is Outcome.SKIPPED
        assert "camera: trigger" not in found
        assert rig.status().state is RigState.SCANNING
        rig.abort()


def test_the_command_line(daemon: Daemon) -> None:
    daemon.configure(projector="hidden_latency_ms = 9", scale=0.5)

    def doctor(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "protocol.cli", "doctor", "--rig", daemon.endpoint, *arguments],
            capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip

    with daemon.start():
        shown = doctor()
        assert shown.returncode == 1
        assert "-> umbra calibrate latency" in shown.stdout
        assert "2 failed" in shown.stdout.splitlines()[-1]  # pulses are as early
        passive = doctor("--passive", "--json")
        assert passive.returncode == 0
        assert {"name", "outcome", "message", "remedy"} <= set(
            json.loads(passive.stdout)["checks"][0]
        )
    daemon.stop()
    lost = doctor()
    assert lost.returncode == 3
    assert "umbrad --check" in lost.stdout
