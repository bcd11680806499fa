"""Figure 4(d): the lit fraction (§3.5)."""

from __future__ import annotations

from typing import Any, ClassVar

from daemon.scans.verification import VerificationMethod
from daemon.separation import criteria
from daemon.separation.estimator import Measurement
from daemon.separation.verification import Anchors, Reading
from protocol.patterns import AnyPattern, RandomBinary, Unlit
from protocol.scans.verifications import VerifyLitFraction

_IMAGES = 100
"""Patches are lit in a part of so many images, of which each fraction shows another one."""


class VerifyLitFractionMethod(VerificationMethod[VerifyLitFraction]):
    """See `VerifyLitFraction`."""

    name: ClassVar[str] = "verify-lit-fraction"

    def count(self) -> int:
        """See `VerificationMethod`."""
        return len(self.spec.fractions) * self.spec.draws

    def pattern(self, number: int, points: Anchors) -> AnyPattern:
        """See `VerificationMethod`."""
        return Unlit(
            base=RandomBinary(
                patch=self.spec.patch,
                index=number % _IMAGES,
                count=_IMAGES,
                lit_fraction=self.spec.fractions[number // self.spec.draws],
                seed=self.spec.seed,
            ),
            points=points,
            size=self.spec.patch,
        )

    def conclude_readings(
        self, rows: list[list[Reading]], points: list[dict[str, Any]]
    ) -> Measurement:
        """See `VerificationMethod`."""
        return criteria.lit_fraction(self.spec.draws, rows, points)
