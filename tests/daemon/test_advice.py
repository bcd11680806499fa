"""Advice on made scenes: what limits them is known, and the commands that it gives can be run."""

from __future__ import annotations

import shlex
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans import catalog
from daemon.scans.method import Bench, Expose, Taken
from daemon.separation.estimator import Measurement, NotYet
from drivers.base.camera import CameraInfo
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.cli.methods import METHODS
from protocol.cli.options import build, options_of
from protocol.scans.anyscan import AnyScan
from protocol.scans.measuring import Advise

PROJECTOR = ProjectorInfo(width=192, height=144, refresh_hz=60)
BLACK = 64.0


def bench(gain: float | None = None, known: dict[str, float] | None = None) -> Bench:
    return Bench(
        CameraInfo(
            192,
            144,
            PixelFormat.MONO12,
            black_level=BLACK,
            gain_range=None if gain is None else (0.0, 24.0),
            gain_unit="dB",
        ),
        PROJECTOR,
        exposure_us=16_666.7,
        gain=gain,
        calibration={"leakage": 0.0, "tone": list(range(256)), **(known or {})},
    )


def advised(
    *,
    blur: float = 0.6,
    noise: float = 4.0,
    scatter_px: float = 0.0,
    level: float = 3000.0,
    error: float = 0.01,
    gain: float | None = None,
    known: dict[str, float] | None = None,
) -> Measurement:
    """The method on a flat scene with these faults, seen pixel for pixel."""
    rng = np.random.default_rng(5)
    method = catalog.method_for(Advise(error=error), bench(gain, known))
    estimator = method.estimator()
    index = 0
    while (step := method.step(index, estimator.summary())) is not None:
        assert isinstance(step, Expose)
        light = seen(step, blur, scatter_px, level)
        for sub in range(step.frames):
            noisy = light + rng.normal(BLACK, noise, light.shape)
            pixels = np.asarray(np.clip(np.rint(noisy), 0, 4095), dtype=np.uint16)
            estimator.update(pixels, method.observe(step, Taken(index, sub, incomplete=False)))
        index += 1
    result = estimator.result()
    assert isinstance(result, Measurement)
    return result


def seen(step: Expose, blur: float, scatter_px: float, level: float) -> NDArray[Any]:
    if step.pattern is None:
        return np.zeros((144, 192))
    image = patterns.render(step.pattern, 192, 144).astype(np.float32) / 255
    sent = cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    indirect = np.full(image.shape, image.mean(), dtype=np.float32)
    if scatter_px:  # in the right third light scatters below the surface
        local = cv2.GaussianBlur(image, (0, 0), scatter_px, borderType=cv2.BORDER_REPLICATE)
        indirect[:, 128:] = np.asarray(local)[:, 128:]
    return np.asarray(level * (0.5 * sent + 0.5 * indirect))


def test_a_sharp_quiet_scene_reaches_what_is_wanted() -> None:
    facts = advised().facts
    assert facts["checker_px"] in {4, 6, 8}
    assert facts["expected_error"] < 0.01
    assert "is reached" in facts["advice"][1]
    assert facts["projector_px_per_camera_px"] == pytest.approx(1.0, abs=0.2)


def test_a_blurred_projector_asks_for_larger_checkers() -> None:
    sharp, blurred = advised(blur=0.5).facts, advised(blur=3.0).facts
    assert blurred["checker_px"] > sharp["checker_px"]
    assert blurred["errors_by_size"]["4"]["blur"] > 0.05


def test_noise_asks_for_more_images() -> None:
    quiet, noisy = advised(noise=4).facts, advised(noise=60).facts
    assert noisy["average"]["checkerboard"] > quiet["average"]["checkerboard"] == 1
    assert noisy["phases"] * noisy["average"]["sinusoid"] > 3 == quiet["phases"]
    assert noisy["noise_of_a_frame"] == pytest.approx(60 / 4095, rel=0.05)


def test_local_scattering_is_named_and_keeps_checkers_small() -> None:
    facts = advised(scatter_px=6.0).facts
    assert facts["limits"][0]["what"] == "local scattering" or facts["checker_px"] <= 8
    assert facts["errors_by_size"]["24"]["local_scattering"] > 0.05
    assert facts["checker_px"] <= 8


def test_a_dim_scene_is_exposed_longer_and_a_saturated_one_refused() -> None:
    dim = advised(level=700.0).facts
    assert dim["level_factor"] > 3
    assert dim["exposure_us"] % (1e6 / 60) == pytest.approx(0, abs=1)
    with pytest.raises(NotYet, match="expose more briefly"):
        advised(level=6000.0)


@pytest.mark.parametrize("scatter_px", [0.0, 6.0])
@pytest.mark.parametrize("blur", [0.3, 1.5, 3.0])
def test_the_commands_can_be_run(blur: float, scatter_px: float) -> None:
    facts = advised(blur=blur, scatter_px=scatter_px).facts
    assert len(facts["commands"]) == 2
    for command in facts["commands"]:
        method = catalog.method_for(parsed(command), bench())
        assert method.planned()


def parsed(command: str) -> AnyScan:
    """The spec of `umbra scan METHOD --option value ...`."""
    umbra, scan, method, *rest = shlex.split(command)
    assert (umbra, scan) == ("umbra", "scan")
    struct = METHODS[method]
    kinds = {o.flag: o for o in options_of(struct)}
    kinds["--exposure"] = kinds["--exposure-us"]
    given = {
        kinds[flag].name: value if kinds[flag].item else kinds[flag].kind(value)
        for flag, value in zip(rest[::2], rest[1::2], strict=True)
    }
    spec: AnyScan = build(struct, given)  # type: ignore[assignment]
    return spec


@pytest.mark.parametrize("size", range(1, 25))
def test_any_size_is_covered_by_the_shifts_that_are_advised(size: int) -> None:
    step = max(1, 3 * size // 8)
    shifts = -(-size // step) + 2
    command = f"umbra scan checkerboard --checker {size} --shift {step} --shifts {shifts}"
    assert catalog.method_for(parsed(command), bench()).planned()


def test_a_second_period_where_blur_is_not_known() -> None:
    assert len(advised(blur=0.9).facts["periods_px"]) == 2
    assert len(advised(blur=0.1).facts["periods_px"]) == 1
    known = advised(blur=0.9, known={"optics_blur_px": 0.9}).facts
    assert len(known["periods_px"]) == 1


def test_a_gain_is_traded_for_exposure() -> None:
    facts = advised(level=700.0, gain=12.0).facts
    assert facts["gain"] == 0.0
    assert facts["level_factor"] > 3
    assert "--gain 0" in facts["commands"][0]
    assert advised(level=3000.0).facts["gain"] is None  # of a camera without one
