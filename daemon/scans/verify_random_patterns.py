"""Figure 4(c): random patterns (§3.5)."""

from __future__ import annotations

from typing import Any, ClassVar

from daemon.scans.verification import VerificationMethod
from daemon.separation import criteria
from daemon.separation.estimator import Measurement
from daemon.separation.verification import Anchors, Reading
from protocol.patterns import AnyPattern, RandomBinary, Unlit
from protocol.scans.verifications import VerifyRandomPatterns


class VerifyRandomPatternsMethod(VerificationMethod[VerifyRandomPatterns]):
    """See `VerifyRandomPatterns`."""

    name: ClassVar[str] = "verify-random-patterns"

    def count(self) -> int:
        """See `VerificationMethod`."""
        return self.spec.patterns

    def pattern(self, number: int, points: Anchors) -> AnyPattern:
        """See `VerificationMethod`."""
        return Unlit(
            base=RandomBinary(
                patch=self.spec.patch,
                index=number,
                count=self.spec.patterns,
                seed=self.spec.seed,
            ),
            points=points,
            size=self.spec.patch,
        )

    def conclude_readings(
        self, rows: list[list[Reading]], points: list[dict[str, Any]]
    ) -> Measurement:
        """See `VerificationMethod`."""
        return criteria.random_patterns(rows, points)
