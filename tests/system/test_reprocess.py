"""A run's frames again: the same bits where nothing is changed, other numbers where they were
wrong, without a camera, beside the queue, and whatever happens in the middle."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

import umbra
from daemon.storage.frames import FrameStore
from protocol.errors import Code, UmbraError
from protocol.messages.runs import RunState
from tests.system.harness import ENDLESS, FAST, Daemon, recorded, until
from tests.system.test_occluder import configured

pytestmark = pytest.mark.system

LONG = umbra.Checkerboard(average=6)


def contents(folder: Path) -> dict[str, str]:
    """Every file of a run by its digest, but for the log, which may be added to."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "log.jsonl"
    }


def without_a_camera(daemon: Daemon) -> None:
    text = daemon.config.read_text()
    daemon.config.write_text(text[: text.index("[camera]")])


def same(rig: umbra.Client, run: str, other: str) -> bool:
    first, second = rig.run(run).result(), rig.run(other).result()
    return all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        for name in ("direct", "global_", "quality")
    )


def command(daemon: Daemon, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "protocol.cli", "--rig", daemon.endpoint, *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_the_bits_are_the_same_and_the_parent_is_untouched(daemon: Daemon, tmp_path: Path) -> None:
    daemon.configure(scale=FAST)
    with daemon.start() as rig:
        parent = rig.scan(umbra.Checkerboard(note="the first"))
        parent.wait(60)
        folder = daemon.data / "runs" / parent.id
        before = contents(folder)
        again = rig.reprocess(parent)
        info = again.wait(60)
        assert (info.parents, info.recorded, info.planned) == ((parent.id,), 27, 27)
        assert info.end is not None
        assert info.end.reason == f"made from {parent.id}"
        assert same(rig, parent.id, again.id)
        child = daemon.data / "runs" / again.id
        assert not (child / "frames.zarr").exists()  # none copied
        records = FrameStore.open(folder, readonly=True).records()
        assert FrameStore.open(child, readonly=True).records() == records
        assert f"made from {parent.id}" in (child / "report.html").read_text()
        facts = [json.loads((f / "quality.json").read_text()) for f in (folder, child)]
        facts[0].pop("truth")  # only a simulated camera knows it, and there is none here
        assert facts[0] == facts[1]
        assert (folder / "preview.png").read_bytes() == (child / "preview.png").read_bytes()

        out = tmp_path / "out"
        changes = ("--estimator", "maxmin", "--leakage", "0.04")
        done = command(daemon, "reprocess", parent.id, *changes, "-o", str(out))
        assert done.returncode == 0, done.stderr
        told = json.loads((out / "quality.json").read_text())
        assert (told["estimator"], told["leakage"]) == ("maxmin", 0.04)
        assert f"from {parent.id}" in command(daemon, "runs").stdout
        wrong = command(daemon, "reprocess", parent.id, "--hole-fraction", "0.3")
        assert wrong.returncode == 2
        assert "hole_fraction" in wrong.stderr
        with pytest.raises(UmbraError, match="checker says what was shown") as caught:
            rig.reprocess(parent, checker=4)
        assert caught.value.code is Code.UNSUITABLE
        assert contents(folder) == before


def test_a_wrong_hole_fraction_is_put_right_with_no_camera_there(daemon: Daemon) -> None:
    configured(daemon)
    spec = umbra.Mesh(hole_fraction=0.5, radius_mm=18.0, feed_mm_s=100.0, time_limit_s=3.0)
    with daemon.start() as rig:
        wrong = rig.scan(spec)
        wrong.wait(60)
        daemon.stop()
    without_a_camera(daemon)
    with daemon.start() as rig:
        assert not any(device.kind == "camera" for device in rig.devices())
        kept, again = rig.reprocess(wrong.id), rig.reprocess(wrong.id, hole_fraction=0.3)
        follows = rig.reprocess(wrong.id, hole_fraction=None, hole_mm=12.5, pitch_mm=20.0)
        for run in (kept, again, follows):
            assert run.wait(60).state is RunState.DONE
        assert same(rig, wrong.id, kept.id)
        before, after = rig.run(wrong.id).result(), again.result()
        assert after.facts["hole_fraction"] == 0.3
        there = np.isfinite(before.global_ + after.global_)
        assert np.mean(there) > 0.5
        np.testing.assert_array_equal(after.direct[there], before.direct[there])
        np.testing.assert_allclose(  # the same umbra, by way of fewer holes
            after.global_[there], before.global_[there] * (0.5 / 0.3), rtol=1e-4
        )
        assert follows.facts()["hole_fraction"] == pytest.approx(0.3068, abs=1e-4)


def test_beside_the_queue_through_a_kill_and_an_emergency_stop(daemon: Daemon) -> None:
    daemon.configure(scale=FAST)
    with daemon.start() as rig:
        parent = rig.scan(LONG)
        parent.wait(60)
        slow = msgspec.structs.replace(ENDLESS, exposure_us=1e6)
        scans = [rig.scan(slow).id for _ in range(2)]
        recorded(rig, scans[0], 1)
        made = [rig.reprocess(parent, note=f"number {n}") for n in range(2)]
        assert [run.id for run in rig.queue()] == [scans[1]]
        with pytest.raises(UmbraError, match="waits beside the queue"):
            rig.move_queued(made[1].id, 0)
        news = list(made[1].progress())
        assert news[-1].state is RunState.DONE
        assert any(0 < now.recorded < 162 for now in news)
        made += [rig.reprocess(parent) for n in range(3)]
        made[4].abort()
        made += [rig.reprocess(parent) for _ in range(12)]  # enough to be killed in the middle of
        assert rig.run(scans[0]).refresh().state is RunState.RUNNING
        assert rig.run(scans[1]).refresh().state is RunState.QUEUED

        def in_the_middle() -> bool:
            now = rig.status().reprocessing
            return now is not None and now.state is RunState.RUNNING

        until(in_the_middle)
        daemon.kill()
    with daemon.start() as rig:
        rig.estop()  # it ends scans, and keeps nobody from a number
        states = [rig.run(run.id).refresh().state for run in made]
        assert states.count(RunState.INTERRUPTED) == 1
        rig.resume(made[states.index(RunState.INTERRUPTED)].id)
        for run in made[:4]:
            assert rig.run(run.id).wait(60).state is RunState.DONE
            assert same(rig, parent.id, run.id)
        assert rig.run(made[4].id).refresh().state is RunState.ABORTED
