"""A run's frames again: the same bits where nothing is changed, other numbers where they were
wrong, without a camera, beside the queue, and whatever happens in the middle."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import umbra
from daemon.frames import FrameStore
from protocol.errors import Code, UmbraError
from protocol.messages import RunState
from tests.system.harness import Daemon, recorded, until
from tests.system.test_occluder import MESH, configured

pytestmark = pytest.mark.system

LONG = umbra.Checkerboard(average=20)


def contents(folder: Path) -> dict[str, str]:
    """Every file of a run by its digest, but for the log, which may be added to."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "log.jsonl"
    }


def without_a_camera(daemon: Daemon) -> None:
    text = daemon.config.read_text()
    start = text.index("[camera]")
    daemon.config.write_text(text[:start])


def same(one: umbra.Client, run: str, other: str) -> bool:
    first, second = one.run(run).result(), one.run(other).result()
    return all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        for name in ("direct", "global_", "quality")
    )


def test_without_changes_the_bits_are_the_same_and_the_parent_is_untouched(
    daemon: Daemon,
) -> None:
    with daemon.start() as rig:
        parent = rig.scan(umbra.Checkerboard(note="the first"))
        parent.wait(60)
        folder = daemon.data / "runs" / parent.id
        before = contents(folder)
        again = rig.reprocess(parent)
        info = again.wait(60)
        assert info.state is RunState.DONE
        assert info.parents == (parent.id,)
        assert info.end is not None
        assert info.end.reason == f"made from {parent.id}"
        assert (info.recorded, info.planned) == (27, 27)
        assert same(rig, parent.id, again.id)
        assert contents(folder) == before
        child = daemon.data / "runs" / again.id
        assert not (child / "frames.zarr").exists()  # none copied
        records = FrameStore.open(folder, readonly=True).records()
        assert FrameStore.open(child, readonly=True).records() == records
        assert f"made from {parent.id}" in (child / "report.html").read_text()
        facts = [json.loads((f / "quality.json").read_text()) for f in (folder, child)]
        facts[0].pop("truth")  # only a simulated camera knows it, and there is none here
        assert facts[0] == facts[1]
        pictures = [(f / "preview.png").read_bytes() for f in (folder, child)]
        assert pictures[0] == pictures[1]  # with the frame, which is in the parent
        third = rig.reprocess(again.id, note="of a reprocessed run")
        assert third.wait(60).parents == (again.id, parent.id)
        assert same(rig, parent.id, third.id)


def test_a_wrong_hole_fraction_is_put_right_with_no_camera_there(daemon: Daemon) -> None:
    configured(daemon)
    spec = umbra.Mesh(hole_fraction=0.5, radius_mm=18.0, feed_mm_s=100.0, frames=60, coverage=0.9)
    with daemon.start() as rig:
        wrong = rig.scan(spec)
        wrong.wait(60)
        right = rig.scan(MESH)
        right.wait(60)
        daemon.stop()
    without_a_camera(daemon)
    with daemon.start() as rig:
        assert not any(device.kind == "camera" for device in rig.devices())
        again = rig.reprocess(wrong.id, hole_fraction=0.3)
        assert again.wait(60).state is RunState.DONE
        before, after = rig.run(wrong.id).result(), again.result()
        assert after.facts["hole_fraction"] == 0.3
        np.testing.assert_array_equal(after.direct, before.direct)
        full = before.direct + before.global_, after.direct + after.global_
        assert np.nanmean(full[1]) > np.nanmean(full[0])  # the same umbra through fewer holes
        geometry = rig.reprocess(wrong.id, hole_mm=12.5, pitch_mm=20.0, source_deg=0.1)
        geometry.wait(60)
        assert geometry.facts()["hole_fraction"] == 0.5  # what is told goes before what follows
        follows = rig.reprocess(wrong.id, hole_fraction=None, hole_mm=12.5, pitch_mm=20.0)
        follows.wait(60)
        assert follows.facts()["hole_fraction"] == pytest.approx(0.3068, abs=1e-4)
        same_mesh = rig.reprocess(right.id)
        same_mesh.wait(60)
        assert same(rig, right.id, same_mesh.id)
        aligned = rig.reprocess(right.id, align=False)  # each frame's use is decided again
        aligned.wait(60)
        assert aligned.facts()["camera_place"] == "not looked for"


def test_it_is_killed_in_the_middle_and_begins_anew(daemon: Daemon) -> None:
    with daemon.start() as rig:
        parent = rig.scan(umbra.Checkerboard(average=100))
        parent.wait(100)
        again = rig.reprocess(parent, estimator="maxmin")

        def in_the_middle() -> bool:
            now = rig.status().reprocessing
            return now is not None and now.recorded > 100

        until(in_the_middle)
        daemon.kill()
    with daemon.start() as rig:
        info = rig.run(again.id).refresh()
        assert info.state is RunState.INTERRUPTED
        rig.resume(again.id)
        assert rig.run(again.id).wait(60).state is RunState.DONE
        whole = rig.reprocess(parent.id, estimator="maxmin")
        assert whole.wait(60).recorded == 2700
        assert same(rig, again.id, whole.id)


def test_it_passes_scans_that_wait_and_can_be_aborted(daemon: Daemon) -> None:
    with daemon.start() as rig:
        parent = rig.scan(LONG)
        parent.wait(60)
        scans = [rig.scan(umbra.Checkerboard(average=200)).id for _ in range(2)]
        recorded(rig, scans[0], 5)
        first, second, third = (rig.reprocess(parent, leakage=b) for b in (0.01, 0.02, 0.03))
        assert third.id not in [run.id for run in rig.queue()]
        with pytest.raises(UmbraError, match="waits beside the queue"):
            rig.move_queued(third.id, 0)
        third.abort()
        assert third.refresh().state is RunState.ABORTED
        news = list(second.progress())
        assert news[-1].state is RunState.DONE
        assert any(now.run == second.id and now.recorded for now in news)
        assert first.refresh().state is RunState.DONE
        assert rig.run(scans[0]).refresh().state is RunState.RUNNING
        assert rig.run(scans[1]).refresh().state is RunState.QUEUED
        rig.estop()  # which ends the scan, and keeps nobody from a number
        last = rig.reprocess(parent)
        assert last.wait(60).state is RunState.DONE
        assert same(rig, parent.id, last.id)


def test_what_cannot_be_read_again_is_refused_by_name(daemon: Daemon) -> None:
    daemon.configure(scale=20)
    with daemon.start() as rig:
        parent = rig.scan(umbra.TwoImage())
        parent.wait(60)
        for changes, code, said in (
            ({"checker": 4}, Code.UNSUITABLE, "checker says what was shown"),
            ({"exposure_us": 5.0}, Code.UNSUITABLE, "exposure_us says"),
            ({"deadline_s": 5.0}, Code.UNSUITABLE, "deadline_s says"),
            ({"hole_fraction": 0.3}, Code.BAD_REQUEST, "two-image has no 'hole_fraction'"),
            ({"leakage": 1.5}, Code.BAD_REQUEST, "leakage: Expected float < 1.0"),
            ({"estimator": "topk"}, Code.UNSUITABLE, "two-image has no estimator topk"),
            ({"black": 4095.0}, Code.UNSUITABLE, "leaves nothing of the full scale"),
        ):
            with pytest.raises(UmbraError, match=said) as caught:
                rig.reprocess(parent, **changes)
            assert caught.value.code is code
        scan = rig.scan(umbra.Checkerboard(average=50))
        recorded(rig, scan.id, 5)
        with pytest.raises(UmbraError, match="when it has ended"):
            rig.reprocess(scan)
        scan.abort()
        dark = rig.scan(umbra.CalibrateDark(frames=2, exposures=2))
        dark.wait(60)
        with pytest.raises(UmbraError, match="umbra calibrate dark"):
            rig.reprocess(dark)
        assert len(rig.runs()) == 3  # nothing was queued
        daemon.stop()
    file = daemon.data / "runs" / parent.id / "run.json"
    old = json.loads(file.read_text())
    del old["bench"]
    file.write_text(json.dumps(old))
    text = daemon.config.read_text().replace("[storage]", "[storage]\nkeep_frames = false")
    daemon.config.write_text(text)
    with daemon.start() as rig:
        with pytest.raises(UmbraError, match="an older umbrad made it"):
            rig.reprocess(parent.id)
        bare = rig.scan(umbra.TwoImage())
        bare.wait(60)
        with pytest.raises(UmbraError, match="keeps no pixels") as caught:
            rig.reprocess(bare)
        assert caught.value.code is Code.FRAMES_MISSING


def test_a_calibration_that_came_later_applies_when_it_is_asked_for(daemon: Daemon) -> None:
    daemon.configure(scale=20)
    with daemon.start() as rig:
        parent = rig.scan(umbra.Checkerboard())
        parent.wait(60)
        rig.scan(umbra.CalibrateLeak()).wait(60)
        kept, now = rig.reprocess(parent), rig.reprocess(parent, calibration="now")
        for run in (kept, now):
            assert run.wait(60).state is RunState.DONE
        assert same(rig, parent.id, kept.id)
        assert "leak" not in kept.facts()["calibration"]["sources"]
        assert "leak" in now.facts()["calibration"]["sources"]
        assert now.facts()["leakage"] > kept.facts()["leakage"]


def test_the_command_line_does_it(daemon: Daemon, tmp_path: Path) -> None:
    daemon.configure(scale=20)
    with daemon.start() as rig:
        parent = rig.scan(umbra.Checkerboard())
        parent.wait(60)

    def umbra_(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "protocol.cli", "--rig", daemon.endpoint, *words],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    out = tmp_path / "out"
    done = umbra_(
        "reprocess", parent.id, "--estimator", "maxmin", "--leakage", "0.04", "-o", str(out)
    )
    assert done.returncode == 0, done.stderr
    facts = json.loads((out / "quality.json").read_text())
    assert (facts["estimator"], facts["leakage"]) == ("maxmin", 0.04)
    listed = umbra_("runs")
    assert f"from {parent.id}" in listed.stdout
    wrong = umbra_("reprocess", parent.id, "--hole-fraction", "0.3")
    assert wrong.returncode != 0
    assert "hole_fraction" in wrong.stderr
    assert umbra_("reprocess", parent.id, "--checker", "4").returncode == 2
