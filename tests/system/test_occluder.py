"""Scans that move a stage: homed first, ended by coverage or time, held whenever they end."""

from __future__ import annotations

import json
import math

import msgspec
import numpy as np
import pytest

import umbra
from daemon.separation.estimator import Components
from daemon.storage.frames import FrameStore
from protocol.messages.rig import StageState
from protocol.messages.runs import RunState
from tests.system.harness import Daemon, recorded, until

pytestmark = pytest.mark.system

RIG = """
[stage]
driver = "virtual"
light = "left"
before_scene_mm = 150
hole_mm = 12.5
pitch_mm = 20
homing_feed_mm_s = 200
{stage}
[[light]]
name = "left"
driver = "virtual"
"""
CAMERA = 'pixel_format = "Mono12"\nframe_rate_hz = 12\n'
MESH = umbra.Mesh(hole_mm=12.5, pitch_mm=20.0, source_deg=0.1, scene_mm=150.0, coverage=0.97)
ENDLESS = umbra.Mesh(hole_mm=12.5, pitch_mm=20.0, coverage=1.0, time_limit_s=600.0)


@pytest.fixture
def bench(daemon: Daemon) -> Daemon:
    return configured(daemon)


def configured(daemon: Daemon, stage: str = "", scale: float = 2) -> Daemon:
    daemon.configure(camera=CAMERA, more=RIG.format(stage=stage), scale=scale)
    text = daemon.config.read_text()
    start = text.index("[projector]")
    daemon.config.write_text(text[:start] + text[text.index("[camera]") :])
    return daemon


def held(rig: umbra.Client) -> bool:
    return rig.stage().state in {StageState.HELD, StageState.IDLE}


def test_a_mesh_scan_homes_circles_and_ends_when_it_has_covered(bench: Daemon) -> None:
    with bench.start() as rig:
        run = rig.scan(MESH)
        info = run.wait(60)
        assert info.state is RunState.DONE
        assert info.end is not None
        assert "of the lit pixels are covered, 97.0% wanted" in info.end.reason
        result = run.result()
        assert result.facts["coverage"] > 0.96
        assert result.facts["hole_fraction"] == pytest.approx(math.pi / 4 * 0.625**2, abs=1e-4)
        assert result.facts["truth"]["rmse_direct"] < 0.06  # 160 x 120: edges of holes included
        records = list(FrameStore.open(bench.data / "runs" / run.id, readonly=True).records())
        taken = [r for r in records[len(records) // 2 :] if not r.missing]
        places = np.array([r.stage_mm for r in taken])
        away = np.hypot(*(places - (250.0, 150.0)).T)
        np.testing.assert_allclose(away, 18.0, atol=1.0)  # on the planned circle
        until(lambda: held(rig))
        assert "the stage is homed first" in bench.log()


def test_the_time_limit_ends_it_and_says_so(bench: Daemon) -> None:
    limited = msgspec.structs.replace(ENDLESS, time_limit_s=2.0)
    with bench.start() as rig:
        run = rig.scan(limited)
        info = run.wait(60)
        assert info.state is RunState.DONE
        assert info.end is not None
        assert info.end.reason.startswith("the time limit of 2 s: ")
        progress_file = json.loads((bench.data / "runs" / run.id / "quality.json").read_text())
        assert 0 < progress_file["coverage"] < 1
        run = rig.scan(msgspec.structs.replace(limited, time_limit_s=1e-6))
        info = run.wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert info.end.code == "no_result"
        assert "needs 2 frames, 0 came so far. It ended for: the time limit" in info.end.reason
        rig.resume(run.id)  # it goes on from there, for as short a time
        assert run.wait(60, check=False).state is RunState.FAILED


def test_abort_and_pause_hold_the_stage(bench: Daemon) -> None:
    with bench.start() as rig:
        run = rig.scan(ENDLESS)
        recorded(rig, run.id, 20)
        rig.pause()
        until(lambda: run.refresh().state is RunState.PAUSED)
        until(lambda: held(rig))
        before = rig.stage().position_mm
        assert rig.stage().position_mm == before
        rig.resume()
        at = run.refresh().recorded
        recorded(rig, run.id, at + 30)
        assert rig.stage().state is StageState.MOVING
        rig.abort(run.id)
        until(lambda: run.refresh().state is RunState.ABORTED)
        until(lambda: held(rig))


def test_a_stage_that_vanishes_fails_the_run_and_must_be_homed_again(daemon: Daemon) -> None:
    configured(daemon, stage='faults = ["vanish@30"]')
    with daemon.start() as rig:
        run = rig.scan(ENDLESS)
        info = run.wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert info.end.code == "device_lost"
        assert "stage" in info.end.reason
        until(lambda: all(d.health.value == "ready" for d in rig.devices()))
        assert rig.stage().state is StageState.UNKNOWN  # after a reconnect nothing is assumed
        rig.resume(run.id)
        recorded(rig, run.id, info.recorded + 10)
        assert daemon.log().count("the stage is homed first") == 2
        rig.abort(run.id)


def test_a_killed_mesh_scan_goes_on_to_the_same_bits(bench: Daemon) -> None:
    from daemon.scans.catalog import method_for
    from daemon.scans.method import Bench
    from drivers.base.camera import CameraInfo
    from drivers.base.pixelformat import PixelFormat
    from drivers.base.stage import StageInfo

    with bench.start() as rig:
        run = rig.scan(MESH).id
        recorded(rig, run, 15)
        bench.kill()
    with bench.start() as rig:
        kept = len(FrameStore.open(bench.data / "runs" / run, readonly=True))
        assert rig.run(run).refresh().state is RunState.INTERRUPTED
        rig.resume(run)
        info = rig.run(run).wait(60)
        assert info.state is RunState.DONE
        assert info.recorded > kept
        result = rig.run(run).result()
    camera = CameraInfo(160, 120, PixelFormat.MONO12, black_level=63.0)
    method = method_for(MESH, Bench(camera, stage=StageInfo(((0, 500), (0, 300)), 200.0)))
    estimator = method.estimator()
    frames = FrameStore.open(bench.data / "runs" / run, readonly=True)
    for record in frames.records():
        if record.missing:  # a loaded machine loses frames of a stream, and says so
            continue
        estimator.update(frames.read(record.index), record.observation)
    again = estimator.result()
    assert isinstance(again, Components)
    assert np.array_equal(result.direct, again.direct, equal_nan=True)
    assert np.array_equal(result.global_, again.global_, equal_nan=True)


def test_a_stick_is_swept_by_the_stage(daemon: Daemon) -> None:
    configured(daemon, stage='occluder = "stick"\nstick_mm = 12', scale=4)
    with daemon.start() as rig:
        run = rig.scan(umbra.Stick(sweep_mm=(60.0, 440.0), feed_mm_s=60.0, sweeps=1, coverage=1.0))
        info = run.wait(60)
        assert info.state is RunState.DONE
        assert info.end is not None
        assert info.end.reason == "the stage's motion has come to its end"
        truth = run.result().facts["truth"]
        assert truth["rmse_direct"] < 0.06


def test_a_scan_is_not_resumed_when_the_sun_has_gone_on(daemon: Daemon) -> None:
    spec = umbra.Mesh(
        hole_mm=12.5, pitch_mm=20.0, coverage=1.0, time_limit_s=600.0, sun=True, drift_deg=1e-4
    )
    bench = configured(daemon, scale=1)  # a clock that runs fast is ahead of the next daemon's
    with bench.start() as rig:
        run = rig.scan(spec).id
        recorded(rig, run, 5)
        bench.kill()
    with bench.start() as rig:
        rig.resume(run)
        info = rig.run(run).wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert info.end.code == "unsuitable"
        assert "the sun has gone" in info.end.reason
