"""What a run waits for before its first frame, and the exposure that it chooses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import msgspec
import pytest

import umbra
from daemon.storage.frames import FrameStore
from protocol.errors import Code, UmbraError
from protocol.messages.replies import Status
from protocol.messages.rig import RigState, StageState
from protocol.messages.runs import RunState
from protocol.run import Run
from protocol.scans.spec import Ready
from tests.system.harness import ENDLESS, FAST, SLOW, Daemon, recorded, until

pytestmark = pytest.mark.system

GARDEN = """
[stage]
driver = "virtual"
light = "sun"
before_scene_mm = 150
hole_mm = 12.5
pitch_mm = 20
homing_feed_mm_s = 200
[[light]]
name = "sun"
driver = "virtual"
kind = "sun"
clouds = {clouds}
"""
NIGHT = [[0, 0.0], [1e6, 0.0]]
MORNING = ((0, 0.0), (30, 0.02), (36, 1.0), (40, 0.5), (44, 1.0))
MESH: dict[str, Any] = {
    "hole_mm": 12.5, "pitch_mm": 20.0, "source_deg": 0.1, "scene_mm": 150.0, "coverage": 0.9,
    "sun": True,
}  # fmt: skip


def garden(daemon: Daemon, clouds: list[list[float]], camera: str = "", scale: float = 4) -> Daemon:
    daemon.configure(
        camera='pixel_format = "Mono12"\nframe_rate_hz = 25\n' + camera,
        more=GARDEN.format(clouds=clouds),
        scale=scale,
    )
    text = daemon.config.read_text()
    start = text.index("[projector]")
    daemon.config.write_text(text[:start] + text[text.index("[camera]") :])
    return daemon


def rig_of(daemon: Daemon, run: str) -> dict[str, Any]:
    """What run.json says of the rig."""
    found = json.loads((daemon.data / "runs" / run / "run.json").read_text())
    return dict(found["rig"])


def looked(run: Run) -> bool:
    return run.refresh().state is RunState.WAITING or bool(run.info.started)


@contextmanager
def before_dawn(daemon: Daemon, scan: umbra.Mesh) -> Iterator[tuple[Status, Run]]:
    """A run that has looked at the light before the morning came, and the rig's status then; where
    a busy host was too late for that, once more with a morning that takes longer."""
    for slower in (1, 2, 4):
        clouds = [[slower * at, level] for at, level in MORNING]
        with garden(daemon, [*clouds, [1e6, 1.0]]).start() as rig, daemon.connect() as other:
            run = rig.scan(scan)
            until(partial(looked, run))
            status = other.status()
            waiting = status.progress and status.progress.waits
            if waiting and waiting.what == "light":
                yield status, run
                return
        daemon.kill()
        shutil.rmtree(daemon.data)
    pytest.fail("the morning was always there before the first look")


def test_a_scan_waits_for_the_morning_and_for_steady_light(daemon: Daemon) -> None:
    ready = Ready(deadline_s=600.0, light_min=0.3, steady=0.05, look_s=2.0)
    scan = umbra.Mesh(**MESH, auto_exposure=True, ready=ready)
    with before_dawn(daemon, scan) as (status, run), daemon.connect() as other:
        assert status.state is RigState.WAITING
        assert status.progress is not None
        waiting = status.progress.waits
        assert waiting is not None
        assert "at least 30.0% are wanted" in waiting.seen
        assert waiting.since < waiting.until
        info = run.wait(120)
        assert info.state is RunState.DONE
        events = [record["what"] for record in other.log(run.id) if record["event"] == "waiting"]
        assert events == ["light", "steadiness"]
        # Looks are no frames of the run, and all its frames have the one exposure.
        records = FrameStore.open(daemon.data / "runs" / run.id, readonly=True).records()
        chosen = rig_of(daemon, run.id)["exposure"]
        assert {r.exposure_us for r in records if not r.missing} == {chosen["exposure_us"]}
        assert len(records) == info.recorded + info.missing
        assert chosen["brightest"] == pytest.approx(0.8, rel=0.06)
        assert chosen["exposure_us"] <= 1e6 / 25
        facts = run.result().facts
        assert facts["exposure"] == chosen
        assert facts.get("rejected", {}).get("cloud", 0) == 0  # it did not begin under the cloud


def test_at_the_deadline_the_run_fails_and_says_what_never_came(daemon: Daemon) -> None:
    ready = Ready(deadline_s=6.0, light_min=0.3, look_s=2.0)
    with garden(daemon, NIGHT).start() as rig:
        run = rig.scan(umbra.Mesh(**MESH, ready=ready))
        info = run.wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert info.end.code == "not_ready"
        assert "not ready within 6 s: light never was so" in info.end.reason
        assert "of full scale, and at least 30.0% are wanted" in info.end.reason
        assert (info.recorded, info.started) == (0, "")
        rig.resume(run.id)  # and it may be tried again
        until(lambda: rig.status().state is RigState.WAITING)
        rig.abort(run.id)


def test_a_wait_can_be_aborted_and_survives_a_kill(daemon: Daemon) -> None:
    ready = Ready(deadline_s=86_400.0, light_min=0.3, look_s=600.0)
    with garden(daemon, NIGHT).start() as rig:
        run = rig.scan(umbra.Mesh(**MESH, ready=ready)).id
        until(lambda: rig.run(run).refresh().state is RunState.WAITING)
        daemon.kill()
    with daemon.start() as rig:  # it had lost nothing, and goes on waiting
        until(lambda: rig.run(run).refresh().state is RunState.WAITING)
        assert not rig.status().queue
        assert daemon.stop() == 0
    with daemon.start() as rig:
        until(lambda: rig.run(run).refresh().state is RunState.WAITING)
        rig.abort(run)
        # The next look is 150 s away: longer than this has patience.
        assert rig.run(run).wait(60, check=False).state is RunState.ABORTED
        until(lambda: rig.status().state is RigState.IDLE)


def test_a_stage_in_alarm_is_waited_for_until_somebody_has_looked(daemon: Daemon) -> None:
    garden(daemon, NIGHT)
    text = daemon.config.read_text()
    daemon.config.write_text(text.replace('light = "sun"\n', 'faults = ["no-switch@1"]\n'))
    ready = Ready(deadline_s=86_400.0, light_min=0.3, look_s=600.0)
    with daemon.start() as rig:
        run = rig.scan(umbra.Mesh(**MESH, ready=ready)).id

        def waits(what: str, seen: str) -> bool:
            progress = rig.status().progress
            found = progress and progress.waits
            return bool(found and found.what == what and seen in found.seen)

        until(lambda: waits("stage", "limit switch X was not found"))
        with pytest.raises(UmbraError, match="is using the devices"):
            rig.stage_home(30.0)
        rig.stage_unlock()  # the next look is 150 s away, and comes at once
        until(lambda: waits("light", "0.0%"))
        assert rig.stage().state is StageState.IDLE
        rig.abort(run)


def test_a_device_that_is_away_is_waited_for(daemon: Daemon) -> None:
    # The first look loses the camera, and connecting fails twice.
    daemon.configure(camera='faults = ["vanish@1*2"]', scale=1)
    ready = Ready(deadline_s=600.0, light_min=0.01, look_s=300.0)
    with daemon.start() as rig:
        run = rig.scan(umbra.TwoImage(ready=ready))
        assert run.wait(60).state is RunState.DONE  # its return is heard of, before the next look
        waited = [(r["what"], r["seen"]) for r in rig.log(run.id) if r["event"] == "waiting"]
        assert [what for what, _ in waited] == ["light", "devices"]
        assert "camera: grab" in waited[0][1]
        assert "camera (virtual) is lost" in waited[1][1]


def test_a_device_that_fails_later_is_waited_for_too(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["vanish@12*2", "vanish@20"]')
    with daemon.start() as rig:
        run = rig.scan(umbra.Checkerboard(ready=Ready(deadline_s=1e5, look_s=600.0)))
        info = run.wait(60)
        assert (info.state, info.recorded, info.missing) == (RunState.DONE, 27, 0)
        told = [record["event"] for record in rig.log(run.id)]
        assert told.count("a device failed") == told.count("resumed") == 2
        records = FrameStore.open(daemon.data / "runs" / run.id, readonly=True).records()
        assert [(r.step, r.sub) for r in records] == [(step, 0) for step in range(27)]


@pytest.mark.parametrize(
    ("faults", "code"),
    [
        ('["vanish@12*100000"]', Code.NOT_READY),  # it stays away
        ('["vanish@12", "vanish@13", "vanish@14"]', Code.DEVICE_LOST),  # there, but of no use
    ],
)
def test_not_for_ever(daemon: Daemon, faults: str, code: Code) -> None:
    daemon.configure(camera=f"faults = {faults}")
    with daemon.start() as rig:
        deadline_s = 30.0 if code is Code.NOT_READY else 1e5
        run = rig.scan(umbra.Checkerboard(ready=Ready(deadline_s=deadline_s, look_s=600.0)))
        info = run.wait(60, check=False)
        assert info.end is not None
        assert (info.state, info.end.code, info.recorded) == (RunState.FAILED, code, 11)


def test_a_scan_may_be_queued_while_a_device_is_away(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["vanish@1*4"]', scale=1)
    with daemon.start() as rig:
        with pytest.raises(UmbraError):
            rig.snap()
        with pytest.raises(UmbraError, match="lost"):
            rig.scan(umbra.TwoImage())
        run = rig.scan(umbra.TwoImage(ready=Ready(deadline_s=1.0)))
        info = run.wait(60, check=False)
        assert info.end is not None
        assert "not ready within 1 s: devices never was so" in info.end.reason


def test_auto_exposure_under_a_projector(daemon: Daemon) -> None:
    daemon.configure(projector="refresh_hz = 500", camera="exposure_us = 300000")
    with daemon.start() as rig:
        run = rig.scan(umbra.TwoImage(auto_exposure=True))
        assert run.wait(60).state is RunState.DONE
        rig_facts = rig_of(daemon, run.id)
        chosen = rig_facts["exposure"]
        assert chosen["exposure_us"] % 2000 == pytest.approx(0.0, abs=0.1)
        assert 0.65 < chosen["brightest"] < 0.84  # the next period would be too long
        assert "problem" not in chosen
        assert rig_facts["settings"]["exposure_us"] == chosen["exposure_us"]
        assert run.result().facts["exposure"] == chosen
        assert rig.camera().exposure_us == 300_000  # as it was found


def test_a_scene_that_is_too_dark_is_told_and_scanned(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(umbra.TwoImage(auto_exposure=True, exposure_us=2000.0))
        assert run.wait(60).state is RunState.DONE
        facts = run.result().facts
        assert facts["exposure"]["exposure_us"] == 2000.0
        assert facts["advice"][0].startswith("Auto-exposure: too dark at the longest exposure")
        report = (daemon.data / "runs" / run.id / "report.html").read_text()
        assert "too dark at the longest exposure" in report


def test_an_interrupted_run_keeps_the_exposure_that_it_chose(daemon: Daemon) -> None:
    spec = umbra.Checkerboard(average=2, auto_exposure=True)
    daemon.configure(projector="refresh_hz = 500", scale=SLOW)
    with daemon.start() as rig:
        run = rig.scan(spec).id
        recorded(rig, run, 5)
        daemon.kill()
    daemon.configure(projector="refresh_hz = 500", scale=FAST)
    chosen = rig_of(daemon, run)["exposure"]
    with daemon.start() as rig:
        rig.camera(exposure_us=1000.0)
        rig.resume(run)
        assert rig.run(run).wait(60).state is RunState.DONE
        assert rig.camera().exposure_us == 1000.0
    records = FrameStore.open(daemon.data / "runs" / run, readonly=True).records()
    assert {r.exposure_us for r in records} == {chosen["exposure_us"]}
    assert rig_of(daemon, run)["exposure"] == chosen


def test_a_run_leaves_the_camera_as_it_found_it(daemon: Daemon) -> None:
    with daemon.start() as rig:
        before = rig.camera(exposure_us=12_000.0, gain=1.0)
        assert rig.scan(umbra.TwoImage(exposure_us=8000.0, gain=3.0)).wait(60)
        assert rig.camera() == before
        run = rig.scan(msgspec.structs.replace(ENDLESS, exposure_us=9000.0))
        recorded(rig, run.id, 3)
        rig.abort(run.id)
        assert run.wait(60, check=False).state is RunState.ABORTED
        until(lambda: rig.status().state is RigState.IDLE)
        assert rig.camera() == before


def test_what_the_dark_cannot_say_is_refused(daemon: Daemon) -> None:
    dark = "in the dark there is no light to look at"
    with daemon.start() as rig, pytest.raises(UmbraError, match=dark):
        rig.scan(umbra.CalibrateDark(auto_exposure=True))


def test_the_exposure_is_chosen_by_hand_for_what_is_shown(daemon: Daemon) -> None:
    daemon.configure(projector="refresh_hz = 500")
    with daemon.start() as rig:
        rig.camera(exposure_us=200.0)
        rig.show(umbra.WHITE)
        facts = rig.auto_exposure()
        assert facts["exposure_us"] == rig.camera().exposure_us
        assert facts["exposure_us"] % 2000 == pytest.approx(0.0, abs=0.1)
        assert 0.65 < facts["brightest"] < 0.84
        assert rig.status().state is RigState.MANUAL  # white is still shown
        facts = rig.auto_exposure(longest_us=2000.0)
        assert facts["exposure_us"] == 2000.0
        assert "too dark at the longest exposure" in facts["problem"]


def test_the_exposures_of_a_bracket_are_multiples_of_the_chosen_one(daemon: Daemon) -> None:
    daemon.configure(projector="refresh_hz = 500")
    spec = umbra.TwoImage(auto_exposure=True, exposure_us=100_000.0, bracket=(1.0, 2.0))
    with daemon.start() as rig:
        run = rig.scan(spec)
        assert run.wait(60).state is RunState.DONE
    chosen = rig_of(daemon, run.id)["exposure"]["exposure_us"]
    records = FrameStore.open(daemon.data / "runs" / run.id, readonly=True).records()
    assert {r.exposure_us for r in records} == {chosen, 2 * chosen}
