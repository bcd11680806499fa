"""Requests: both clients against a rig that loses, repeats, garbles and restarts."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from protocol.client import Client
from protocol.commands import Commands
from protocol.connection import ATTEMPTS, Ask, Exchange, chosen_endpoint, events_endpoint, is_local
from protocol.errors import Code, ErrorInfo, UmbraError
from protocol.messages import commands, replies
from protocol.messages.access import DEFAULT_COMMAND, Role
from protocol.messages.commands import GetResult
from protocol.messages.envelopes import ArrayHeader, Request, Response
from protocol.messages.findings import Search
from protocol.messages.runs import End, RunInfo, RunState
from protocol.patterns import WHITE
from protocol.results import separation_of
from protocol.scans.projected import Checkerboard
from tests.protocol.fake import STAGE, FakeRig

Connect = Callable[..., Client]


def sent(fake: FakeRig, kind: type[commands.Command]) -> list[Request]:
    return [r for r in fake.requests if isinstance(r.command, kind)]


def done(fake: FakeRig, kind: type[commands.Command]) -> list[Request]:
    return [r for r in fake.done if isinstance(r.command, kind)]


# ---------------------------------------------------------------- commands


def test_each_command_has_a_method_and_the_answer_it_names(fake: FakeRig, rig: Client) -> None:
    fake.files["direct"] = b"abc"
    run = rig.submit(Checkerboard(), first=True)
    assert run.by == "me"
    again = rig.reprocess(run.id, calibration="now", leakage=0.1, periods=(4.0, 8.0))
    assert again.info.parents == (run.id,)
    (asked,) = sent(fake, commands.Reprocess)
    assert asked.command == commands.Reprocess(
        run=run.id, calibration="now", changes={"leakage": 0.1, "periods": [4.0, 8.0]}, by="me"
    )
    fake.runs.pop(again.id)
    assert rig.status().epoch == fake.epoch == rig.welcome.epoch
    assert rig.devices() == ()
    assert rig.queue() == rig.runs() == rig.move_queued(run.id, 0) == (run,)
    assert rig.pause(run.id) == rig.resume(run.id) == rig.run_info(run.id) == run
    assert rig.abort(run.id).end == End(state=RunState.ABORTED, reason="aborted by me", by="me")
    assert rig.estop() == rig.reset() == rig.show(WHITE) == rig.light("left", on=True) == ""
    assert rig.dark() == rig.live() == rig.stop_live() == ""
    assert bytes(rig.product_part(run.id, "direct", 1).data) == b"bc"
    assert rig.log() == ({"event": "hello"},)
    assert rig.preview().pixels.shape == rig.snap().pixels.shape == (4, 4, 3)
    assert rig.draw(Checkerboard(), 0, 64, 48).facts["images"] == 27
    assert rig.camera(gain=2.0).gain == 2.0
    assert rig.stage() == rig.stage_home() == rig.stage_move(1, 2, 3) == STAGE
    assert rig.stage_circle((9, 9), 3, 2) == rig.stage_stop() == rig.stage_unlock() == STAGE
    assert rig.discover("pylon") == (Search(kind="camera", driver="pylon"),)
    assert rig.examine() == ()
    rig.token = rig.lock("me").token
    assert rig.renew_lock().lease_s == 10.0
    assert rig.unlock() == ""
    used = {type(request.command) for request in fake.requests}
    assert used == set(replies.ANSWERS) - {GetResult}


def test_every_command_is_in_the_table_of_answers() -> None:
    assert set(replies.ANSWERS) == set(commands.AnyCommand.__args__)
    assert set(replies.ANSWERS.values()) <= set(replies.AnyReply.__args__)


def test_a_request_that_is_too_large_is_not_sent(rig: Client) -> None:
    with pytest.raises(UmbraError, match=r"the request has 5\.0 MB, at most 4\.2 are taken"):
        rig.submit(Checkerboard(note="n" * 5_000_000))


def test_methods_show_their_signature_and_docstring(fake: FakeRig) -> None:
    assert inspect.signature(Client.submit) == inspect.signature(Commands.submit)
    with Client(fake.endpoint) as rig:
        assert str(inspect.signature(rig.runs)).endswith("-> 'tuple[RunInfo, ...]'")
        assert list(inspect.signature(rig.runs).parameters) == ["limit", "state"]
        assert rig.runs.__doc__ == "Runs, the newest first."


def test_the_daemons_error_is_raised_as_it_is(fake: FakeRig, rig: Client) -> None:
    fake.refuse["submit"] = ErrorInfo(
        code=Code.BAD_REQUEST, message="Expected `int` >= 1", where="$.command.spec.checker"
    )
    with pytest.raises(UmbraError, match=">= 1") as caught:
        rig.submit(Checkerboard())
    assert caught.value.info == fake.refuse["submit"]
    assert len(sent(fake, commands.Submit)) == 1  # an error is an answer: nothing is repeated


# ---------------------------------------------------------------- repeats


@pytest.mark.parametrize("lost", range(1, ATTEMPTS))
def test_a_lost_answer_is_asked_for_again_under_the_same_id(
    fake: FakeRig, hasty: Client, lost: int
) -> None:
    fake.drop = lost
    run = hasty.submit(Checkerboard())
    requests = sent(fake, commands.Submit)
    assert len(requests) == lost + 1
    assert len({r.id for r in requests}) == 1
    assert list(fake.runs) == [run.id]  # carried out once


def test_after_the_last_attempt_the_error_says_what_to_do(fake: FakeRig, hasty: Client) -> None:
    fake.drop = ATTEMPTS
    with pytest.raises(UmbraError, match="is umbrad running") as caught:
        hasty.status()
    assert caught.value.code is Code.UNREACHABLE
    assert len(sent(fake, commands.GetStatus)) == ATTEMPTS
    assert "\n" not in caught.value.message
    assert fake.endpoint in caught.value.message
    assert "UMBRA_RIG" in caught.value.message
    assert "keys" not in caught.value.message  # a rig on loopback, and no keys
    hasty.status()  # and the client is as good as before


def test_a_late_answer_counts(fake: FakeRig, hasty: Client) -> None:
    fake.hold_back = 1  # the first answer comes only when the second is sent
    assert hasty.status().rig == "fake"
    assert hasty.devices() == ()


def test_answers_that_come_twice_are_taken_once(fake: FakeRig, rig: Client) -> None:
    fake.copies = 3
    for _ in range(3):
        assert rig.status().rig == "fake"
        assert rig.devices() == ()


def test_stray_and_garbled_messages_are_passed_over(fake: FakeRig, rig: Client) -> None:
    stray = msgspec.json.encode(Response(id="someone-else", reply=replies.Done()))
    fake.before = [[b""], [b"\xff\x00"], [b"{}", b"x"], [b'{"id": 3}'], [b"[1"], [stray, b"y"]]
    assert rig.status().rig == "fake"
    assert rig.devices() == ()
    assert len(sent(fake, commands.GetStatus)) == 1


def test_an_answer_that_cannot_be_read_is_an_error_at_once(fake: FakeRig, rig: Client) -> None:
    fake.mangle = lambda frames: [frames[0].replace(b'"rig":', b'"rug":'), *frames[1:]]
    with pytest.raises(UmbraError, match="rug") as caught:
        rig.status()
    assert caught.value.code is Code.INTERNAL
    assert len(sent(fake, commands.GetStatus)) == 1


@pytest.mark.parametrize(
    "mangle",
    [
        lambda frames: frames[:-1],
        lambda frames: [*frames[:-1], frames[-1][:-1]],
        lambda frames: [frames[0].replace(b"float32", b"object"), *frames[1:]],
        lambda frames: [frames[0].replace(b'"direct"', b'"other"'), *frames[1:]],
        lambda frames: [frames[0].replace(b'"shape":[3,', b'"shape":[-3,'), *frames[1:]],
    ],
    ids=["missing", "short", "dtype", "name", "shape"],
)
def test_arrays_that_are_not_as_announced(
    fake: FakeRig, rig: Client, mangle: Callable[[list[bytes]], list[bytes]]
) -> None:
    run = rig.submit(Checkerboard())
    fake.mangle = mangle
    with pytest.raises(UmbraError) as caught:
        rig.result(run.id)
    assert caught.value.code is Code.INTERNAL


def test_another_kind_of_reply_is_an_error(fake: FakeRig, rig: Client) -> None:
    request_done = msgspec.json.encode(replies.Done())

    def another(frames: list[bytes]) -> list[bytes]:
        answer = msgspec.json.decode(frames[0])
        return [msgspec.json.encode({"id": answer["id"], "reply": msgspec.Raw(request_done)})]

    fake.mangle = another
    with pytest.raises(UmbraError, match="Done, not Status"):
        rig.status()


# ---------------------------------------------------------------- versions


def test_a_daemon_of_another_version_is_named(connect: Connect) -> None:
    with FakeRig(protocol=2) as fake, pytest.raises(UmbraError) as caught:
        connect(fake.endpoint)
    assert caught.value.code is Code.VERSION_MISMATCH
    assert "1" in caught.value.message
    assert "2" in caught.value.message


def test_a_welcome_of_another_version_is_told_from_garbage(fake: FakeRig, connect: Connect) -> None:
    fake.mangle = lambda frames: [
        frames[0].replace(b'"protocol":1', b'"protocol":7,"new_field":true')
    ]
    with pytest.raises(UmbraError, match=r"protocol 1, .*0\.0-fake.* protocol 7") as caught:
        connect(fake.endpoint)
    assert caught.value.code is Code.VERSION_MISMATCH


# ---------------------------------------------------------------- there and not there


def test_nobody_there(connect: Connect) -> None:
    with pytest.raises(UmbraError) as caught:
        connect("tcp://127.0.0.1:1", timeout_s=0.2)
    assert caught.value.code is Code.UNREACHABLE


def test_a_restart_between_two_requests_goes_unnoticed(connect: Connect) -> None:
    with FakeRig() as first:
        rig = connect(first.endpoint, timeout_s=5.0)
        rig.status()
    with rig, FakeRig(command=first.endpoint) as second:
        assert rig.status().epoch == second.epoch != first.epoch


def test_a_restart_during_a_request_repeats_it(connect: Connect) -> None:
    heard = threading.Event()
    with contextlib.ExitStack() as second, contextlib.ExitStack() as first:
        fake = first.enter_context(FakeRig())

        def restart() -> None:
            assert heard.wait(60)
            first.close()
            second.enter_context(FakeRig(command=fake.endpoint))

        with connect(fake.endpoint, timeout_s=3.0) as rig:
            fake.drop = 1
            fake.on_request = lambda _: heard.set()
            restarting = threading.Thread(target=restart)
            restarting.start()
            assert rig.status().epoch != fake.epoch
            restarting.join()


def test_a_closed_client_says_so(fake: FakeRig, connect: Connect) -> None:
    with connect(fake.endpoint) as rig:
        rig.close()
        with pytest.raises(UmbraError, match="closed"):
            rig.status()
        assert "closed" in repr(rig)


def test_threads_may_share_a_client(fake: FakeRig) -> None:
    with Client(fake.endpoint) as rig:
        run = rig.submit(Checkerboard())
        wrong: list[object] = []

        def ask() -> None:
            for _ in range(20):
                if rig.status().rig != "fake" or rig.run_info(run.id).id != run.id:
                    wrong.append(1)

        threads = [threading.Thread(target=ask) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not wrong


async def test_requests_of_one_loop_overlap(fake: FakeRig) -> None:
    from protocol.aio import AsyncClient

    async with AsyncClient(fake.endpoint) as rig:
        run = await rig.submit(Checkerboard())
        answers = await asyncio.gather(
            *(rig.status() if i % 2 else rig.run_info(run.id) for i in range(40))
        )
    assert [type(a) for a in answers] == [RunInfo, replies.Status] * 20


async def test_a_cancelled_request_leaves_nothing_behind(fake: FakeRig) -> None:
    from protocol.aio import AsyncClient

    async with AsyncClient(fake.endpoint) as rig:
        fake.drop = 1
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.05):
                await rig.status()
        assert (await rig.status()).rig == "fake"
        assert not rig._waiting


async def test_closing_ends_the_requests_under_way(fake: FakeRig) -> None:
    from protocol.aio import AsyncClient

    rig = await AsyncClient(fake.endpoint, timeout_s=30.0).open()
    fake.drop = 1
    heard = asyncio.Event()
    loop = asyncio.get_running_loop()
    fake.on_request = lambda _: loop.call_soon_threadsafe(heard.set)
    asking = asyncio.create_task(rig.status())
    await heard.wait()
    await rig.close()
    with pytest.raises(UmbraError, match="closed"):
        await asking


async def test_the_blocking_client_works_where_a_loop_runs(fake: FakeRig) -> None:
    with Client(fake.endpoint) as rig:  # as in a notebook
        assert rig.status().rig == "fake"


def test_ctrl_c_ends_a_wait_and_the_client_goes_on(fake: FakeRig) -> None:
    with Client(fake.endpoint, timeout_s=30.0) as rig:
        fake.drop = 1
        fake.on_request = lambda _: os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            rig.status()
        fake.on_request = None
        assert rig.status().rig == "fake"
        assert len(rig._sockets) == 1


def test_nothing_is_left_running(fake: FakeRig, connect: Connect) -> None:
    before = set(threading.enumerate())
    with connect(fake.endpoint) as rig:
        events = rig.subscribe("run")
        rig.status()
    del events  # closed with its client: no ResourceWarning
    assert set(threading.enumerate()) <= before
    assert rig._context.closed


# ---------------------------------------------------------------- arrays


def test_result_is_a_view_of_what_was_received() -> None:
    direct = np.arange(600_000, dtype=np.float32).reshape(400, 500, 3)
    exchange = Exchange(Ask(GetResult(), separation_of))
    info = RunInfo(id="r", state=RunState.DONE, spec=Checkerboard(), submitted="")
    arrays = tuple(
        ArrayHeader(name=n, dtype="float32", shape=direct.shape) for n in ("direct", "global")
    )
    response = Response(id=exchange.id, reply=replies.Result(run=info, final=True), arrays=arrays)
    frames = [zmq.Frame(b) for b in (msgspec.json.encode(response), direct.tobytes(), direct.data)]
    result = exchange.value(frames)
    for array, frame in zip((result.direct, result.global_), frames[1:], strict=True):
        assert np.array_equal(array, direct)
        assert np.shares_memory(array, np.frombuffer(frame.buffer, np.uint8))
        assert not array.flags.writeable or array.base is not None


def test_large_arrays_come_whole(fake: FakeRig, rig: Client) -> None:
    noise = np.random.default_rng(1).random((1000, 1200, 3), np.float32)
    fake.arrays = {"direct": noise, "global": noise[::-1], "quality": np.ones((9, 7), np.uint16)}
    result = rig.result(rig.submit(Checkerboard()).id)
    assert np.array_equal(result.direct, noise)
    assert np.array_equal(getattr(result, "global"), noise[::-1])
    assert result.quality is not None
    assert result.quality.sum() == 63
    assert result.facts == {"images": 25}
    assert not result.final
    assert "so far" in repr(result)
    with pytest.raises(AttributeError):
        result.globe  # noqa: B018


# ---------------------------------------------------------------- products


def test_download_puts_parts_together(fake: FakeRig, rig: Client, tmp_path: Path) -> None:
    whole = np.random.default_rng(2).bytes((8 << 20) + 12_345)
    fake.files["direct.tiff"] = whole
    fake.files["empty.json"] = b""
    run = rig.submit(Checkerboard())
    assert rig.download(run.id, "direct.tiff", tmp_path) == tmp_path / "direct.tiff"
    rig.download(run.id, "direct.tiff", tmp_path / "new" / "other.tiff")
    rig.download(run.id, "empty.json", tmp_path)
    assert (tmp_path / "direct.tiff").read_bytes() == whole
    assert (tmp_path / "new" / "other.tiff").read_bytes() == whole
    assert (tmp_path / "empty.json").read_bytes() == b""
    assert len(sent(fake, commands.GetProduct)) == 5


def test_a_download_that_fails_leaves_what_was_there(
    fake: FakeRig, rig: Client, tmp_path: Path
) -> None:
    fake.files["direct.tiff"] = bytes(9 << 20)
    (tmp_path / "direct.tiff").write_bytes(b"old")
    run = rig.submit(Checkerboard())

    def vanish(request: Request) -> None:
        command = request.command
        if isinstance(command, commands.GetProduct) and command.offset == 0:
            fake.files["direct.tiff"] = bytes(8 << 20)  # shorter than it said

    fake.on_request = vanish
    with pytest.raises(UmbraError, match="came") as caught:
        rig.download(run.id, "direct.tiff", tmp_path)
    assert caught.value.code is Code.STORAGE_FAILED
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]


def test_a_place_that_cannot_be_written(fake: FakeRig, rig: Client, tmp_path: Path) -> None:
    fake.files["direct.tiff"] = b"abc"
    (tmp_path / "file").touch()
    run = rig.submit(Checkerboard())
    with pytest.raises(UmbraError, match="can't be written") as caught:
        rig.download(run.id, "direct.tiff", tmp_path / "file" / "direct.tiff")
    assert caught.value.code is Code.STORAGE_FAILED


# ---------------------------------------------------------------- where


@pytest.mark.parametrize(
    "wrong", ["bench-1", "tcp://bench-1", "tcp://", "http://a:1", "tcp://a:b", "ipc://"]
)
def test_what_is_no_endpoint(wrong: str) -> None:
    with pytest.raises(UmbraError, match="tcp://HOST:PORT"):
        chosen_endpoint(wrong)


def test_the_endpoint_is_the_given_one_then_the_environments_then_the_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("UMBRA_RIG", raising=False)
    assert chosen_endpoint(None) == DEFAULT_COMMAND
    monkeypatch.setenv("UMBRA_RIG", "tcp://bench:5750")
    assert chosen_endpoint(None) == "tcp://bench:5750"
    assert chosen_endpoint("ipc:///run/umbra") == "ipc:///run/umbra"


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp://127.0.0.1:5750", True),
        ("tcp://127.8.0.1:5750", True),
        ("tcp://localhost:5750", True),
        ("tcp://[::1]:5750", True),
        ("ipc:///run/umbra", True),
        ("tcp://10.0.0.1:5750", False),
        ("tcp://127.0.0.1.example.org:5750", False),
        ("tcp://[2001:db8::1]:5750", False),
    ],
)
def test_what_is_on_this_machine(endpoint: str, local: bool) -> None:
    assert is_local(endpoint) is local


@pytest.mark.parametrize(
    ("told", "reached", "events"),
    [
        ("tcp://*:5751", "tcp://bench:5750", "tcp://bench:5751"),
        ("tcp://0.0.0.0:5751", "tcp://10.0.0.1:5750", "tcp://10.0.0.1:5751"),
        ("tcp://[::]:5751", "tcp://[::1]:5750", "tcp://[::1]:5751"),
        ("tcp://10.0.0.2:5751", "tcp://bench:5750", "tcp://10.0.0.2:5751"),
        ("ipc:///run/umbra-events", "ipc:///run/umbra", "ipc:///run/umbra-events"),
    ],
)
def test_where_events_are(told: str, reached: str, events: str) -> None:
    welcome = replies.Welcome(
        protocol=1,
        server="",
        rig="",
        epoch="",
        role=Role.OBSERVER,
        events=told,
        methods=(),
        devices=(),
    )
    assert events_endpoint(welcome, reached) == events


def test_ipc(connect: Connect, tmp_path: Path) -> None:
    with FakeRig(command=f"ipc://{tmp_path}/c") as fake, connect(fake.endpoint) as rig:
        assert rig.status().rig == "fake"


# ---------------------------------------------------------------- light


def test_the_client_starts_light() -> None:
    heavy = "{'numpy', 'cv2', 'zarr', 'asyncio', 'daemon', 'drivers', 'rich', 'typer'}"
    code = f"import sys, protocol.client; print(sorted({heavy} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
