"""The live view, on real daemons: what comes, what goes on beside it, what ends it."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import umbra
from drivers.registry import UnknownDriver, load
from protocol.client import EventStream
from protocol.errors import Code, UmbraError
from protocol.messages.events import PreviewTaken, RigChanged
from protocol.messages.rig import RigState
from protocol.messages.runs import RunState
from protocol.scans.projected import SingleImage
from tests.system.harness import Daemon, recorded, until

pytestmark = pytest.mark.system


def coming(events: EventStream, count: int) -> list[tuple[PreviewTaken, dict[str, object]]]:
    """The next previews by hand."""
    seen: list[tuple[PreviewTaken, dict[str, object]]] = []
    while len(seen) < count:
        notice = events.next(60.0)
        assert notice is not None
        assert isinstance(notice.body, PreviewTaken)
        if not notice.body.run:
            seen.append((notice.body, dict(notice.arrays)))
    return seen


def test_pictures_with_what_is_over_exposed(daemon: Daemon) -> None:
    with daemon.start() as rig, rig.subscribe("preview") as events:
        rig.show(umbra.WHITE)
        rig.camera(exposure_us=60_000)
        rig.live(rate_hz=15)
        for body, arrays in coming(events, 3):
            picture, saturated = arrays["preview"], arrays["saturated"]
            assert isinstance(picture, np.ndarray)
            assert isinstance(saturated, np.ndarray)
            assert saturated.shape == picture.shape[:2]
            assert (picture[saturated > 0] > 100).any(axis=1).all()
            assert saturated.mean() >= body.facts["saturated"] > 0.2
        rig.camera(exposure_us=2_000)  # beside it
        until(lambda: coming(events, 1)[0][0].facts["exposure_us"] == 2_000)
        assert rig.snap().pixels.shape == (120, 160)
        body, arrays = coming(events, 2)[-1]
        assert body.facts["saturated"] < 0.01
        assert rig.preview(width=40).saturated is not None
        rig.stop_live()
        assert rig.status().state is RigState.MANUAL  # the pattern is still shown


def test_it_ends_when_nobody_renews_it(daemon: Daemon) -> None:
    with (
        daemon.start() as rig,
        rig.subscribe("preview") as events,
        rig.subscribe("rig") as changes,
    ):
        rig.live(rate_hz=15, lease_s=1.0)
        coming(events, 1)
        states: list[RigState] = []
        while RigState.IDLE not in states:
            notice = changes.next(60.0)
            assert notice is not None
            assert isinstance(notice.body, RigChanged)
            states.append(notice.body.state)
        assert states[0] is RigState.MANUAL
        assert rig.status().state is RigState.IDLE
        assert "nobody asked again" in daemon.log()


def test_frames_are_separated_as_they_come(daemon: Daemon) -> None:
    with daemon.start() as rig, rig.subscribe("preview") as events:
        rig.live(rate_hz=15, separate=SingleImage(stripe=4))
        bodies = coming(events, 6)
        assert {body.what for body, _ in bodies} == {"frame", "direct", "global"}
        assert rig.preview(what="global").pixels.ndim == 3
        rig.stop_live()
        with pytest.raises(UmbraError):
            rig.live(separate=SingleImage(reduce=3))  # a mosaic needs an even number


def test_a_scan_takes_the_camera(daemon: Daemon) -> None:
    with daemon.start() as rig, rig.subscribe("preview") as events:
        rig.live(rate_hz=15, lease_s=60)
        coming(events, 1)
        run = rig.scan(umbra.Checkerboard(average=8))
        recorded(rig, run.id, 2)
        with pytest.raises(UmbraError, match=run.id) as caught:
            rig.live()
        assert caught.value.code is Code.BUSY
        assert run.wait(60).state is RunState.DONE
        assert run.refresh().missing == 0
        rig.live(rate_hz=15)
        coming(events, 1)


def test_a_camera_that_vanishes_ends_it(daemon: Daemon) -> None:
    daemon.configure(camera='faults = ["vanish@10"]')
    with daemon.start() as rig, rig.subscribe("preview") as events:
        rig.live(rate_hz=15, lease_s=60)
        coming(events, 1)
        until(lambda: "live view ended" in daemon.log())

        def again() -> bool:
            try:
                rig.live(rate_hz=15)
            except UmbraError as error:
                return error.code is not Code.DEVICE_LOST
            return True

        until(again)
        coming(events, 1)


def test_the_command_line(daemon: Daemon, tmp_path: Path) -> None:
    def preview(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "protocol.cli", "preview", "--rig", daemon.endpoint, "--live",
             "--rate", "15", *arguments],
            capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip

    with daemon.start() as rig:
        rig.show(umbra.WHITE)
        rig.camera(exposure_us=60_000)
        shown = preview("--count", "3", "-o", str(tmp_path / "pictures"))
        assert shown.returncode == 0, shown.stderr
        names = sorted(p.name for p in (tmp_path / "pictures").iterdir())
        assert names == ["000001.png", "000002.png", "000003.png"]
        picture = cv2.imread(str(tmp_path / "pictures/000003.png"))
        assert picture is not None
        assert (picture == (255, 0, 255)).all(axis=2).mean() > 0.2
        one = preview("--count", "2", "--json", "-o", str(tmp_path / "live.png"), "--no-mark")
        assert [json.loads(line)["what"] for line in one.stdout.splitlines()] == ["frame"] * 2
        plain = cv2.imread(str(tmp_path / "live.png"))
        assert plain is not None
        assert not (plain == (255, 0, 255)).all(axis=2).any()
        both = preview(
            "--separate", "single-image", "--count", "1", "-o", str(tmp_path / "two.png")
        )
        assert both.returncode == 0, both.stderr
        assert rig.status().state is RigState.IDLE
        assert preview("--count", "1").returncode == 2  # no terminal, no -o


def test_a_preview_is_of_now_and_tells_its_age_where_it_is_not(
    daemon: Daemon, tmp_path: Path
) -> None:
    def mean() -> float:
        command = [sys.executable, "-m", "protocol.cli", "preview", "--rig", daemon.endpoint]
        out = subprocess.run(
            [*command, "--json", "-o", str(tmp_path / "a.png")],
            check=True,
            capture_output=True,
            timeout=100,
        ).stdout
        facts = json.loads(out)["facts"]
        assert facts["age_s"] < 30
        return float(facts["mean"])

    with daemon.start() as rig:
        rig.show(umbra.WHITE)
        white = mean()
        rig.show(umbra.BLACK)
        assert mean() < white / 2
        before = rig.preview().facts["age_s"]
        until(lambda: rig.preview().facts["age_s"] > before + 0.3)


def test_a_camera_that_only_runs_free(daemon: Daemon) -> None:
    try:
        load("camera", "gentl")
    except UnknownDriver as missing:
        pytest.skip(str(missing))
    package = importlib.util.find_spec("genicam")
    assert package is not None
    producer = next(Path((package.submodule_search_locations or [""])[0]).rglob("viky.cti"))
    text = daemon.config.read_text().replace("time_scale = 4", "")
    before, _, _ = text.partition("[projector]")
    camera = f'[camera]\ndriver = "gentl"\nproducer = "{producer}"\nserial = "0"\n'
    daemon.config.write_text(before + camera)
    with daemon.start() as rig, rig.subscribe("preview") as events:
        assert rig.snap().pixels.shape == (400, 400, 3)
        rig.live(rate_hz=5)
        coming(events, 3)
        assert rig.snap().pixels.max() > 0
        rig.stop_live()
