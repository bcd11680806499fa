"""Gray code and its inverses (§4.3)."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.method import Bench, Unsuitable
from daemon.scans.pattern_scan import PatternMethod
from daemon.separation.estimator import Estimator
from daemon.separation.graycode import Coded, GrayCodeDecoder
from daemon.separation.radiometry import Response
from protocol import patterns
from protocol.scans.projected import GrayCode


class GrayCodeMethod(PatternMethod[GrayCode]):
    """For each axis, from the coarsest bit to the finest: the pattern, then its inverse."""

    name: ClassVar[str] = "gray-code"

    def __init__(self, spec: GrayCode, bench: Bench) -> None:
        if len(set(spec.axes)) < len(spec.axes):
            raise Unsuitable("each axis is to be named once", "$.axes")
        self._images = [
            Coded(axis, bit, inverted)
            for axis in spec.axes
            for bit in reversed(range(_bits(spec, bench, axis)))
            for inverted in (False, True)
        ]
        super().__init__(
            spec,
            bench,
            [
                patterns.GrayCode(bit=i.bit, axis=patterns.Axis(i.axis), inverted=i.inverted)
                for i in self._images
            ],
        )

    @property
    def even(self) -> bool:
        """See `PatternMethod`."""
        return False

    def described(self) -> str:
        """See `PatternMethod`."""
        count = len(self._images) // 2
        return f"{count} bits and their inverses"

    def counted(self) -> str:
        """See `PatternMethod`."""
        return f"{super().counted()} (set --bits or --axes)"

    def separator(self, response: Response, average: int) -> Estimator:
        """See `PatternMethod`."""
        return GrayCodeDecoder(response, images=self._images, leakage=self.leakage, average=average)


def _bits(spec: GrayCode, bench: Bench, axis: patterns.Axis) -> int:
    if spec.bits is not None:
        return spec.bits
    if bench.projector is None:
        raise Unsuitable(
            "how many bits the code has is not known without a projector: say so (--bits)", "$.bits"
        )
    projector = bench.projector
    size = projector.width if axis is patterns.Axis.X else projector.height
    return max(1, (size - 1).bit_length())
