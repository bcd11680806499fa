"""Two images: a checkerboard and its complement (§3.3)."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.method import Bench, Unsuitable
from daemon.scans.pattern_scan import FINE_PX, PatternMethod
from daemon.separation.estimator import Estimator
from daemon.separation.light_model import complement_determinants
from daemon.separation.pair import ComplementPair
from daemon.separation.radiometry import Response
from protocol.patterns import Checker
from protocol.scans.projected import TwoImage

_LEAST_DETERMINANT = 0.05
"""Noise grows with 1/determinant: below this, twenty-fold."""


class TwoImageMethod(PatternMethod[TwoImage]):
    """A checkerboard, then its complement; α is the first one's lit fraction."""

    name: ClassVar[str] = "two-image"

    def __init__(self, spec: TwoImage, bench: Bench) -> None:
        pattern = Checker(size=spec.checker)
        super().__init__(spec, bench, [pattern, Checker(size=spec.checker, inverted=True)])
        determinant = min(complement_determinants(self.lit_fraction, self.leakage))
        if determinant < _LEAST_DETERMINANT:
            raise Unsuitable(
                f"a pattern with lit fraction {self.lit_fraction:g} and leakage {self.leakage:g} "
                "and its complement do not tell direct from global: the lit fraction must be "
                "between 0 and 1, best near 0.5",
                "$.lit_fraction",
            )

    @property
    def lit_fraction(self) -> float:
        """α of the first image: as asked for, else the checkerboard's own on this projector."""
        return self.lit_fraction_of(self._patterns[:1])

    @property
    def even(self) -> bool:
        """See `PatternMethod`."""
        return self.spec.checker <= FINE_PX and abs(self.lit_fraction - 0.5) < 0.05

    def described(self) -> str:
        """See `PatternMethod`."""
        return "a pattern and its complement"

    def separator(self, response: Response, average: int) -> Estimator:
        """See `PatternMethod`."""
        return ComplementPair(
            response,
            lit_fraction=self.lit_fraction,
            leakage=self.leakage,
            average=average,
        )
