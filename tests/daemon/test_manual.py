"""Two people at one bench: what one has done must not end what the other has begun."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

import daemon.manual.manual
from daemon.devices.rig import Rig
from daemon.devices.snapshot import snap
from daemon.manual.manual import Manual
from daemon.pictures.viewfinder import Viewfinder
from daemon.scans.parameters import response_of
from drivers.base.camera import CameraSettings
from protocol.patterns import WHITE
from protocol.scans.spec import Radiometry
from tests.daemon.small_rig import small_rig


@pytest.fixture
def rig() -> Iterator[Rig]:
    with small_rig(time_scale=4, camera='faults = ["incomplete-frame@1"]') as made:
        yield made


@pytest.fixture
def manual(rig: Rig) -> Manual:
    return Manual(rig, Viewfinder(lambda _: None), lambda: None, lambda _: None)


def meanwhile(monkeypatch: pytest.MonkeyPatch, act: Any) -> None:
    """Have something done by another while a snap has the camera, once."""
    acts = [act]

    def taken(*args: Any) -> Any:
        found = snap(*args)
        if acts:
            acts.pop()()
        return found

    monkeypatch.setattr(daemon.manual.manual, "snap", taken)


def test_after_a_snap_the_rig_is_free(manual: Manual) -> None:
    manual.snap()
    assert not manual.active


def test_a_snap_does_not_end_what_is_shown_meanwhile(
    manual: Manual, monkeypatch: pytest.MonkeyPatch
) -> None:
    meanwhile(monkeypatch, lambda: manual.show(WHITE, 60.0))
    manual.snap()
    assert manual.active
    manual.end()


def test_a_snap_does_not_end_another(manual: Manual, monkeypatch: pytest.MonkeyPatch) -> None:
    def between() -> None:
        manual.snap()
        assert manual.active  # the first one still has the camera
        manual.tend()
        assert manual.active

    meanwhile(monkeypatch, between)
    manual.snap()
    assert not manual.active


def test_half_a_picture_chooses_no_exposure(manual: Manual, rig: Rig) -> None:
    pictures: list[bool] = []
    manual._viewfinder.offer = lambda frame, *_, **__: pictures.append(frame.incomplete)  # type: ignore[method-assign]
    response = response_of(Radiometry(), rig.bench())
    chosen = manual.expose(CameraSettings(), response)
    assert pictures == [False] * chosen.looks
    assert not manual.active
