"""How pattern steps are exposed: chosen from what camera and projector can do, or as asked for.

    hardware   the projector times whole sequences and triggers the camera: no host in the loop
    software   each pattern is shown, then the camera is triggered
    free       the camera runs free; frames that saw another pattern, too, are left out

"auto" takes the first of these that the devices can do. That a cable goes from the projector's
trigger output to the camera no device can tell: rig.toml says so (`trigger_wired`), or nobody.
Pure: facts in, a choice out.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from daemon.config import SequencerSection
from daemon.scans.method import Bench, Unsuitable
from drivers.base.camera import CameraInfo
from drivers.base.projector import SequenceLimits
from protocol.scans.projected import PatternScan
from protocol.scans.spec import Spec

GUARDS = 2
"""A sequence begins with a white and a black image, by which its frames are known to be in step."""
_MARGIN_US = 100.0
_MARGIN = 0.005
"""What a period has beyond the exposure: the trigger's latency and jitter, the clocks' drift."""
_WHOLE = 0.02
"""How far from a whole number of periods an exposure may be."""


class Mode(enum.StrEnum):
    """A way of exposing pattern steps."""

    HARDWARE = "hardware"
    SOFTWARE = "software"
    FREE = "free"
    RECORDED = "recorded"  # photographs: nothing is to be kept in step


@dataclass(frozen=True, slots=True)
class Choice:
    """The mode of a run, why it is this one, and what speaks against the settings."""

    mode: Mode
    why: str
    warnings: tuple[str, ...] = ()
    strict: bool = False  # asked for by the scan: what it cannot do is refused, not done otherwise

    def facts(self, counts: Mapping[str, int]) -> dict[str, Any]:
        """As run.json keeps it. `counts`: frames by the way in which they were exposed; exposures
        `repeated`; frames of a stream that were `passed` over."""
        return {
            "mode": self.mode.value,
            "why": self.why,
            "warnings": list(self.warnings),
            "counts": dict(counts),
        }


@dataclass(frozen=True, slots=True)
class Pace:
    """What a hardware-timed sequence can be, at one exposure."""

    period_us: float
    images: int  # at most, guards included


def choose(spec: Spec, config: SequencerSection, bench: Bench, exposure_us: float) -> Choice:
    """The mode of a run: as the scan asks, else as rig.toml says. `exposure_us` 0: unknown.

    Raises Unsuitable, with the reason and the remedy, for a mode that these devices cannot do.
    """
    wanted = spec.mode if isinstance(spec, PatternScan) else None
    asked = wanted or config.mode
    if bench.camera.recorded:
        return Choice(Mode.RECORDED, "the camera is a recording")
    if bench.projector is None:
        # Nothing to keep in step with: dark frames, lights.
        triggered = "software" in bench.camera.triggers
        mode = Mode.SOFTWARE if triggered else Mode.FREE
        return Choice(mode, "the rig has no projector")
    reasons = {mode: _against(mode, asked, config, bench, exposure_us) for mode in _IN_ORDER}
    if asked != "auto":
        mode = Mode(asked)
        if reasons[mode]:
            raise Unsuitable(f"mode {mode}: {reasons[mode]}", "$.mode" if wanted else "")
        who = "asked for" if wanted else "as rig.toml says"
        strict = wanted is not None
        return Choice(mode, who, _warnings(mode, bench, exposure_us), strict=strict)
    passed: list[str] = []
    for mode in _IN_ORDER:
        if not reasons[mode]:
            why = "; ".join(passed) or "the projector triggers the camera"
            return Choice(mode, why, _warnings(mode, bench, exposure_us))
        passed.append(f"not {mode}: {reasons[mode]}")
    raise Unsuitable("no mode can be had; " + "; ".join(passed))


_IN_ORDER = (Mode.HARDWARE, Mode.SOFTWARE, Mode.FREE)


def pace(
    camera: CameraInfo, limits: SequenceLimits, exposure_us: float, period_us: float | None
) -> Pace:
    """What a sequence can be at an exposure; `period_us`: as rig.toml wants it, None: the shortest.

    The light of a pattern must last through the exposure of the last row, and the camera be ready
    for the next pulse. Raises Unsuitable, with the remedy, where no sequence can be.
    """
    lit = exposure_us + camera.rolling_s * 1e6
    needed = lit * (1 + _MARGIN) + _MARGIN_US
    if camera.max_rate_hz:
        needed = max(needed, 1e6 / camera.max_rate_hz * (1 + _MARGIN))
    else:
        needed = max(needed, lit + camera.readout_s * 1e6)
    shortest, longest = limits.period_us
    if period_us is not None and period_us < needed:
        raise Unsuitable(
            f"sequencer.period_us is {period_us:g}, and the camera needs {needed:.0f} us from one "
            f"trigger to the next at an exposure of {exposure_us:g} us: expose shorter, or raise it"
        )
    period = max(period_us or needed, shortest)
    if period > longest:
        raise Unsuitable(
            f"a pattern would have to last {period:.0f} us, and in a sequence the projector shows "
            f"one for {longest:.0f} us at most: expose for {_fitting(longest, camera):.0f} us or "
            "less"
        )
    images = limits.images
    if limits.total_us:
        images = min(images, int(limits.total_us / period))
    if images <= GUARDS:
        each = min(longest, (limits.total_us or longest) / (GUARDS + 1))
        raise Unsuitable(
            f"a sequence holds only {images} patterns of {period:.0f} us, and two of them prove "
            f"that it is in step: expose for {_fitting(each, camera):.0f} us or less"
        )
    return Pace(period, images)


def _fitting(period_us: float, camera: CameraInfo) -> float:
    """The longest exposure that fits into a period."""
    return max(0.0, (period_us - _MARGIN_US) / (1 + _MARGIN) - camera.rolling_s * 1e6)


def _against(
    mode: Mode, asked: str, config: SequencerSection, bench: Bench, exposure_us: float
) -> str:
    """Why a mode cannot be had, with the remedy; "" if it can."""
    if mode is Mode.HARDWARE:
        return _against_hardware(config, asked, bench, exposure_us)
    wanted, what = {
        Mode.SOFTWARE: ("software", "takes no software trigger"),
        Mode.FREE: ("none", "cannot run free"),
    }[mode]
    if wanted in bench.camera.triggers:
        return ""
    return f"the camera {what} (its triggers: {', '.join(bench.camera.triggers)})"


def _against_hardware(
    config: SequencerSection, asked: str, bench: Bench, exposure_us: float
) -> str:
    camera, projector = bench.camera, bench.projector
    if projector is None or projector.sequence is None:
        return "the projector cannot time a sequence by itself"
    if "hardware" not in camera.triggers:
        return f"the camera takes no hardware trigger (its triggers: {', '.join(camera.triggers)})"
    if not config.trigger_wired and asked != Mode.HARDWARE:
        return (
            "rig.toml does not say that the projector's trigger output is wired to the camera "
            "(sequencer.trigger_wired = true)"
        )
    try:
        pace(camera, projector.sequence, exposure_us, config.period_us)
    except Unsuitable as error:
        return str(error)
    return ""


def whole_periods(exposure_us: float, refresh_hz: float) -> float | None:
    """The exposure, us, of a whole number of a projector's periods that is nearest to one that is
    not; None: it is one."""
    ratio = exposure_us * 1e-6 * refresh_hz
    if ratio > 1 - _WHOLE and abs(ratio - round(ratio)) < _WHOLE * max(1.0, ratio):
        return None
    return max(1, round(ratio)) / refresh_hz * 1e6


def _warnings(mode: Mode, bench: Bench, exposure_us: float) -> tuple[str, ...]:
    """What the exposure must be for a projector that makes its picture refresh by refresh."""
    refresh_hz = bench.projector.refresh_hz if bench.projector else 0.0
    if mode is Mode.HARDWARE or not refresh_hz or not exposure_us:
        return ()
    better = whole_periods(exposure_us, refresh_hz)
    if better is None:
        return ()
    return (
        f"The exposure of {exposure_us / 1e3:.4g} ms is {exposure_us * 1e-6 * refresh_hz:.2f} of "
        f"the projector's periods: one that makes levels or colours within a period (DLP, LEDs in "
        f"turn) gives stripes and noise; expose for {better:.0f} us.",
    )
