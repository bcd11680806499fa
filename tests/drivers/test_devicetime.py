from __future__ import annotations

import numpy as np
import pytest

from drivers.devicetime import DeviceTime


def test_the_least_delayed_pair_counts() -> None:
    time = DeviceTime()
    assert not time.known
    with pytest.raises(ValueError, match="no pair"):
        time.to_rig(0)
    for device, delay in ((0, 900), (1000, 200), (2000, 5000)):
        time.observe(device, device + 10_000 + delay)
    assert time.known
    assert time.to_rig(3000) == 13_200
    time.forget()
    assert not time.known


def test_it_follows_a_clock_that_drifts() -> None:
    time = DeviceTime(window=20)
    rng = np.random.default_rng(0)
    worst = 0
    for k in range(2000):
        device = k * 10_000_000
        rig = round(device * (1 + 50e-6)) + 123_456_789
        time.observe(device, rig + int(rng.exponential(50_000)))
        if k > 20:
            worst = max(worst, abs(time.to_rig(device) - rig))
    assert worst < 100_000  # 0.1 ms after 20 s, in which the clocks went 1 ms apart
