"""What survives: SIGKILL, SIGTERM, a restart, and a run that goes on to the same bits."""

from __future__ import annotations

import json

import numpy as np
import pytest

import umbra
from daemon.scans.catalog import method_for
from daemon.scans.method import Bench
from daemon.separation.estimator import Components
from daemon.storage.frames import FrameStore
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.errors import Code, UmbraError
from protocol.messages.runs import RunState
from tests.system.harness import ENDLESS, FAST, SLOW, Daemon, recorded, until

pytestmark = pytest.mark.system

SPEC = umbra.Checkerboard(average=2)


def over_the_same_frames(daemon: Daemon, run: str) -> tuple[np.ndarray, np.ndarray]:
    """Direct and global of one uninterrupted pass over what the run has recorded."""
    bench = Bench(
        CameraInfo(160, 120, PixelFormat.BAYER_RG12, black_level=63.0),
        ProjectorInfo(128, 96, 60.0),
    )
    estimator = method_for(SPEC, bench).estimator()
    frames = FrameStore.open(daemon.data / "runs" / run, readonly=True)
    for record in frames.records():
        estimator.update(frames.read(record.index), record.observation)
    components = estimator.result()
    assert isinstance(components, Components)
    return components.direct, components.global_


def test_a_killed_run_is_interrupted_and_resumes_to_the_same_bits(daemon: Daemon) -> None:
    daemon.configure(scale=SLOW)
    with daemon.start() as rig:
        run = rig.scan(SPEC).id
        recorded(rig, run, 8)
        daemon.kill()
    daemon.configure(scale=FAST)
    with daemon.start() as rig:
        info = rig.run(run).refresh()
        assert info.state is RunState.INTERRUPTED
        assert info.end is not None
        assert "umbra resume" in info.end.reason
        kept = len(FrameStore.open(daemon.data / "runs" / run, readonly=True))
        assert kept >= 8  # what was acknowledged is there
        rig.resume(run)
        info = rig.run(run).wait(60)
        assert info.state is RunState.DONE
        assert info.recorded == info.planned
        result = rig.run(run).result()
        direct, global_ = over_the_same_frames(daemon, run)
        assert np.array_equal(result.direct, direct, equal_nan=True)
        assert np.array_equal(result.global_, global_, equal_nan=True)


def test_sigterm_in_the_middle_is_a_clean_stop(daemon: Daemon) -> None:
    daemon.configure(scale=SLOW)
    with daemon.start() as rig:
        run = rig.scan(SPEC).id
        recorded(rig, run, 3)
        assert daemon.stop() == 0
    file = json.loads((daemon.data / "runs" / run / "run.json").read_text())
    assert file["state"] == "interrupted"
    assert file["recorded"] == len(FrameStore.open(daemon.data / "runs" / run, readonly=True))
    daemon.configure(scale=FAST)
    with daemon.start() as rig:
        rig.resume(run)
        assert rig.run(run).wait(60).state is RunState.DONE


def test_the_queue_survives_in_its_order(daemon: Daemon) -> None:
    with daemon.start() as rig:
        first = rig.scan(ENDLESS).id
        waiting = [rig.scan(umbra.TwoImage()).id for _ in range(3)]
        rig.move_queued(waiting[2], 0)
        recorded(rig, first, 1)
        daemon.kill()
    with daemon.start() as rig:
        order = [waiting[2], waiting[0], waiting[1]]
        for run in order:
            assert rig.run(run).wait(60).state is RunState.DONE
        begun = [rig.run(run).refresh().started for run in order]
        assert begun == sorted(begun)
        assert rig.run(first).refresh().state is RunState.INTERRUPTED


def test_a_submission_repeated_after_a_restart_is_the_same_run(daemon: Daemon) -> None:
    from daemon.storage.store import Store  # the request id is the daemon's own

    with daemon.start() as rig:
        run = rig.scan(umbra.TwoImage())
        run.wait(60)
        daemon.stop()
    with Store(daemon.data) as store:
        request = store.open(run.id).file.request_id
        found = store.find_request(request)
        assert found is not None
        assert found.id == run.id


def test_a_resume_needs_the_same_devices(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(ENDLESS).id
        recorded(rig, run, 1)
        daemon.kill()
    daemon.configure(camera='serial = "another"')
    with daemon.start() as rig:
        rig.resume(run)
        info = rig.run(run).wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert "camera was" in info.end.reason


def test_a_run_that_is_done_cannot_be_resumed(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(umbra.TwoImage())
        run.wait(60)
        with pytest.raises(UmbraError, match="is done: it cannot be resumed") as caught:
            rig.resume(run.id)
        assert caught.value.code is Code.WRONG_STATE


def test_two_daemons_do_not_share_a_data_folder(daemon: Daemon) -> None:
    with daemon.start():
        first = daemon.process
        second = daemon.launch()
        assert second.wait(60) == 1
        daemon.process = first
    assert "data" in daemon.log().splitlines()[-1]
    until(lambda: first is not None and first.poll() is None)
