"""Figure 4(b): the size of the unlit patch (§3.5)."""

from __future__ import annotations

from typing import Any, ClassVar

from daemon.scans.verification import VerificationMethod
from daemon.separation import criteria
from daemon.separation.estimator import Measurement
from daemon.separation.verification import Anchors, Reading
from protocol.patterns import WHITE, AnyPattern, Unlit
from protocol.scans.verifications import VerifyPatchSize


class VerifyPatchSizeMethod(VerificationMethod[VerifyPatchSize]):
    """See `VerifyPatchSize`."""

    name: ClassVar[str] = "verify-patch-size"

    def count(self) -> int:
        """See `VerificationMethod`."""
        return len(self.spec.sizes)

    def pattern(self, number: int, points: Anchors) -> AnyPattern:
        """See `VerificationMethod`."""
        return Unlit(base=WHITE, points=points, size=self.spec.sizes[number])

    def conclude_readings(
        self, rows: list[list[Reading]], points: list[dict[str, Any]]
    ) -> Measurement:
        """See `VerificationMethod`."""
        return criteria.patch_size(self.spec.sizes, rows, points)
