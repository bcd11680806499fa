"""Events: gaps, restarts, slow readers; a run followed to its end; the lock's heartbeat."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import protocol.aio_run
import protocol.run
from protocol.aio import AsyncClient
from protocol.client import Client
from protocol.connection import EVENTS_HWM, PREVIEWS_HWM
from protocol.errors import Code, UmbraError
from protocol.following import Following
from protocol.messages import commands
from protocol.messages.envelopes import Event
from protocol.messages.events import PreviewTaken, Progressed, QueueChanged, RigChanged
from protocol.messages.rig import RigState
from protocol.messages.runs import End, Product, Progress, RunInfo, RunState
from protocol.run import Run
from protocol.scans.projected import Checkerboard
from tests.protocol.fake import UTC, FakeRig

NEVER_S = 1000.0


@pytest.fixture
def rig(fake: FakeRig) -> Iterator[Client]:
    with Client(fake.endpoint, name="me") as client:
        yield client


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only an event can make a follower ask."""
    for module in (protocol.run, protocol.aio_run):
        monkeypatch.setattr(module, "SILENCE_S", NEVER_S)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A follower asks all the time."""
    for module in (protocol.run, protocol.aio_run):
        monkeypatch.setattr(module, "SILENCE_S", 0.02)


def progressed(run: str, recorded: int) -> Progressed:
    progress = Progress(
        run=run,
        state=RunState.RUNNING,
        recorded=recorded,
        planned=25,
        missing=0,
        rejected=0,
        fraction=recorded / 25,
        rate_hz=12.5,
        remaining_s=(25 - recorded) / 12.5,
        phase="exposing",
        summary={"coverage": 0.5},
    )
    return Progressed(progress=progress)


def ended(state: RunState, reason: str = "", code: str = "") -> End:
    return End(state=state, reason=reason, code=code)


# ---------------------------------------------------------------- streams


def test_events_come_in_order_with_their_arrays(fake: FakeRig, rig: Client) -> None:
    with rig.subscribe("queue", "preview") as events:
        fake.publish(QueueChanged(queue=("a",)))
        fake.publish(RigChanged(state=RigState.MANUAL))  # not subscribed to
        fake.publish(QueueChanged(queue=("a", "b")))
        first, second = next(events), next(events)
        assert (first.body, second.body) == (
            QueueChanged(queue=("a",)),
            QueueChanged(queue=("a", "b")),
        )
        assert not first.gap
        assert not second.gap
        picture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
        fake.publish(PreviewTaken(run="", what="frame"), {"preview": picture})
        assert np.array_equal(next(events).arrays["preview"], picture)
        assert events.next(timeout_s=0.01) is None
    assert list(events) == []  # closed


def test_where_no_events_come_it_says_so(fake: FakeRig) -> None:
    fake.deaf = True
    with Client(fake.endpoint, timeout_s=0.3) as rig:
        with pytest.raises(UmbraError, match="no events came from") as caught:
            rig.subscribe("queue")
        assert caught.value.code is Code.UNREACHABLE
        run = rig.scan(Checkerboard())  # followed all the same, by asking
        fake.change(run.id, state=RunState.DONE, end=ended(RunState.DONE))
        assert run.wait(10).state is RunState.DONE


def test_no_topic_is_all_but_previews(fake: FakeRig, rig: Client) -> None:
    with rig.subscribe() as events:
        fake.publish(PreviewTaken(run="", what="frame"))
        fake.publish(RigChanged(state=RigState.MANUAL))
        assert next(events).event.topic == "rig"


def test_a_lost_event_shows_as_a_gap(fake: FakeRig, rig: Client) -> None:
    with rig.subscribe("queue") as events:
        fake.publish(QueueChanged(queue=()))
        fake.publish(QueueChanged(queue=("lost",)), lose=True)
        fake.publish(QueueChanged(queue=("a",)))
        fake.publish(QueueChanged(queue=("b",)))
        assert [next(events).gap for _ in range(3)] == [False, True, False]


def test_a_new_epoch_is_a_gap(fake: FakeRig, rig: Client) -> None:
    with rig.subscribe("queue") as events:
        fake.publish(QueueChanged(queue=()))
        fake.order(fake.new_epoch)
        fake.publish(QueueChanged(queue=()))
        fake.publish(QueueChanged(queue=()))
        assert [next(events).gap for _ in range(3)] == [False, True, False]


def test_garbled_events_are_passed_over(fake: FakeRig, rig: Client) -> None:
    with rig.subscribe("queue") as events:
        for garbage in ([b"queue"], [b"queue", b""], [b"queue", b"{}"], [b"queue", b"\xff", b"x"]):
            fake.publish_raw(*garbage)
        fake.publish(QueueChanged(queue=("a",)))
        assert next(events).body == QueueChanged(queue=("a",))


def test_a_slow_reader_gets_the_newest_preview_and_no_pile(fake: FakeRig, rig: Client) -> None:
    with rig.subscribe("preview", "queue") as events:
        shown = [np.full((2, 2, 3), i, np.uint8) for i in range(PREVIEWS_HWM)]
        for picture in shown:
            fake.publish(PreviewTaken(run="r", what="frame"), {"preview": picture})
        fake.publish(PreviewTaken(run="r", what="direct"), {"preview": shown[0]})
        fake.publish(QueueChanged(queue=("last",)))
        got: list[tuple[str, int]] = []
        while (notice := next(events)).event.topic == "preview":  # states never wait behind
            body = notice.body
            assert isinstance(body, PreviewTaken)
            got.append((body.what, int(notice.arrays["preview"].max())))
        assert len(got) <= 3
        assert events._sockets[1].rcvhwm == PREVIEWS_HWM
        assert events._sockets[0].rcvhwm == EVENTS_HWM


def test_drained_previews_are_conflated() -> None:
    import msgspec
    import zmq

    from protocol.connection import Inbox

    def message(sequence: int, what: str) -> list[zmq.Frame]:
        body = PreviewTaken(run="r", what=what)
        event = Event(topic="preview", sequence=sequence, epoch="e", utc=UTC, body=body)
        return [zmq.Frame(b"preview"), zmq.Frame(msgspec.json.encode(event))]

    notices = Inbox().take(
        [message(1, "frame"), message(2, "direct"), message(3, "frame"), message(4, "frame")]
    )
    assert [n.event.sequence for n in notices] == [2, 4]
    assert not any(n.gap for n in notices)


# ---------------------------------------------------------------- following a run


@pytest.mark.usefixtures("patient")
def test_progress_is_a_snapshot_and_then_the_events(fake: FakeRig, rig: Client) -> None:
    run = rig.scan(Checkerboard())
    other = rig.scan(Checkerboard())
    progress = run.progress()
    assert next(progress).state is RunState.QUEUED
    fake.await_subscribers(2)
    fake.change(run.id, state=RunState.RUNNING)
    assert next(progress).state is RunState.RUNNING
    fake.change(other.id, state=RunState.ABORTED)  # somebody else's
    for recorded in (1, 2):
        fake.publish(progressed(run.id, recorded))
        assert next(progress).recorded == recorded
    done = ended(RunState.DONE)
    fake.change(run.id, state=RunState.DONE, recorded=25, end=done)
    last = next(progress)
    assert (last.state, last.recorded, last.fraction) == (RunState.DONE, 25, 1.0)
    assert last.summary == {"coverage": 0.5}
    assert next(progress, None) is None
    assert run.state is RunState.DONE


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("how", ["lost", "restart"])
def test_a_gap_is_mended_by_a_snapshot(fake: FakeRig, rig: Client, how: str) -> None:
    run = rig.scan(Checkerboard())
    progress = run.progress()
    next(progress)
    fake.await_subscribers(2)
    if how == "lost":
        fake.change(run.id, state=RunState.FAILED, end=ended(RunState.FAILED, "gone"), lose=True)
    else:
        fake.order(fake.new_epoch)
        fake.change(run.id, tell=False, state=RunState.INTERRUPTED)
    other = rig.submit(Checkerboard())
    fake.change(other.id, state=RunState.RUNNING)  # news of another run gives the gap away
    assert next(progress).state in {RunState.FAILED, RunState.INTERRUPTED}
    assert next(progress, None) is None


@pytest.mark.usefixtures("impatient")
def test_silence_is_mended_by_a_snapshot(fake: FakeRig, rig: Client) -> None:
    run = rig.scan(Checkerboard())
    progress = run.progress()
    next(progress)
    fake.change(run.id, tell=False, state=RunState.DONE)
    assert next(progress).state is RunState.DONE


@pytest.mark.usefixtures("impatient")
def test_a_rig_that_vanishes_is_noticed() -> None:
    with contextlib.ExitStack() as stack:
        fake = stack.enter_context(FakeRig())
        with Client(fake.endpoint, timeout_s=1.5) as rig:
            progress = rig.scan(Checkerboard()).progress()
            next(progress)
            stack.close()
            with pytest.raises(UmbraError) as caught:
                next(progress)
    assert caught.value.code is Code.UNREACHABLE


@pytest.mark.usefixtures("impatient")
def test_a_restart_of_the_rig_is_followed() -> None:
    with contextlib.ExitStack() as first:
        fake = first.enter_context(FakeRig())
        with Client(fake.endpoint) as rig:
            run = rig.scan(Checkerboard())
            progress = run.progress()
            next(progress)
            first.close()
            with FakeRig(command=fake.endpoint, events=fake.events) as again:
                end = ended(RunState.INTERRUPTED, "umbrad was restarted")
                again.runs[run.id] = fake.runs[run.id]
                again.change(run.id, state=end.state, end=end)
                assert next(progress).phase == "umbrad was restarted"
                assert next(progress, None) is None


@pytest.mark.usefixtures("impatient")
def test_ctrl_c_ends_the_following_and_the_client_goes_on(fake: FakeRig, rig: Client) -> None:
    run = rig.scan(Checkerboard())
    progress = run.progress()
    next(progress)
    fake.on_request = lambda _: os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        next(progress)
    fake.on_request = None
    assert next(progress, None) is None
    assert [p.state for p in _two(run.progress())] == [RunState.QUEUED]


def _two(progress: Iterator[Progress]) -> Iterator[Progress]:
    """The first, and then away from it: the stream must be closed behind us."""
    yield next(progress)


def test_events_that_the_snapshot_holds_are_passed_over() -> None:
    following = Following("r")
    info = RunInfo(id="r", state=RunState.RUNNING, spec=Checkerboard(), submitted=UTC, recorded=5)
    with FakeRig() as fake:
        fake.sequences = {"progress": 7}
        status = fake._status()
    assert following.snapshot(status, info) is not None
    assert following.snapshot(status, info) is None  # no news

    def event(sequence: int, recorded: int) -> Event:
        body = progressed("r", recorded)
        return Event(topic="progress", sequence=sequence, epoch=status.epoch, utc=UTC, body=body)

    assert not following.outdated_by(event(7, 4))
    assert following.event(event(7, 4)) is None
    assert not following.outdated_by(event(8, 6))
    assert following.event(event(8, 6)) is not None
    assert following.outdated_by(event(10, 7))
    assert not following.outdated_by(event(9, 7))


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("end", "code"),
    [
        (ended(RunState.FAILED, "camera: lost; replug it", "device_lost"), Code.DEVICE_LOST),
        (ended(RunState.FAILED, "no such thing", "new_code"), Code.INTERNAL),
        (ended(RunState.ABORTED, "aborted by you"), Code.WRONG_STATE),
        (ended(RunState.INTERRUPTED, "power was cut"), Code.WRONG_STATE),
    ],
)
def test_a_run_that_ends_badly_raises_its_reason(
    fake: FakeRig, rig: Client, end: End, code: Code
) -> None:
    run = rig.scan(Checkerboard())
    fake.change(run.id, state=end.state, end=end)
    with pytest.raises(UmbraError, match=end.reason) as caught:
        run.wait()
    assert caught.value.code is code
    assert run.wait(check=False).end == end
    assert end.reason in repr(run)
    assert end.reason in run._repr_html_()
    if end.state is RunState.FAILED:
        with pytest.raises(UmbraError, match=end.reason):
            run.result()
    else:
        run.result()
    assert not run.result(check=False).final


@pytest.mark.usefixtures("impatient")
def test_wait_has_a_time_out_and_the_run_goes_on(fake: FakeRig, rig: Client) -> None:
    run = rig.scan(Checkerboard())
    with pytest.raises(TimeoutError, match=r"queued after 0\.05 s"):
        run.wait(0.05)
    fake.change(run.id, state=RunState.DONE)
    assert run.wait(60).state is RunState.DONE


def test_a_run_in_hand(fake: FakeRig, rig: Client, tmp_path: Path) -> None:
    run = rig.scan(Checkerboard())
    run.pause()
    run.resume()
    run.abort()
    assert run.refresh().state is RunState.ABORTED
    assert rig.run().id == run.id
    files = {"direct.tiff": b"d", "results/2/direct.tiff": b"d2", "report.html": b"<p>"}
    fake.files |= files
    products = tuple(Product(name=f, kind="image", file=f) for f in files)
    fake.change(run.id, products=products)
    run.save(tmp_path / "out")
    found = {str(p.relative_to(tmp_path / "out")): p for p in (tmp_path / "out").rglob("*.*")}
    assert {name: path.read_bytes() for name, path in found.items()} == files


@pytest.mark.parametrize("file", ["../../etc/x", "/etc/x", "", ".", "a/../../x"])
def test_a_product_stays_in_its_folder(
    fake: FakeRig, rig: Client, tmp_path: Path, file: str
) -> None:
    run = rig.scan(Checkerboard())
    fake.change(run.id, products=(Product(name="direct", kind="image", file=file),))
    with pytest.raises(UmbraError, match="names no file"):
        run.save(tmp_path)


# ---------------------------------------------------------------- asyncio


async def test_the_asyncio_client_follows_a_run(
    fake: FakeRig, tmp_path: Path, impatient: None
) -> None:
    async with AsyncClient(fake.endpoint, name="me") as rig:
        run = await rig.scan(Checkerboard())
        seen = []
        async for progress in run.progress():
            seen.append(progress.state)
            if progress.state is RunState.QUEUED:
                fake.change(run.id, state=RunState.RUNNING, tell=False)
            elif progress.state is RunState.RUNNING:
                done = ended(RunState.DONE)
                fake.change(run.id, state=done.state, end=done)
        assert seen == [RunState.QUEUED, RunState.RUNNING, RunState.DONE]
        assert (await run.wait(60)).state is RunState.DONE
        assert (await run.result()).final
        fake.files["direct.tiff"] = b"abc"
        fake.change(
            run.id, products=(Product(name="direct.tiff", kind="image", file="direct.tiff"),)
        )
        [path] = await run.save(tmp_path)
        assert path.read_bytes() == b"abc"
        failed = await rig.scan(Checkerboard())
        with pytest.raises(TimeoutError):
            await failed.wait(0.05)
        end = ended(RunState.FAILED, "camera: lost", "device_lost")
        fake.change(failed.id, state=end.state, end=end)
        with pytest.raises(UmbraError, match="camera: lost"):
            await failed.wait()
        with pytest.raises(UmbraError, match="camera: lost"):
            await failed.result()


async def test_the_asyncio_client_streams_events(fake: FakeRig) -> None:
    async with AsyncClient(fake.endpoint) as rig, rig.subscribe("queue", "preview") as events:
        fake.publish(QueueChanged(queue=("a",)))
        fake.publish(QueueChanged(queue=()), lose=True)
        fake.publish(QueueChanged(queue=("b",)))
        got = []
        async for notice in events:
            got.append((notice.body, notice.gap))
            if len(got) == 2:
                break
        assert got == [
            (QueueChanged(queue=("a",)), False),
            (QueueChanged(queue=("b",)), True),
        ]
        assert await events.next(0.01) is None


async def test_the_asyncio_client_says_where_no_events_come(fake: FakeRig) -> None:
    fake.deaf = True
    async with AsyncClient(fake.endpoint, timeout_s=0.3) as rig:
        with pytest.raises(UmbraError, match="no events came from"):
            async with rig.subscribe("queue"):
                pass


# ---------------------------------------------------------------- the lock


def test_a_lock_is_kept_alive_and_given_back(fake: FakeRig, rig: Client) -> None:
    with rig.hold("me", note="focusing", lease_s=0.1):
        assert fake.lock is not None
        token = fake.lock.token
        assert fake.renewed.wait(60)
        rig.snap()
    assert fake.lock is None
    assert rig.token == ""
    assert {r.token for r in fake.requests if isinstance(r.command, commands.Snap)} == {token}
    assert "umbra lock" not in {t.name for t in threading.enumerate()}


def test_a_lock_that_was_lost_is_an_error_at_the_end(fake: FakeRig, rig: Client) -> None:
    def hold() -> None:
        with rig.hold(lease_s=0.1):
            assert fake.renewed.wait(60)
            fake.order(lambda: setattr(fake, "lock", None))  # broken by another operator
            [beat] = [t for t in threading.enumerate() if t.name == "umbra lock"]
            beat.join(60)

    with pytest.raises(UmbraError, match="lost: you don't hold the rig") as caught:
        hold()
    assert caught.value.code is Code.LOCKED
    assert rig.token == ""


def test_the_bodys_own_error_comes_first(fake: FakeRig, rig: Client) -> None:
    with pytest.raises(ZeroDivisionError), rig.hold():
        1 / 0  # noqa: B018
    assert fake.lock is None


async def test_the_asyncio_lock(fake: FakeRig) -> None:
    import asyncio

    async with AsyncClient(fake.endpoint) as rig:
        async with rig.hold("me", lease_s=0.1):
            assert await asyncio.to_thread(fake.renewed.wait, 10)
        assert fake.lock is None
        assert rig.token == ""

        async def hold() -> None:
            async with rig.hold(lease_s=0.1):
                fake.order(lambda: setattr(fake, "lock", None))
                while rig.token and len(asyncio.all_tasks()) > others:
                    await asyncio.sleep(0)  # until the heartbeat has ended

        others = len(asyncio.all_tasks())
        with pytest.raises(UmbraError, match="lost: you don't hold the rig"):
            await hold()


def test_a_handle_needs_no_more_than_a_client(rig: Client) -> None:
    run = rig.scan(Checkerboard())
    assert isinstance(run, Run)
    assert repr(run) == f"<Run {run.id}: checkerboard, queued, 0/25 frames>"
