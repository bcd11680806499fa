"""Signals, and what is left to read after a restart."""

from __future__ import annotations

import signal

import pytest

import umbra
from protocol.messages.events import Logged, RigChanged
from protocol.messages.rig import RigState
from protocol.messages.runs import RunState
from tests.system.harness import ENDLESS, Daemon, recorded, until

pytestmark = pytest.mark.system


def test_a_second_signal_hurries(daemon: Daemon) -> None:
    # A hook that takes its time is what an orderly stop waits for.
    daemon.config.write_text(
        daemon.config.read_text() + '[hooks]\ndone = ["sleep", "100"]\ntimeout_s = 200\n'
    )
    with daemon.start() as rig:
        run = rig.scan(umbra.TwoImage())
        run.wait(60)
        rig.show(umbra.WHITE)
    assert daemon.process is not None
    daemon.process.send_signal(signal.SIGTERM)
    until(lambda: '"stopping"' in daemon.log())
    assert daemon.process.poll() is None
    daemon.process.send_signal(signal.SIGINT)
    assert daemon.process.wait(60) == 0  # the hook is not waited for
    last = daemon.log().splitlines()[-1]
    assert '"stopped in a hurry"' in last
    assert '"safe": true' in last
    with daemon.start() as rig:
        assert rig.run(run.id).refresh().state is RunState.DONE


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_the_log_says_which_signal_ended_it(daemon: Daemon, number: signal.Signals) -> None:
    daemon.launch()
    with daemon.connect():
        assert daemon.process is not None
        daemon.process.send_signal(number)
        assert daemon.process.wait(60) == 0  # a terminal that closes stops it in order, too
    assert f'"signal": "{number.name}"' in daemon.log()
    assert f'"reason": "{number.name}"' in daemon.log()
    assert '"stopped"' in daemon.log().splitlines()[-1]


def test_a_run_that_was_hurried_can_be_resumed(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(ENDLESS).id
        recorded(rig, run, 20)
    assert daemon.process is not None
    for _ in range(2):
        daemon.process.send_signal(signal.SIGTERM)
    assert daemon.process.wait(60) == 0
    with daemon.start() as rig:
        assert rig.run(run).refresh().state is RunState.INTERRUPTED
        assert rig.run(run).info.recorded >= 20
        rig.resume(run)
        recorded(rig, run, 30)


def test_a_runs_log_outlives_the_daemon(daemon: Daemon) -> None:
    with daemon.start() as rig:
        run = rig.scan(umbra.TwoImage())
        run.wait(60)
        until(lambda: any(r["event"] == "run done" for r in rig.log(run.id)))
        before = rig.log(run.id)
        daemon.kill()
    with daemon.start() as rig:
        assert rig.log(run.id) == before
        assert [r["event"] for r in before][:2] == ["run queued", "run begins"]
        assert all(r["run"] == run.id for r in before)
        assert rig.log(run.id, 1) == before[-1:]


def test_the_log_is_published_as_it_is_written(daemon: Daemon) -> None:
    with daemon.start() as rig, rig.subscribe("log") as events:
        until(lambda: events.next(0.2) is not None or bool(rig.scan(umbra.TwoImage())))
        seen = []
        while "run done" not in seen:
            notice = events.next(60)
            assert notice is not None
            assert isinstance(notice.body, Logged)
            seen.append(notice.body.record["event"])


def test_a_paused_rig_says_so(daemon: Daemon) -> None:
    with daemon.start() as rig, rig.subscribe("rig") as events:
        run = rig.scan(ENDLESS)
        recorded(rig, run.id, 3)
        rig.pause()
        until(lambda: rig.status().state is RigState.PAUSED)
        states = []
        while RigState.PAUSED not in states:
            notice = events.next(60)
            assert notice is not None
            assert isinstance(notice.body, RigChanged)
            states.append(notice.body.state)
        rig.resume()
        until(lambda: rig.status().state is RigState.SCANNING)
        rig.abort(run.id)
        until(lambda: rig.status().state is RigState.IDLE)
