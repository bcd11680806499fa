"""One image under fine stripes, or a stream of them (§4.4)."""

from __future__ import annotations

from typing import ClassVar

from daemon.scans.method import Bench, Unsuitable
from daemon.scans.pattern_scan import PatternMethod
from daemon.separation.estimator import Estimator
from daemon.separation.radiometry import Response
from daemon.separation.single import PeaksAndValleys
from protocol.patterns import Stripes
from protocol.scans.projected import SingleImage


class SingleImageMethod(PatternMethod[SingleImage]):
    """The same stripes again and again; the newest image is the result."""

    name: ClassVar[str] = "single-image"

    def __init__(self, spec: SingleImage, bench: Bench) -> None:
        camera = bench.camera
        if camera.pixel_format.bayer and spec.reduce % 2:
            raise Unsuitable(
                "a Bayer mosaic is reduced by an even number (--reduce): "
                "its colours are 2 px apart",
                "$.reduce",
            )
        if min(camera.width, camera.height) < max(spec.reduce, spec.window):
            raise Unsuitable(
                f"an image of {camera.width} x {camera.height} is too small for a window of "
                f"{spec.window} px and 1/{spec.reduce} of the resolution (--window, --reduce)",
                "$.window",
            )
        stripes = Stripes(width=spec.stripe, axis=spec.axis)
        super().__init__(spec, bench, [stripes] * spec.repeat)

    @property
    def even(self) -> bool:
        """See `PatternMethod`."""
        return False  # a stream may show anything

    @property
    def distinct(self) -> bool:
        """See `PatternMethod`."""
        return False

    def described(self) -> str:
        """See `PatternMethod`."""
        return "one image" if self.spec.repeat == 1 else f"{self.spec.repeat} images"

    def counted(self) -> str:
        """See `PatternMethod`."""
        return f"{super().counted()} (set --repeat)"

    @property
    def lit_fraction(self) -> float:
        """α of the stripes: as asked for, else their own on this projector, else a half."""
        return self.lit_fraction_of(self._patterns[:1])

    def separator(self, response: Response, average: int) -> Estimator:
        """See `PatternMethod`."""
        del average  # frames are averaged until the last of a pattern
        return PeaksAndValleys(
            response,
            lit_fraction=self.lit_fraction,
            leakage=self.leakage,
            window=self.spec.window,
            along=self.spec.along,
            reduce=self.spec.reduce,
            across=self.spec.axis,
            stripe=self.spec.stripe,
        )
