"""Random binary patterns (§3.5)."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from daemon.scans.method import Bench, Unsuitable
from daemon.scans.pattern_scan import FINE_PX, RankedMethod
from daemon.separation.residue import patch_weights
from protocol import patterns
from protocol.scans.projected import RandomBinary


class RandomBinaryMethod(RankedMethod[RandomBinary]):
    """Images in which patches are lit at random, each in the same number of them."""

    name: ClassVar[str] = "random-binary"

    def __init__(self, spec: RandomBinary, bench: Bench) -> None:
        alpha = 0.5 if spec.lit_fraction is None else spec.lit_fraction
        lit = round(alpha * spec.patterns)
        if not 0 < lit < spec.patterns:
            raise Unsuitable(
                f"{spec.patterns} images with lit fraction {alpha:g} leave patches that are never "
                "both lit and unlit: more images (--patterns), or a lit fraction nearer 0.5",
                "$.patterns",
            )
        super().__init__(
            spec,
            bench,
            [
                patterns.RandomBinary(
                    patch=spec.patch,
                    index=index,
                    count=spec.patterns,
                    lit_fraction=alpha,
                    seed=spec.seed,
                )
                for index in range(spec.patterns)
            ],
        )

    @property
    def even(self) -> bool:
        """See `PatternMethod`."""
        return self.spec.patch <= FINE_PX

    def described(self) -> str:
        """See `PatternMethod`."""
        return f"{self.spec.patterns} random patterns"

    def counted(self) -> str:
        """See `PatternMethod`."""
        return f"{super().counted()} (set --patterns)"

    def weights(self) -> NDArray[np.complex128]:
        """See `RankedMethod`."""
        return patch_weights(self.spec.patterns)
