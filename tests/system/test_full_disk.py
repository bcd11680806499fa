"""A disk that fills in the middle of a run: a small tmpfs, where the machine lets us mount one."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import umbra
from daemon.storage.frames import FrameStore
from protocol.errors import Code, UmbraError
from protocol.messages.rig import RigState
from protocol.messages.runs import RunState
from tests.system.harness import Daemon, recorded, until

pytestmark = pytest.mark.system

SPEC = umbra.Checkerboard(average=2)
FRAMES = 27 * 2


@pytest.fixture
def tiny(daemon: Daemon) -> Iterator[Path]:
    """The daemon's data folder on a disk of 24 MB, with no reserve."""
    daemon.data.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(daemon.data)]
    if os.geteuid() != 0 or subprocess.run(mounting, capture_output=True, check=False).returncode:
        pytest.skip("mounting a tmpfs needs root")
    daemon.configure(scale=0.5)
    text = daemon.config.read_text().replace("reserve_mb = 1", "reserve_mb = 0")
    daemon.config.write_text(text + "[sequencer]\nring_frames = 4\n")
    yield daemon.data
    daemon.close()
    subprocess.run(["umount", str(daemon.data)], check=True)


def fill(data: Path) -> None:
    """Take all that is left."""
    file = os.open(data / "ballast", os.O_WRONLY | os.O_CREAT)
    try:
        while True:
            os.write(file, bytes(4096))
    except OSError:
        pass
    finally:
        os.close(file)


def test_a_disk_that_fills_pauses_the_run_and_no_frame_is_lost(daemon: Daemon, tiny: Path) -> None:
    with daemon.start() as rig:
        run = rig.scan(SPEC)
        recorded(rig, run.id, 5)
        fill(tiny)
        until(lambda: rig.status().state is RigState.PAUSED)
        progress = rig.status().progress
        assert progress is not None
        assert "the disk is full" in progress.phase
        with pytest.raises(UmbraError) as caught:
            rig.resume()
        assert caught.value.code is Code.STORAGE_FULL
        assert rig.status().state is RigState.PAUSED
        (tiny / "ballast").unlink()
        rig.resume()
        info = run.wait(60)
        assert info.state is RunState.DONE
        assert (info.recorded, info.missing) == (FRAMES, 0)
    store = FrameStore.open(tiny / "runs" / run.id, readonly=True)
    store.verify()
    places = [(record.step, record.sub) for record in store.records()]
    assert places == sorted(set(places))
    assert len(places) == FRAMES


def test_a_run_that_waits_for_room_can_be_aborted(daemon: Daemon, tiny: Path) -> None:
    with daemon.start() as rig:
        run = rig.scan(SPEC)
        recorded(rig, run.id, 5)
        fill(tiny)
        until(lambda: rig.status().state is RigState.PAUSED)
        rig.abort(run.id)
        info = run.wait(60, check=False)
        assert info.state is RunState.ABORTED
        kept = len(FrameStore.open(tiny / "runs" / run.id, readonly=True))
        assert (info.recorded, info.missing) == (kept, 0)
        (tiny / "ballast").unlink()
        until(lambda: "aborted" in (tiny / "runs" / run.id / "run.json").read_text())
        assert rig.scan(umbra.TwoImage()).wait(60).state is RunState.DONE
