"""The blocking client against a rig that loses, repeats and garbles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from protocol.client import Client, connect
from protocol.messages import RunState
from protocol.scans import Checkerboard
from tests.protocol.fake import FakeRig


@pytest.fixture
def fake() -> Iterator[FakeRig]:
    with FakeRig() as rig:
        yield rig


@pytest.fixture
def rig(fake: FakeRig) -> Iterator[Client]:
    with connect(fake.endpoint, name="me") as client:
        yield client


def test_scan_to_result(fake: FakeRig, rig: Client) -> None:
    fake.finish_on_submit = True
    run = rig.scan(Checkerboard())
    assert [p.state for p in run.progress()] == [RunState.DONE]
    result = run.result()
    assert np.array_equal(result.direct, fake.arrays["direct"])
    assert getattr(result, "global") is result.global_
    assert result.final
    assert fake.runs[run.id].by == "me"
