"""Three ways of keeping frames in step with patterns, on the virtual rig, and what goes wrong."""

from __future__ import annotations

from typing import Any

import pytest

import umbra
from protocol.errors import Code, UmbraError
from protocol.messages.runs import RunInfo, RunState
from protocol.run import Run
from tests.system.harness import Daemon, recorded, until

pytestmark = pytest.mark.system

MODES: tuple[Any, ...] = ("hardware", "software", "free")
#: as many frames wait in the driver as there are in a sequence: the simulation renders slowly
DEEP = "buffers = 64\n"
PATIENCE = "[sequencer]\nframe_timeout_s = 0.4\n"


def counts(info: RunInfo) -> dict[str, int]:
    assert info.sequencing is not None
    found: dict[str, int] = info.sequencing["counts"]
    return found


def good(run: Run) -> RunInfo:
    """A whole scan whose result is right."""
    info = run.wait(60)
    assert (info.recorded, info.missing) == (27, 0)
    truth = run.result().facts["truth"]
    assert truth["rmse_direct"] < 0.08
    assert truth["rmse_global"] < 0.08
    return info


@pytest.mark.parametrize(
    ("mode", "faults", "seen"),
    [
        # One in each of the first four of five runs of the sequence: the trigger in the first, for
        # how many pulses a run has had when it is given up is a matter of time.
        (
            "hardware",
            ("drop-trigger@5", "duplicate-frame@9", "incomplete-frame@14", "torn-frame@30"),
            "torn",
        ),
        ("software", ("drop-trigger@6", "torn-frame@12", "duplicate-frame@16"), "torn"),
        ("free", ("duplicate-frame@9", "incomplete-frame@20", "timeout@30"), "no answer"),
    ],
)
def test_faults_on_the_way_cost_time_only(
    daemon: Daemon, mode: Any, faults: tuple[str, ...], seen: str
) -> None:
    listed = ", ".join(f'"{fault}"' for fault in faults)
    daemon.configure(camera=f"{DEEP}faults = [{listed}]", more=PATIENCE + "attempts = 6", scale=2)
    with daemon.start() as rig:
        info = good(rig.scan(umbra.Checkerboard(mode=mode)))
        assert counts(info)[mode] == 27
        assert counts(info)["repeated"] >= {"hardware": 4, "software": 2, "free": 1}[mode]
    assert seen in daemon.log()
    assert "exposed again" in daemon.log()


def test_auto_takes_sequences_where_the_wire_is_stated(daemon: Daemon) -> None:
    daemon.configure(
        camera=DEEP + 'faults = ["false-trigger@29"]',
        more=PATIENCE + "trigger_wired = true",
        scale=1,
    )
    with daemon.start() as rig:
        run = rig.scan(umbra.Checkerboard())
        info = good(run)
        assert info.sequencing is not None
        assert info.sequencing["mode"] == "hardware"
        assert counts(info)["hardware"] == 27
        assert counts(info)["repeated"] >= 1
        report = (daemon.data / "runs" / run.id / "report.html").read_text()
        assert "hardware: the projector triggers the camera" in report
    # The whole sequence came, and one frame more.
    assert "a frame came after the last one" in daemon.log()


def test_light_a_period_late_is_seen_even_under_coarse_patterns(daemon: Daemon) -> None:
    daemon.configure(camera=DEEP, projector='faults = ["late-flip:run@1"]', more=PATIENCE, scale=2)
    with daemon.start() as rig:
        info = rig.scan(umbra.GrayCode(mode="hardware", references=())).wait(60)
        assert (info.recorded, info.missing) == (14, 0)
        assert counts(info)["repeated"] >= 1
    assert "not in step with the triggers" in daemon.log()


ROLLING_US = 12_000.0


def rolling(daemon: Daemon, ms: int, told: str) -> None:
    daemon.configure(
        camera=f"{DEEP}rolling_ms = {ms}\nrolling_told = {told}\nframe_rate_hz = 60",
        more=PATIENCE,
        scale=1,
    )


def test_a_rolling_shutter(daemon: Daemon) -> None:
    rolling(daemon, 10, "true")
    with daemon.start() as rig:
        for mode in MODES:
            good(rig.scan(umbra.Checkerboard(mode=mode, exposure_us=ROLLING_US)))


@pytest.mark.parametrize("ms", [10, 80])
def test_a_rolling_shutter_that_nobody_spoke_of(daemon: Daemon, ms: int) -> None:
    rolling(daemon, ms, "false")
    with daemon.start() as rig:
        run = rig.scan(umbra.Checkerboard(mode="hardware", exposure_us=ROLLING_US))
        if ms == 10:
            good(run)  # at half the pace nothing is torn
        else:
            info = run.wait(60, check=False)
            assert info.state is RunState.FAILED  # never a wrong result
            assert info.missing == 27
            assert info.end is not None
            assert "no frame could be had of" in info.end.reason
        assert "torn" in daemon.log()


def test_a_wire_that_is_not_there_fails_the_run(daemon: Daemon) -> None:
    faults = ", ".join(f'"drop-trigger@{n}"' for n in range(1, 100))
    daemon.configure(camera=f"faults = [{faults}]", more=PATIENCE)
    with daemon.start() as rig:
        info = rig.scan(umbra.Checkerboard(mode="hardware")).wait(60, check=False)
        assert info.state is RunState.FAILED
        assert info.end is not None
        assert info.end.code == Code.DEVICE_TIMEOUT
        assert "no frame came for any of 29 trigger pulses" in info.end.reason
        assert "trigger_line" in info.end.reason
        assert info.recorded == info.missing == 0


def test_a_stream_without_a_whole_frame_is_given_up(daemon: Daemon) -> None:
    faults = ", ".join(f'"incomplete-frame@{n}"' for n in range(1, 200))
    daemon.configure(
        camera=f"faults = [{faults}]", more="[sequencer]\nframe_timeout_s = 0.4\nattempts = 2"
    )
    with daemon.start() as rig:
        info = rig.scan(umbra.TwoImage(mode="free")).wait(60, check=False)
        assert info.state is RunState.FAILED
        assert (info.recorded, info.missing) == (0, 4)
    assert "was wholly lit by its pattern" in daemon.log()


def test_what_the_devices_cannot_do_is_refused(daemon: Daemon) -> None:
    daemon.configure(camera='triggers = ["none"]\nframe_rate_hz = 60', scale=2)
    with daemon.start() as rig:
        for mode in MODES[:2]:
            with pytest.raises(UmbraError, match=f"mode {mode}: the camera takes no") as caught:
                rig.scan(umbra.Checkerboard(mode=mode))
            assert caught.value.code is Code.UNSUITABLE
        assert rig.runs() == ()
        info = good(rig.scan(umbra.Checkerboard()))
        assert info.sequencing is not None
        assert info.sequencing["mode"] == "free"
        assert counts(info)["passed"] > 0


def test_a_pause_a_kill_and_a_resume_in_the_middle_of_sequences(daemon: Daemon) -> None:
    # 60 frames in sequences of 8, half of a ring that cannot grow: 1 s each.
    scan = umbra.TwoImage(average=15, mode="hardware", exposure_us=30_000.0)
    more = PATIENCE + "ring_frames = 16\ntrigger_wired = true"
    daemon.configure(camera=DEEP, more=more, scale=1)
    with daemon.start() as rig:
        run = rig.scan(scan)
        until(lambda: run.refresh().state is RunState.RUNNING)
        rig.pause()
        until(lambda: run.refresh().state is RunState.PAUSED)
        held = run.refresh().recorded
        assert held < 60
        rig.resume()
        recorded(rig, run.id, 1)
        daemon.kill()
    daemon.configure(camera=DEEP, more=more, scale=1)
    with daemon.start() as rig:
        assert rig.run(run.id).refresh().state is RunState.INTERRUPTED
        rig.resume(run.id)
        info = rig.run(run.id).wait(60)
        assert (info.state, info.recorded, info.missing) == (RunState.DONE, 60, 0)
        aborted = rig.scan(scan)
        until(lambda: aborted.refresh().state is RunState.RUNNING)
        rig.abort()
        until(lambda: rig.status().run is None)
        assert good(rig.scan(umbra.Checkerboard(exposure_us=1e6 / 60))).state is RunState.DONE
