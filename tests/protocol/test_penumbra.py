"""What a source of a size leaves of a shadow."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.penumbra import beside_a_stick, penumbra_mm
from protocol.scans.occluded import SUN_DEG


def test_the_suns_penumbra() -> None:
    assert penumbra_mm(1000.0, source_deg=SUN_DEG) == pytest.approx(9.25, rel=1e-3)


@pytest.mark.parametrize("width", [0.1, 1.0, 2.5, 3.9])
def test_what_shines_past_a_stick_is_the_rest_of_the_disc(width: float) -> None:
    across = (np.arange(4000) + 0.5) / 4000 * 4.0 - 2.0
    chord = np.sqrt(4.0 - across**2)
    seen = chord[np.abs(across) > width / 2].sum() / chord.sum()
    assert beside_a_stick(width, 4.0) == pytest.approx(seen, abs=1e-3)


def test_a_stick_as_wide_as_the_penumbra_has_an_umbra() -> None:
    assert beside_a_stick(4.0, 4.0) == beside_a_stick(5.0, 4.0) == beside_a_stick(1.0, 0.0) == 0.0
