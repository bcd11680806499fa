"""Checkerboard shifts (§4.1)."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from daemon import patterns
from daemon.scans.method import Bench, Unsuitable
from daemon.scans.pattern_scan import FINE_PX, RankedMethod
from daemon.separation.handedness import shift_weights
from protocol.patterns import Checker
from protocol.scans.projected import Checkerboard


class CheckerboardMethod(RankedMethod[Checkerboard]):
    """A checkerboard shifted over a square of offsets, rows first; each pixel lit and unlit."""

    name: ClassVar[str] = "checkerboard"

    def __init__(self, spec: Checkerboard, bench: Bench) -> None:
        _check_coverage(spec)
        offsets = [spec.shift * n for n in range(spec.shifts)]
        self._shifts = [(x, y) for y in offsets for x in offsets]
        shifted = [Checker(size=spec.checker, shift_x=x, shift_y=y) for x, y in self._shifts]
        super().__init__(spec, bench, shifted)

    @property
    def balanced(self) -> bool:
        """See `PatternMethod`."""
        return False

    @property
    def even(self) -> bool:
        """See `PatternMethod`."""
        return self.spec.checker <= FINE_PX

    @property
    def period(self) -> int:
        """See `PatternMethod`."""
        return 2 * self.spec.checker

    @property
    def grid(self) -> tuple[int, int]:
        """See `RankedMethod`."""
        return self.spec.shifts, self.spec.shifts

    def described(self) -> str:
        """See `PatternMethod`."""
        return f"{self.spec.shifts} x {self.spec.shifts} shifts"

    def counted(self) -> str:
        """See `PatternMethod`."""
        return f"{super().counted()} (set --shifts)"

    def weights(self) -> NDArray[np.complex128] | None:
        """See `RankedMethod`."""
        return shift_weights(self._shifts, 2.0 * self.spec.checker)


def _check_coverage(spec: Checkerboard) -> None:
    """Raise Unsuitable unless every pixel of one period is lit in some shift, unlit in another."""
    period = 2 * spec.checker
    lit = np.zeros((period, period), dtype=np.int64)
    offsets = sorted({spec.shift * n % period for n in range(spec.shifts)})
    for y in offsets:
        for x in offsets:
            shifted = Checker(size=spec.checker, shift_x=x, shift_y=y)
            lit += patterns.render(shifted, period, period) > 0
    missed = int(np.count_nonzero((lit == 0) | (lit == len(offsets) ** 2)))
    if missed:
        raise Unsuitable(
            f"{spec.shifts} x {spec.shifts} shifts of {spec.shift} px never both light and shade "
            f"{missed / period**2:.0%} of the pixels under {spec.checker} px checkers: the shifts "
            f"must span a checker and not step by its period "
            f"(--shift {max(1, spec.checker * 3 // 8)})",
            "$.shift",
        )
