"""Which way of exposing is chosen, and why not another."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daemon.config import SequencerSection
from daemon.exposing.modes import GUARDS, Mode, choose, pace, whole_periods
from daemon.scans.method import Bench, Unsuitable
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo, SequenceLimits
from protocol.scans.occluded import Mesh
from protocol.scans.projected import Checkerboard

EXPOSURE_US = 5000.0
LIMITS = SequenceLimits(images=128, bits=1, period_us=(235.0, 1e6))
CAMERA = CameraInfo(
    640,
    480,
    PixelFormat.MONO12,
    max_rate_hz=100.0,
    readout_s=0.004,
    triggers=("hardware", "software", "none"),
)
PROJECTOR = ProjectorInfo(912, 1140, 60.0, sequence=LIMITS)
WIRED = SequencerSection(trigger_wired=True)


def mode(
    camera: CameraInfo = CAMERA,
    projector: ProjectorInfo | None = PROJECTOR,
    config: SequencerSection = WIRED,
    asked: str | None = None,
    exposure_us: float = EXPOSURE_US,
) -> tuple[Mode, str]:
    spec = Checkerboard(mode=asked)  # type: ignore[arg-type]
    choice = choose(spec, config, Bench(camera=camera, projector=projector), exposure_us)
    return choice.mode, choice.why


def test_the_fastest_that_the_devices_can_do() -> None:
    assert mode()[0] is Mode.HARDWARE
    found, why = mode(config=SequencerSection())
    assert found is Mode.SOFTWARE
    assert "trigger_wired" in why
    found, why = mode(projector=replace(PROJECTOR, sequence=None))
    assert found is Mode.SOFTWARE
    assert "cannot time a sequence" in why
    found, why = mode(camera=replace(CAMERA, triggers=("none",)))
    assert found is Mode.FREE
    assert "no hardware trigger" in why
    assert "no software trigger" in why
    assert mode(exposure_us=2e6)[0] is Mode.SOFTWARE  # no sequence is so slow
    assert mode(camera=replace(CAMERA, recorded=True))[0] is Mode.RECORDED
    assert mode(projector=None)[0] is Mode.SOFTWARE
    with pytest.raises(Unsuitable, match="trigger_wired") as caught:
        mode(camera=replace(CAMERA, triggers=("hardware",)), config=SequencerSection())
    assert "cannot run free" in str(caught.value)


def test_asked_for_by_name() -> None:
    assert mode(asked="software")[0] is Mode.SOFTWARE
    assert mode(asked="free")[0] is Mode.FREE
    assert mode(asked="hardware", config=SequencerSection())[0] is Mode.HARDWARE
    assert mode(config=SequencerSection(mode="free")) == (Mode.FREE, "as rig.toml says")
    assert mode(config=SequencerSection(mode="free"), asked="software")[0] is Mode.SOFTWARE
    assert mode(config=SequencerSection(mode="free", trigger_wired=True), asked="auto")[0] is (
        Mode.HARDWARE
    )


@pytest.mark.parametrize(
    ("asked", "camera", "projector", "exposure_us", "says"),
    [
        ("hardware", {}, {"sequence": None}, 5000, "cannot time a sequence by itself"),
        ("hardware", {"triggers": ("software", "none")}, {}, 5000, "takes no hardware trigger"),
        ("hardware", {}, {}, 2e6, r"one for 1000000 us at most: expose for 994925 us or less"),
        ("software", {"triggers": ("none",)}, {}, 5000, "takes no software trigger"),
        ("free", {"triggers": ("software",)}, {}, 5000, r"cannot run free \(its triggers: soft"),
    ],
)
def test_what_cannot_be_had_is_refused_with_the_reason(
    asked: str,
    camera: dict[str, object],
    projector: dict[str, object],
    exposure_us: float,
    says: str,
) -> None:
    with pytest.raises(Unsuitable, match=f"mode {asked}: .*{says}") as caught:
        mode(
            replace(CAMERA, **camera),  # type: ignore[arg-type]
            replace(PROJECTOR, **projector),  # type: ignore[arg-type]
            asked=asked,
            exposure_us=exposure_us,
        )
    assert caught.value.where == "$.mode"


def test_an_occluder_scan_follows_the_rig() -> None:
    bench = Bench(camera=CAMERA, projector=None)
    assert choose(Mesh(), WIRED, bench, EXPOSURE_US).mode is Mode.SOFTWARE


def test_the_pace_of_a_sequence() -> None:
    # What the camera needs, what the exposure needs, what the projector needs.
    assert pace(CAMERA, LIMITS, 5000, None).period_us == pytest.approx(10_000, rel=0.01)
    fast = replace(CAMERA, max_rate_hz=0.0, readout_s=0.0)
    assert pace(fast, LIMITS, 5000, None).period_us == pytest.approx(5125)
    assert pace(fast, LIMITS, 50, None).period_us == 235
    assert pace(fast, LIMITS, 50, 900).period_us == 900
    rolling = replace(fast, rolling_s=0.01)
    assert pace(rolling, LIMITS, 5000, None).period_us > 15_000
    slow = replace(fast, readout_s=0.02)
    assert pace(slow, LIMITS, 5000, None).period_us == 25_000
    with pytest.raises(
        Unsuitable, match=r"sequencer\.period_us is 3000, and the camera needs 5125"
    ):
        pace(fast, LIMITS, 5000, 3000)


def test_a_video_frame_holds_few_patterns() -> None:
    video = SequenceLimits(24, 1, (235.0, 16_416.0), total_us=16_416.0)
    fast = replace(CAMERA, max_rate_hz=0.0, readout_s=0.0)
    assert pace(fast, video, 400, None).images == 24
    assert pace(fast, video, 3000, None).images == 5
    with pytest.raises(Unsuitable, match="holds only 2 patterns") as caught:
        pace(fast, video, 6000, None)
    longest = float(str(caught.value).split("expose for ")[1].split(" us")[0])
    assert pace(fast, video, longest - 1, None).images == GUARDS + 1


@pytest.mark.parametrize(
    ("exposure_us", "better"),
    [(16_667, None), (33_333, None), (8000, 16_667), (20_000, 16_667), (27_000, 33_333)],
)
def test_an_exposure_that_is_no_whole_number_of_periods_is_a_warning(
    exposure_us: float, better: float | None
) -> None:
    found = whole_periods(exposure_us, 60.0)
    assert found is None if better is None else found == pytest.approx(better, abs=1)
    bench = Bench(camera=CAMERA, projector=PROJECTOR)
    warnings = {
        asked: choose(Checkerboard(mode=asked), WIRED, bench, exposure_us).warnings
        for asked in ("hardware", "software", "free")
    }
    assert warnings["hardware"] == ()
    assert bool(warnings["software"]) is (better is not None)
    assert warnings["free"] == warnings["software"]
    if better is not None:
        assert f"expose for {better:.0f} us" in warnings["software"][0]
