"""sin(x + sin y) in shifted phases, and its random-phase kin (§4.3)."""

from __future__ import annotations

from math import tau
from typing import ClassVar

import numpy as np

from daemon.scans.method import Bench, Unsuitable
from daemon.scans.pattern_scan import FINE_PX, PatternMethod
from daemon.separation.estimator import Estimator
from daemon.separation.radiometry import Response
from daemon.separation.sinusoid import LeastSquares
from protocol import patterns
from protocol.scans.projected import RandomPhase, Sinusoid


class SinusoidMethod(PatternMethod[Sinusoid]):
    """N phases of each period, period by period; each phase 2π/N after the one before."""

    name: ClassVar[str] = "sinusoid"
    estimators = ("lsq",)

    def __init__(self, spec: Sinusoid, bench: Bench) -> None:
        shown = [
            patterns.Sinusoid(period=period, phase=phase, axis=spec.axis, weave=spec.weave)
            for period in spec.periods
            for phase in _phases(spec.phases)
        ]
        if len(set(spec.periods)) < len(spec.periods):
            raise Unsuitable("each period is to be named once", "$.periods")
        super().__init__(spec, bench, shown)

    @property
    def even(self) -> bool:
        """See `PatternMethod`."""
        return max(self.spec.periods) <= FINE_PX

    @property
    def balanced(self) -> bool:
        """See `PatternMethod`."""
        return False

    def described(self) -> str:
        """See `PatternMethod`."""
        count = len(self.spec.periods)
        periods = f" x {count} periods" if count > 1 else ""
        return f"{self.spec.phases} phases{periods}"

    def counted(self) -> str:
        """See `PatternMethod`."""
        return f"{super().counted()} (set --phases or --periods)"

    def separator(self, response: Response, average: int) -> Estimator:
        """See `PatternMethod`."""
        del average  # every frame is fitted
        projector = self.bench.projector
        along = None
        if projector is not None:
            along = projector.width if self.spec.axis is patterns.Axis.X else projector.height
        return LeastSquares(
            response,
            phases=[
                (frequency, phase)
                for frequency in range(len(self.spec.periods))
                for phase in _phases(self.spec.phases)
            ],
            leakage=self.leakage,
            periods=self.spec.periods,
            size=along,
            weave=self.spec.weave,
            axis=self.spec.axis,
            blur_px=(self.bench.calibration or {}).get("optics_blur_px"),
        )


class RandomPhaseMethod(PatternMethod[RandomPhase]):
    """N phases of a pattern in which each patch has a phase of its own."""

    name: ClassVar[str] = "random-phase"
    estimators = ("lsq",)

    def __init__(self, spec: RandomPhase, bench: Bench) -> None:
        shown = [
            patterns.RandomPhase(patch=spec.patch, phase=phase, seed=spec.seed)
            for phase in _phases(spec.phases)
        ]
        super().__init__(spec, bench, shown)

    @property
    def even(self) -> bool:
        """See `PatternMethod`."""
        return self.spec.patch <= FINE_PX

    def described(self) -> str:
        """See `PatternMethod`."""
        return f"{self.spec.phases} phases"

    def counted(self) -> str:
        """See `PatternMethod`."""
        return f"{super().counted()} (set --phases)"

    def separator(self, response: Response, average: int) -> Estimator:
        """See `PatternMethod`."""
        del average  # every frame is fitted
        return LeastSquares(
            response,
            phases=[(0, phase) for phase in _phases(self.spec.phases)],
            leakage=self.leakage,
            patches=True,
        )


def _phases(count: int) -> list[float]:
    return [float(phase) for phase in np.arange(count) * (tau / count)]
