"""A device's health is never better than what was last seen of it."""

from __future__ import annotations

import pytest

from daemon import config
from daemon.devices.rig import Rig
from drivers.base.errors import DeviceLost
from drivers.virtual.faults import Fault
from protocol.messages.rig import DeviceInfo, Health


def test_a_check_that_is_older_than_the_loss_says_nothing() -> None:
    told: list[DeviceInfo] = []
    rig = Rig(config.load(None), told.append)
    try:
        rig.connect()
        member = rig._members["camera"]
        member.next_try = 0.0
        rig.tend()  # asks for a sign of life
        assert member.pending is not None
        member.pending.result(60)  # and has it, but has not looked at it
        rig.failed(DeviceLost("camera", "grab", "gone"))
        rig.tend()
        [lost] = [d for d in rig.devices() if d.name == "camera"]
        assert (lost.health, lost.message) == (Health.LOST, "grab: gone"), "its name is beside it"
        rig.tend()  # connects again
        assert member.pending is not None
        member.pending.result(60)
        rig.tend()
        assert [d.health for d in rig.devices() if d.name == "camera"] == [Health.READY]
        assert [i.health for i in told if i.name == "camera"] == [
            Health.READY, Health.LOST, Health.READY,
        ]  # fmt: skip
    finally:
        rig.close()


def test_another_device_in_the_place_of_the_first_is_not_taken_for_it() -> None:
    rig = Rig(config.load(None), lambda _: None)
    try:
        rig.connect()
        camera = rig.camera
        camera.device.faults.inject(Fault.RENAME, act="check")  # type: ignore[attr-defined]
        with pytest.raises(DeviceLost):
            camera.call(lambda c: c.check(), 60.0)
        connect = rig._connecting(rig._members["camera"])
        with pytest.raises(DeviceLost):  # it is away for one attempt
            camera.call(connect, 60.0)
        with pytest.raises(DeviceLost, match="another device came back"):
            camera.call(connect, 60.0)
    finally:
        rig.close()
