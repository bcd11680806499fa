"""After a run: the hook hears of it, old runs make room, and memory is given back."""

from __future__ import annotations

import gc
import json
import sys
import weakref
from pathlib import Path

import pytest
import structlog.testing

from daemon import config
from daemon.runs import aftermath
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.messages.runs import End, RunState
from protocol.scans.projected import TwoImage

RIG = """
camera = {{driver = "virtual"}}
[storage]
{storage}
[hooks]
{hooks}
"""
KEEP = "import sys; open(sys.argv[1], 'wb').write(sys.stdin.buffer.read())"


def settings(storage: str = "", hooks: str = "") -> config.RigConfig:
    return config.parse(RIG.format(storage=storage, hooks=hooks), "test")


def ended(store: Store, state: RunState, at: str = "2026-01-01T00:00:00+00:00") -> RunFolder:
    run = store.create(TwoImage(), {}, by="", request_id="")
    run.update(state=state, ended=at, end=End(state=state, reason="because"))
    return run


@pytest.mark.parametrize(
    ("state", "hook", "told"),
    [
        (RunState.DONE, "done", True),
        (RunState.FAILED, "failed", True),
        (RunState.INTERRUPTED, "failed", True),
        (RunState.DONE, "failed", False),
        (RunState.ABORTED, "failed", False),  # whoever aborted it knows
    ],
)
def test_the_hook_has_the_runs_json_on_stdin(
    tmp_path: Path, state: RunState, hook: str, told: bool
) -> None:
    heard = tmp_path / "heard"
    command = json.dumps([sys.executable, "-c", KEEP, str(heard)])
    with Store(tmp_path / "data") as store:
        run = ended(store, state)
        aftermath.after(run, store, settings(hooks=f"{hook} = {command}"))
        assert heard.exists() is told
        if told:
            assert json.loads(heard.read_text())["id"] == run.id
            assert json.loads(heard.read_text())["end"]["reason"] == "because"


def test_a_hook_that_fails_or_hangs_does_no_harm(tmp_path: Path) -> None:
    with Store(tmp_path / "data") as store:
        run = ended(store, RunState.DONE)
        for hooks in (
            'done = ["/there/is/no/such/program"]',
            f'done = ["{sys.executable}", "-c", "import time; time.sleep(60)"]\ntimeout_s = 0.3',
            f'done = ["{sys.executable}", "-c", "print(\'no mail\'); raise SystemExit(3)"]',
        ):
            with structlog.testing.capture_logs() as logs:
                aftermath.after(run, store, settings(hooks=hooks))
            assert [entry["log_level"] for entry in logs] == ["error"]
        assert "no mail" in logs[0]["output"]


def test_old_runs_make_room_but_not_the_one_that_has_just_ended(tmp_path: Path) -> None:
    with Store(tmp_path / "data") as store:
        old = ended(store, RunState.DONE)
        waiting = store.create(TwoImage(), {}, by="", request_id="w")
        run = ended(store, RunState.DONE)
        aftermath.after(run, store, settings())
        assert {r.id for r in store.runs()} == {old.id, waiting.id, run.id}
        aftermath.after(run, store, settings(storage="keep_days = 1"))
        assert {r.id for r in store.runs()} == {waiting.id, run.id}


class Part:
    """Of a run that has ended; its parts know each other."""

    def __init__(self) -> None:
        self.whole = self


def test_what_only_refers_to_itself_is_given_back() -> None:
    gc.disable()
    try:
        left = weakref.ref(Part())
        assert left() is not None
        aftermath.give_back()
        assert left() is None
    finally:
        gc.enable()
