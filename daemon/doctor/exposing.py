"""Trigger, light and latency, found out by exposing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from daemon.devices.devicethread import DeviceThread, Session
from daemon.doctor.verdict import failed, ok, skipped, warning
from daemon.exposing.modes import whole_periods
from drivers.base.camera import Acquisition, Camera, Frame
from drivers.base.errors import DeviceRefused, DeviceTimeout
from drivers.base.light import Light
from drivers.base.projector import Projector
from drivers.clock import NS, Clock
from drivers.sequence import mismatch
from protocol.messages.findings import Check

SHOTS = 4
SETTLE_S = 0.3
"""Longer than any projector's latency: before it is known there is no event to wait for."""
_PATIENCE_S = 2.0  # beyond exposure and readout, until a frame is called lost
_CALL_S = 5.0
_LATE_S = 0.25  # a frame that is here, or stamped, so late is worth a warning
_WIRE_S = 0.5  # a frame that no pulse has asked for by then does not come
_SEEN = 0.01  # of full scale: what light must change at least
_SATURATED = 0.01  # of the pixels
_PROMPT_S = 5e-3  # a frame that begins this soon after the flip began at it
_TRIES = 4  # a busy host takes longer to trigger it, at times


@dataclass(frozen=True, slots=True)
class Shot:
    """One triggered frame: its brightness (of full scale), its times, ns on the rig's clock."""

    mean: float
    saturated: float
    asked_ns: int
    start_ns: int
    end_ns: int
    here_ns: int
    exposure_us: float
    sequence: int


def shoot(camera: DeviceThread[Camera], session: Session, count: int = 1) -> list[Shot]:
    """Trigger so many frames, each when the one before is here. Raises DeviceError.

    Of a camera that cannot be triggered: frames of its stream that began after they were asked for.
    """

    def act(device: Camera) -> list[Shot]:
        info = device.info()
        triggered = "software" in info.triggers
        full = info.pixel_format.full_scale
        out = np.zeros(info.shape, info.pixel_format.dtype)
        exposure_us = device.settings().exposure_us or 0.0
        shots = []
        patience_s = exposure_us * 1e-6 + info.readout_s + _PATIENCE_S
        device.start(Acquisition.SOFTWARE if triggered else Acquisition.FREE)
        try:
            for _ in range(count):
                asked = device.clock.now_ns()
                if triggered:
                    device.trigger()
                frame = device.grab(out, patience_s)
                while not triggered and frame.start_ns < asked:
                    frame = device.grab(out, patience_s)
                shots.append(
                    Shot(
                        mean=float(frame.pixels.mean()) / full,
                        saturated=float(np.count_nonzero(frame.pixels >= full) / out.size),
                        asked_ns=asked,
                        start_ns=frame.start_ns,
                        end_ns=frame.end_ns,
                        here_ns=device.clock.now_ns(),
                        exposure_us=frame.exposure_us or exposure_us,
                        sequence=frame.sequence,
                    )
                )
        finally:
            device.stop()
        return shots

    exposure_s = (camera.device.settings().exposure_us or 0.0) * 1e-6
    return camera.call(act, count * (exposure_s + _PATIENCE_S) + _CALL_S, session)


def trigger(shots: Sequence[Shot]) -> Check:
    """Whether each trigger gave one frame, in a plausible time."""
    name = "camera: trigger"
    latency_s = float(np.median([s.start_ns - s.asked_ns for s in shots])) / NS
    here_s = float(np.median([s.here_ns - s.end_ns for s in shots])) / NS
    told = (
        f"{len(shots)} triggers, {len(shots)} frames; exposure begins {latency_s * 1e3:.2f} ms "
        f"after the trigger, the frame is here {here_s * 1e3:.1f} ms after its end"
    )
    steps = {b.sequence - a.sequence for a, b in pairwise(shots)}
    if steps - {1}:
        return warning(
            name,
            "frames came that no trigger asked for, or were lost between two triggers",
            "is a second trigger wired to the camera? check its trigger settings",
        )
    if any(s.end_ns < s.start_ns or s.start_ns < s.asked_ns - NS // 1000 for s in shots):
        return failed(
            name,
            f"a frame says that it began {-latency_s * 1e3:.1f} ms before its trigger",
            "its clock is not mapped well: unplug the camera and plug it in again",
        )
    if latency_s > _LATE_S or here_s > _LATE_S:
        return warning(name, told, "a busy bus or host: use another port, a smaller roi")
    return ok(name, told)


def stream(shots: Sequence[Shot]) -> Check:
    """Of a camera that cannot be triggered: what comes, and how fast."""
    apart = [b.start_ns - a.start_ns for a, b in pairwise(shots)]
    return warning(
        "camera: trigger",
        f"it cannot be triggered; it runs free, with a frame every {np.median(apart) / 1e6:.1f} ms",
        "it works, slower: frames that straddle a flip are skipped. A camera with a trigger is "
        "faster",
    )


def periods(exposure_us: float, refresh_hz: float) -> Check:
    """Whether an exposure is a whole number of the projector's periods."""
    name = "camera: exposure"
    ratio = exposure_us * 1e-6 * refresh_hz
    told = f"{exposure_us / 1e3:.2f} ms are {ratio:.2f} periods of the projector"
    whole = whole_periods(exposure_us, refresh_hz)
    if whole is None:
        return ok(name, told)
    return warning(
        name,
        f"{told}: one that flickers (colour wheel, PWM) makes stripes and noise",
        f"umbra camera --exposure {whole:.0f}",
    )


def lit(name: str, dark: Shot, light: Shot) -> list[Check]:
    """Whether light changes the frame, and does not saturate it."""
    gain = light.mean - dark.mean
    told = f"dark {100 * dark.mean:.1f}%, lit {100 * light.mean:.1f}% of full scale"
    if gain < _SEEN:
        return [
            failed(
                name,
                f"the light does not reach the camera: {told}",
                "lens cap, input of the projector, framing; or a longer exposure",
            )
        ]
    if light.saturated > _SATURATED:
        return [
            warning(
                name,
                f"{told}, {100 * light.saturated:.1f}% of the pixels saturated",
                f"umbra camera --exposure {light.exposure_us / 2:.0f}, or close the aperture",
            )
        ]
    return [ok(name, told)]


def latency(dark: Shot, early: Shot, light: Shot, flip_ns: int) -> Check:
    """Whether a frame that began right after the flip has all of the light. One that began later
    than that has light that is late as well, so it proves nothing."""
    name = "projector: latency"
    share = (early.mean - dark.mean) / (light.mean - dark.mean)
    after_s = (early.start_ns - flip_ns) / NS
    if not 0.97 < share < 1.03:
        missing_ms = (1 - share) * early.exposure_us / 1e3
        return failed(
            name,
            f"a frame that begins at the flip has {100 * share:.0f}% of its light: it comes some "
            f"{missing_ms:.1f} ms later than the projector says",
            "umbra calibrate latency, which scans then apply",
        )
    if after_s > _PROMPT_S:
        return warning(
            name,
            f"no frame began sooner than {after_s * 1e3:.1f} ms after the flip; light that is "
            "later than the projector says, but not by more, is not seen here",
            "umbra calibrate latency measures it; on a host that is less busy this sees more",
        )
    return ok(name, "a frame that begins at the flip has all of its light")


def projector_checks(
    camera: DeviceThread[Camera],
    projector: DeviceThread[Projector],
    session: Session,
    clock: Clock,
) -> list[Check]:
    """Black, white at once, white settled. Raises DeviceError."""
    info = projector.device.info()
    black, white = (np.full((info.height, info.width), level, np.uint8) for level in (0, 255))

    def flipped() -> tuple[Shot, Shot, int]:
        """A dark frame, and one as soon after the flip to white as can be; when it flipped."""
        projector.call(lambda p: p.show(black), _CALL_S, session)
        clock.wait(SETTLE_S, session.ended)
        [dark] = shoot(camera, session)
        flip_ns = projector.call(lambda p: p.show(white), _CALL_S, session)
        [early] = shoot(camera, session)
        return dark, early, flip_ns

    free = "software" not in camera.device.info().triggers
    for _ in range(1 if free else _TRIES):
        dark, early, flip_ns = flipped()
        if early.start_ns - flip_ns <= _PROMPT_S * NS:
            break
    clock.wait(SETTLE_S, session.ended)
    [light] = shoot(camera, session)
    checks = lit("projector: light", dark, light)
    if light.mean - dark.mean >= _SEEN and not free:
        checks.append(latency(dark, early, light, flip_ns))
    projector.call(lambda p: p.safe(), _CALL_S, session)
    checks.append(periods(light.exposure_us, info.refresh_hz))
    return checks


def wiring(
    camera: DeviceThread[Camera], projector: DeviceThread[Projector], session: Session
) -> Check:
    """Whether the projector's trigger output makes the camera expose, once an image and in order: a
    sequence of white and black images in turn. Raises DeviceError."""
    name = "camera: trigger wire"
    info, seen = camera.device.info(), projector.device.info()
    limits = seen.sequence
    assert limits is not None
    exposure_us = camera.device.settings().exposure_us or 0.0
    period_us = max(limits.period_us[0], 1.2 * exposure_us + 1e6 * info.readout_s + 1000.0)
    levels = (255, 0) * (SHOTS // 2)
    images = [np.full((seen.height, seen.width), level, np.uint8) for level in levels]
    try:
        loaded = projector.call(lambda p: p.load(images, period_us, period_us), _CALL_S, session)
    except DeviceRefused as error:
        return skipped(name, f"{error.problem}; {error.remedy}")

    def ready(device: Camera) -> None:
        device.stop()
        device.start(Acquisition.HARDWARE)

    def frames(device: Camera) -> list[tuple[Frame, float]]:
        """All that come, and how bright they are; one more than there should be, if it comes."""
        out = np.zeros(info.shape, info.pixel_format.dtype)
        came: list[tuple[Frame, float]] = []
        try:
            while len(came) <= loaded.images:
                frame = device.grab(out, 2 * loaded.period_us / 1e6 + info.readout_s + _WIRE_S)
                came.append((frame, float(frame.pixels.mean())))
        except DeviceTimeout:
            pass  # no more pulses: what the number says is judged below
        finally:
            device.stop()
        return came

    camera.call(ready, _CALL_S, session)
    began = projector.call(lambda p: p.run(), _CALL_S, session)
    came = camera.call(frames, (loaded.images + 1) * _CALL_S, session)
    projector.call(lambda p: p.stop(), _CALL_S, session)
    remedy = (
        "check the wire from the projector's trigger output, its level, and the camera's "
        "`trigger_line` and `trigger_edge`: docs/hardware.md, Hardware trigger"
    )
    if not came:
        return failed(name, f"no frame came for {loaded.images} pulses", remedy)
    if problem := mismatch(loaded, [frame for frame, _ in came], began):
        return failed(name, problem, remedy)
    if not all(b < a for a, b in zip(*[iter(m for _, m in came)] * 2, strict=True)):
        return failed(
            name,
            "as many frames as images, but white and black ones do not take turns",
            "the other edge of the pulse (`trigger_edge`)? light that comes later than its pulse "
            "(`trigger_delay_us`)? the lens cap?",
        )
    return ok(
        name, f"{len(came)} images, {len(came)} frames, {loaded.period_us / 1e3:.2f} ms apart"
    )


def light_checks(
    camera: DeviceThread[Camera], name: str, light: DeviceThread[Light], session: Session
) -> list[Check]:
    """A light off, then on, then off; the sun cannot be switched off. Raises DeviceError."""

    def switch(on: bool) -> Callable[[Light], None]:
        return lambda device: device.set(on)

    try:
        light.call(switch(False), _CALL_S, session)
    except DeviceRefused as error:
        return [skipped(f"light: {name}", error.problem)]
    [dark] = shoot(camera, session)
    light.call(switch(True), _CALL_S, session)
    [bright] = shoot(camera, session)
    light.call(switch(False), _CALL_S, session)
    return lit(f"light: {name}", dark, bright)


def recorded() -> Check:
    """A folder of pictures cannot be triggered."""
    return skipped("camera: trigger", "the camera is a recording")
