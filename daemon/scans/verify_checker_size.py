"""Figure 4(e): the size of the checkers (§3.5)."""

from __future__ import annotations

from typing import Any, ClassVar

from daemon.scans.verification import VerificationMethod
from daemon.separation import criteria
from daemon.separation.estimator import Measurement
from daemon.separation.verification import Anchors, Reading
from protocol.patterns import AnyPattern, Checker, Unlit
from protocol.scans.verifications import VerifyCheckerSize


class VerifyCheckerSizeMethod(VerificationMethod[VerifyCheckerSize]):
    """See `VerifyCheckerSize`."""

    name: ClassVar[str] = "verify-checker-size"

    def count(self) -> int:
        """See `VerificationMethod`."""
        return len(self.spec.sizes)

    def pattern(self, number: int, points: Anchors) -> AnyPattern:
        """See `VerificationMethod`."""
        return Unlit(
            base=Checker(size=self.spec.sizes[number]), points=points, size=self.spec.patch
        )

    def conclude_readings(
        self, rows: list[list[Reading]], points: list[dict[str, Any]]
    ) -> Measurement:
        """See `VerificationMethod`."""
        return criteria.checker_size(self.spec.sizes, rows, points)
