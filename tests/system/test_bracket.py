"""Exposure brackets end to end: on the virtual rig, through a kill and an abort, and recorded."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

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
from tests.system.harness import FAST, Daemon, recorded, until
from tests.system.test_command_line import SIZE, checker
from tests.system.test_command_line import umbra as run_umbra

pytestmark = pytest.mark.system

LONG_US = 45_000.0  # two thirds of the virtual scene are saturated
BRACKET = (0.25, 1.0, 4.0)


def separated(rig: umbra.Client, scan: Any) -> tuple[Any, dict[str, Any]]:
    run = rig.scan(scan)
    info = run.wait(60)
    assert info.state is RunState.DONE
    return info, run.facts()


def test_a_bracket_brings_the_highlights_back(daemon: Daemon) -> None:
    with daemon.start() as rig:
        before = rig.camera()
        _, plain = separated(rig, umbra.Checkerboard(exposure_us=LONG_US))
        info, facts = separated(rig, umbra.Checkerboard(exposure_us=LONG_US, bracket=BRACKET))
        assert rig.camera() == before
    assert info.recorded == info.planned == 3 * (2 + 25)
    assert plain["quality"]["saturated"]["fraction"] > 0.4
    assert facts["quality"]["saturated"]["fraction"] == 0
    assert facts["truth"]["rmse_direct_all"] < 0.6 * plain["truth"]["rmse_direct_all"]
    assert facts["bracket"]["exposures"] == list(BRACKET)
    for pair, ratio in facts["bracket"]["ratios_measured"].items():
        assert ratio == pytest.approx(4.0, rel=0.01), pair
    assert "exposed again" not in daemon.log()


def over_the_same_frames(daemon: Daemon, run: str) -> Components:
    """One uninterrupted pass over what the run has recorded."""
    bench = Bench(
        CameraInfo(160, 120, PixelFormat.BAYER_RG12, black_level=63.0),
        ProjectorInfo(128, 96, 60.0),
        exposure_us=LONG_US,
    )
    estimator = method_for(LONG, bench).estimator()
    frames = FrameStore.open(daemon.data / "runs" / run, readonly=True)
    for record in frames.records():
        estimator.update(frames.read(record.index), record.observation)
    components = estimator.result()
    assert isinstance(components, Components)
    return components


LONG = umbra.TwoImage(exposure_us=LONG_US, bracket=BRACKET, average=6)


def test_a_killed_run_resumes_within_a_bracket_to_the_same_bits(daemon: Daemon) -> None:
    daemon.configure(scale=1)
    with daemon.start() as rig:
        run = rig.scan(LONG).id
        recorded(rig, run, 10)  # of 5.6 s
        daemon.kill()
    daemon.configure(scale=FAST)
    with daemon.start() as rig:
        rig.camera(exposure_us=5_000.0)  # what the run goes on with is its own
        rig.resume(run)
        info = rig.run(run).wait(90)
        assert info.state is RunState.DONE
        assert info.recorded == info.planned == 72
        result = rig.run(run).result()
        expected = over_the_same_frames(daemon, run)
    assert np.array_equal(result.direct, expected.direct, equal_nan=True)
    assert np.array_equal(result.global_, expected.global_, equal_nan=True)


def test_after_an_abort_the_camera_has_its_own_exposure_again(daemon: Daemon) -> None:
    with daemon.start() as rig:
        before = rig.camera()
        run = rig.scan(umbra.TwoImage(exposure_us=LONG_US, bracket=(4.0, 2.0), average=1000)).id
        recorded(rig, run, 5)
        rig.abort()
        until(lambda: rig.run(run).refresh().state is RunState.ABORTED)
        until(lambda: rig.status().run is None)
        until(lambda: rig.camera() == before)


def test_auto_exposure_chooses_what_the_bracket_is_of(daemon: Daemon) -> None:
    with daemon.start() as rig:
        scan = umbra.TwoImage(auto_exposure=True, exposure_us=1e5, bracket=(1.0, 4.0))
        info, facts = separated(rig, scan)
        own_us = settings_of(daemon, info.id)["exposure_us"]
        frames = FrameStore.open(daemon.data / "runs" / info.id, readonly=True).records()
    assert own_us < 1e5
    assert {round(r.exposure_us / own_us, 6) for r in frames} == {1.0, 4.0}
    assert facts["bracket"]["ratios_measured"]["4/1"] == pytest.approx(4.0, rel=0.01)


def settings_of(daemon: Daemon, run: str) -> dict[str, Any]:
    """The camera's settings as run.json has them."""
    file = json.loads((daemon.data / "runs" / run / "run.json").read_text())
    settings: dict[str, Any] = file["rig"]["settings"]
    return settings


def test_exposures_beyond_the_cameras_are_refused_at_once(daemon: Daemon) -> None:
    with daemon.start() as rig, pytest.raises(UmbraError, match=r"choose from .*--bracket") as no:
        rig.scan(umbra.TwoImage(exposure_us=LONG_US, bracket=(1.0, 1e4)))
    assert no.value.code is Code.UNSUITABLE


# ---------------------------------------------------------------- photographs

EXPOSURES = (1.0, 4.0)


def photographs(folder: Path, bright: float = 1.0) -> list[NDArray[np.float64]]:
    """A pattern and its complement, each at both exposures, pattern by pattern; 8-bit RGB. A black
    photograph lies beside them for each exposure."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    colour = bright * np.array([1.0, 0.8, 0.5])
    direct = (75 + 45 * np.sin(x / 9) * np.cos(y / 11))[..., None] * colour
    global_ = 0.6 * direct  # of all pixels alike, so that no edge of the pattern is suspected
    folder.mkdir()
    number = 0
    for inverted in (False, True):
        lit = checker(0, 0) ^ inverted
        for exposure in EXPOSURES:
            light = (lit * direct + global_ / 2 + 3.0) * exposure
            image = np.round(np.clip(light, 0, 255)).astype(np.uint8)
            assert cv2.imwrite(str(folder / f"shot{number}.png"), image[..., ::-1])
            number += 1
    for exposure in EXPOSURES:
        black = np.full((*direct.shape[:2], 3), round(3.0 * exposure), np.uint8)
        assert cv2.imwrite(str(folder.parent / f"black{exposure:g}.png"), black)
    return [direct, global_]


def test_photographs_at_two_exposures_are_merged(tmp_path: Path) -> None:
    direct, global_ = photographs(tmp_path / "shots")
    done = run_umbra(
        "separate", "shots", "-m", "two-image", "--bracket", "1,4", "--black-frame", "black1.png",
        "--black-frame", "black4.png", "-o", "out", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for name, true in (("direct", direct), ("global", global_)):
        found = cv2.imread(str(tmp_path / "out" / f"{name}.tiff"), cv2.IMREAD_UNCHANGED)
        assert found is not None
        assert np.abs(found[..., ::-1] - true).max() < 1.6  # roundings, of two samples and black
    assert "times the light" not in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--bracket", "1,4,16"), "has 4 images; .*3 exposures 1, 4, 16.* need 6"),
        (
            ("--bracket", "1,4", "--black-frame", "black1.png"),
            r"the 2 exposures of the bracket \(1, 4\) take --black-frame 2 times.*: 1 files",
        ),
        (("--black-frame", "black1.png", "--black-frame", "black4.png"), "given once, unless"),
    ],
)
def test_a_wrong_number_of_photographs_is_said(
    tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    photographs(tmp_path / "shots")
    done = run_umbra("separate", "shots", "-m", "two-image", *arguments, "-o", "out", cwd=tmp_path)
    assert done.returncode != 0
    assert re.search(message, done.stderr.replace("\n", " ")), done.stderr
    assert not (tmp_path / "out").exists()


def test_exposures_that_are_not_as_said_are_told(tmp_path: Path) -> None:
    photographs(tmp_path / "shots", bright=0.3)
    done = run_umbra(
        "separate", "shots", "-m", "two-image", "--bracket", "1,2", "-o", "out", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    said = (done.stdout + done.stderr).replace("\n", " ")
    assert re.search(r"exposure 2 has (3.9|4)\S* times the light of exposure 1, not 2 times", said)
