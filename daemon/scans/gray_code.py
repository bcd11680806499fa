"""Gray code and its inverses (§4.3)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
        self._images = code({axis: _bits(spec, bench, axis) for axis in spec.axes})
        super().__init__(spec, bench, code_patterns(self._images))

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


def code(bits: Mapping[patterns.Axis, int]) -> list[Coded]:
    """The images of a code with so many bits an axis: from the coarsest bit to the finest, each
    followed by its inverse."""
    return [
        Coded(axis, bit, inverted)
        for axis, count in bits.items()
        for bit in reversed(range(count))
        for inverted in (False, True)
    ]


def code_patterns(images: Iterable[Coded]) -> list[patterns.GrayCode]:
    """What the projector shows for them."""
    return [
        patterns.GrayCode(bit=image.bit, axis=patterns.Axis(image.axis), inverted=image.inverted)
        for image in images
    ]


def bits_for(size: int) -> int:
    """Bits that tell so many pixels apart."""
    return max(1, (size - 1).bit_length())


def _bits(spec: GrayCode, bench: Bench, axis: patterns.Axis) -> int:
    if spec.bits is not None:
        return spec.bits
    if bench.projector is None:
        raise Unsuitable(
            "how many bits the code has is not known without a projector: say so (--bits)", "$.bits"
        )
    projector = bench.projector
    return bits_for(projector.width if axis is patterns.Axis.X else projector.height)
