"""Driving a real daemon: two clients, pauses, aborts, emergency stops, work by hand."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
import zmq

import umbra
from protocol.errors import Code, UmbraError
from protocol.messages.rig import Health, RigState
from protocol.messages.runs import RunState
from tests.system.harness import ENDLESS, FAST, SLOW, Daemon, recorded, until

pytestmark = pytest.mark.system


def test_a_scan_from_command_to_components(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(umbra.Checkerboard())
        seen = [p.recorded for p in run.progress()]
        assert seen == sorted(seen)
        result = run.result()
        assert result.direct.dtype == np.float32
        assert result.direct.shape == (120, 160, 3)
        truth = result.facts["truth"]
        assert truth["rmse_direct"] < 0.08  # a projector of 128 x 96, edges and mirror included
        assert truth["rmse_global"] < 0.08
        files = {p.file for p in run.refresh().products}
        assert {"direct.tiff", "global.tiff", "quality.png", "report.html", "preview.png"} <= files


def test_a_second_client_while_a_scan_runs(daemon: Daemon) -> None:
    daemon.configure(scale=1)
    with daemon.start() as rig, daemon.connect() as other:
        run = rig.scan(umbra.Checkerboard(shift=2, shifts=8, average=10))  # 20 s
        recorded(other, run.id, 42)  # black, white and two patterns
        status = other.status()
        assert status.state is RigState.SCANNING
        assert status.run is not None
        assert status.run.id == run.id
        for act in (lambda: other.show(umbra.WHITE), other.snap):
            with pytest.raises(UmbraError, match=run.id) as caught:
                act()
            assert caught.value.code is Code.BUSY
        assert other.run(run.id).result().direct.shape == (120, 160, 3)  # so far
        assert other.preview() is not None
        other.pause()
        until(lambda: other.run(run.id).refresh().state is RunState.PAUSED)
        held = other.status().progress
        assert held is not None
        other.resume()
        recorded(other, run.id, held.recorded + 5)
        queued = other.scan(umbra.TwoImage())
        assert [r.id for r in other.queue()] == [queued.id]
        other.abort(queued.id)
        assert queued.refresh().state is RunState.ABORTED
        other.abort(run.id)
        info = run.wait(60, check=False)
        assert info.state is RunState.ABORTED
        assert info.recorded > held.recorded
        until(lambda: other.status().state is RigState.IDLE)


def test_an_emergency_stop_holds_until_reset(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(ENDLESS)
        waiting = rig.scan(umbra.TwoImage())
        recorded(rig, run.id, 3)
        rig.estop()
        assert rig.status().state is RigState.ESTOPPED
        info = run.wait(60, check=False)
        assert info.state is RunState.ABORTED
        assert info.end is not None
        assert info.end.reason == "emergency stop"
        for act in (lambda: rig.scan(umbra.TwoImage()), lambda: rig.show(umbra.WHITE)):
            with pytest.raises(UmbraError) as caught:
                act()
            assert caught.value.code is Code.ESTOPPED
        assert waiting.refresh().state is RunState.QUEUED
        rig.reset()
        assert waiting.wait(60).state is RunState.DONE


def test_work_by_hand(daemon: Daemon) -> None:
    with daemon.start() as rig:
        rig.show(umbra.WHITE)
        assert rig.status().state is RigState.MANUAL
        white = rig.snap()
        rig.show(umbra.BLACK)
        black = rig.snap()
        assert white.pixels.mean() > 2 * black.pixels.mean()
        before = rig.camera()
        assert before.exposure_us is not None
        halved = rig.camera(exposure_us=before.exposure_us / 2)
        assert halved.exposure_us == pytest.approx(before.exposure_us / 2)
        with pytest.raises(UmbraError) as caught:
            rig.camera(exposure_us=1e12)
        assert caught.value.code is Code.UNSUITABLE
        rig.dark()
        assert rig.status().state is RigState.IDLE
        run = rig.scan(umbra.TwoImage())  # a scan follows work by hand
        assert run.wait(60).state is RunState.DONE


def test_a_pattern_shown_by_hand_does_not_stay_for_ever(daemon: Daemon) -> None:
    with daemon.start() as rig:
        rig.show(umbra.WHITE, lease_s=0.2)
        until(lambda: rig.status().state is RigState.IDLE)


def test_a_scan_takes_over_from_work_by_hand(daemon: Daemon) -> None:
    with daemon.start() as rig:
        rig.show(umbra.WHITE)
        assert rig.scan(umbra.TwoImage()).wait(60).state is RunState.DONE


def test_a_held_rig_is_held(daemon: Daemon) -> None:
    with daemon.start() as rig, daemon.connect() as other:
        with rig.hold("ada", note="focusing"):
            with pytest.raises(UmbraError, match="held by ada \\(focusing\\)") as caught:
                other.show(umbra.WHITE)
            assert caught.value.code is Code.LOCKED
            rig.show(umbra.WHITE)
        until(lambda: other.status().lock is None)
        assert other.scan(umbra.TwoImage()).wait(60).state is RunState.DONE


@pytest.mark.parametrize(
    "fault", ["drop-trigger@9", "duplicate-frame@9", "incomplete-frame@9", "timeout@9"]
)
def test_a_frame_that_went_wrong_is_exposed_again(daemon: Daemon, fault: str) -> None:
    daemon.configure(camera=f'faults = ["{fault}"]', more="[sequencer]\nframe_timeout_s = 0.3")
    with daemon.start() as rig:
        info = rig.scan(umbra.Checkerboard()).wait(60)
        assert (info.state, info.recorded, info.missing) == (RunState.DONE, 27, 0)
    assert "frame exposed again" in daemon.log()


@pytest.mark.parametrize(
    ("call", "seen"),
    [
        (2, "not brighter than the black one"),  # white
        (3, "of the light of white"),  # the first pattern
        (9, "shows the pattern before its own"),
    ],
)
def test_a_projector_that_is_late_is_seen_by_what_it_shows(
    daemon: Daemon, call: int, seen: str
) -> None:
    # Its time stamps say that all is well; the exposure is over before the image has changed.
    slow = f'refresh_hz = 10\nfaults = ["late-flip@{call}"]'
    daemon.configure(projector=slow, camera="exposure_us = 8000", scale=1)
    with daemon.start() as rig:
        info = rig.scan(umbra.Checkerboard(shifts=3, shift=5)).wait(60)
        assert (info.state, info.recorded, info.missing) == (RunState.DONE, 11, 0)
    assert seen in daemon.log()


def test_a_frame_that_cannot_be_had_is_an_explicit_missing_record(daemon: Daemon) -> None:
    faults = ", ".join(f'"drop-trigger@{n}"' for n in (9, 10, 11))
    daemon.configure(camera=f"faults = [{faults}]", more="[sequencer]\nframe_timeout_s = 0.3")
    with daemon.start() as rig:
        info = rig.scan(umbra.Checkerboard()).wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert info.end.code == Code.FRAMES_MISSING
        assert (info.recorded, info.missing) == (26, 1)
        assert info.products  # made without it


def test_a_camera_that_vanishes_fails_the_run_and_comes_back(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["vanish@12*2"]')
    with daemon.start() as rig:
        run = rig.scan(umbra.Checkerboard())
        info = run.wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert info.end.code == Code.DEVICE_LOST
        assert info.recorded == 11

        def ready() -> bool:
            return all(d.health is Health.READY for d in rig.devices())

        until(ready)
        rig.resume(run.id)
        assert run.wait(60).state is RunState.DONE
        assert run.refresh().recorded == 27


def test_an_abort_is_heard_while_the_camera_hangs(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["stall@5"]')
    with daemon.start() as rig:
        run = rig.scan(umbra.Checkerboard())
        recorded(rig, run.id, 4)
        rig.abort()
        assert run.wait(60, check=False).state is RunState.ABORTED
        assert rig.scan(umbra.TwoImage()).wait(60).state is RunState.DONE


def test_what_does_not_fit_is_refused_at_once(daemon: Daemon) -> None:
    with daemon.start() as rig:
        with pytest.raises(UmbraError, match="both light and shade") as caught:
            rig.scan(umbra.Checkerboard(shift=16))
        assert caught.value.code is Code.UNSUITABLE
        assert rig.runs() == ()


def test_garbage_on_the_command_endpoint(daemon: Daemon) -> None:
    with daemon.start() as rig:
        with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
            socket.linger = 0
            socket.connect(daemon.endpoint)
            for n in range(200):
                socket.send_multipart([bytes([n % 256]) * n] * (1 + n % 3))
        assert rig.status().state is RigState.IDLE


def test_a_full_disk_is_said_before_the_scan(daemon: Daemon) -> None:
    text = daemon.config.read_text().replace("reserve_mb = 1", "reserve_mb = 1000000000")
    daemon.config.write_text(text)
    with daemon.start() as rig:
        info = rig.scan(umbra.TwoImage()).wait(60, check=False)
        assert info.end is not None
        assert info.end.code == Code.STORAGE_FULL
        assert info.recorded == 0


def test_stopping_with_the_parent(daemon: Daemon) -> None:
    process = daemon.launch_cold("--until-eof", stdin=subprocess.PIPE)
    with daemon.connect():
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(60) == 0


def test_a_bad_configuration_exits_with_2(daemon: Daemon) -> None:
    daemon.config.write_text("[camera]\ndriver = 'virtual'\nwdth = 3\n")
    assert daemon.launch_cold().wait(60) == 2
    assert (
        daemon.log().strip()
        == f'umbrad: {daemon.config}: camera.wdth: there is no such key; did you mean "width"?'
    )


def test_an_emergency_stop_before_the_run_has_the_devices(daemon: Daemon) -> None:
    # Manual work whose safe state waits to be halted: the run is chosen, but has no session yet.
    daemon.configure(projector='faults = ["stall:safe@2"]')
    with daemon.start() as rig, daemon.connect() as other:
        rig.show(umbra.WHITE)
        run = rig.scan(ENDLESS)
        other.estop()
        info = run.wait(60, check=False)
        assert info.state is RunState.ABORTED
        assert info.recorded == 0
        assert rig.status().state is RigState.ESTOPPED


def test_an_emergency_stop_outlives_the_daemon(daemon: Daemon) -> None:
    with daemon.start() as rig:
        waiting = rig.scan(ENDLESS)
        queued = rig.scan(umbra.TwoImage())
        recorded(rig, waiting.id, 1)
        rig.estop()
        daemon.kill()
    with daemon.start() as rig:
        assert rig.status().state is RigState.ESTOPPED
        assert rig.run(queued.id).refresh().state is RunState.QUEUED
        rig.reset()
        assert rig.run(queued.id).wait(60).state is RunState.DONE


def test_the_queue_waits_for_a_device_that_is_away(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["vanish@12*2"]')
    with daemon.start() as rig:
        first = rig.scan(umbra.Checkerboard())
        second = rig.scan(umbra.TwoImage())
        assert first.wait(60, check=False).state is RunState.FAILED
        assert second.wait(60).state is RunState.DONE


def test_a_resumed_run_sets_the_camera_as_it_was(daemon: Daemon) -> None:
    daemon.configure(scale=SLOW)
    with daemon.start() as rig:
        run = rig.scan(umbra.Checkerboard(average=2))
        recorded(rig, run.id, 5)
        daemon.kill()
    daemon.configure(scale=FAST)
    with daemon.start() as rig:
        rig.camera(pixel_format="Mono12")
        rig.resume(run.id)
        run = rig.run(run.id)
        run.wait(60)
        assert run.result().direct.shape == (120, 160, 3)
