"""`umbra` against a fake rig: what is printed, what is asked, what it exits with."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from protocol.cli.app import SECTIONS, run
from protocol.cli.exits import Exit, exit_of
from protocol.cli.rig import _followed
from protocol.cli.watch import show_progress
from protocol.connection import Notice
from protocol.errors import Code, ErrorInfo, UmbraError
from protocol.messages import commands, replies
from protocol.messages.envelopes import Event, Request
from protocol.messages.events import Logged
from protocol.messages.findings import Check, Outcome
from protocol.messages.rig import CameraSettings, DeviceInfo, Health
from protocol.messages.runs import End, Product, Progress, RunInfo, RunState
from protocol.scans.projected import Checkerboard, TwoImage
from protocol.scans.spec import Radiometry, Reference
from tests.protocol.fake import FakeRig

Captured = pytest.CaptureFixture[str]


class Rig(FakeRig):
    """A fake rig with a camera, and products to fetch."""

    def _status(self) -> replies.Status:
        camera = DeviceInfo(
            name="camera", kind="camera", driver="virtual", health=Health.READY, model="V1"
        )
        return msgspec.structs.replace(super()._status(), devices=(camera,))

    broken = ""  # a product that cannot be read

    def _reply(self, request: Request) -> tuple[replies.AnyReply, dict[str, Any]]:
        if self.broken and getattr(request.command, "name", "") == self.broken:
            raise UmbraError(Code.STORAGE_FAILED, "disk gone")
        return super()._reply(request)

    def make(self, *names: str) -> None:
        """A run that is done, with these products."""
        self.files = {name: name.encode() * 1000 for name in names}
        products = tuple(Product(name=n, kind="image", file=f"{n}.tiff") for n in names)
        self._submitted(Checkerboard(), "me")
        self.runs["run-1"] = msgspec.structs.replace(
            self.runs["run-1"], state=RunState.DONE, products=products
        )


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    fake = Rig()
    with fake:
        monkeypatch.setenv("UMBRA_RIG", fake.endpoint)
        monkeypatch.delenv("UMBRA_KEYS", raising=False)
        yield fake


def asked(rig: Rig, kind: type[Any]) -> Any:
    """The last command of this kind that came."""
    return next(r.command for r in reversed(rig.done) if isinstance(r.command, kind))


# ---------------------------------------------------------------- the face


def test_help_has_every_command_and_the_exit_codes(capsys: Captured) -> None:
    assert run(["--help"]) == Exit.OK
    text = capsys.readouterr().out
    for table in SECTIONS.values():
        assert all(f"\n  {name} " in text for name in table)
    for code in (0, 1, 2, 3, 4, 5, 130):
        assert f"{code} " in text.partition("Exit codes:")[2]


@pytest.mark.parametrize("name", [name for table in SECTIONS.values() for name in table])
def test_every_command_has_help(name: str, capsys: Captured) -> None:
    assert run([name, "--help"]) == Exit.OK
    assert capsys.readouterr().out.startswith(f"Usage: umbra {name}")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["statsu"], "Did you mean 'status'? See umbra --help"),
        (["status", "--foo"], "No such option: --foo"),
        (["scan", "chequerboard"], "Did you mean 'checkerboard'?"),
        (["scan", "checkerboard", "--shifts", "1"], "--shifts: expected int >= 2"),
        (["scan", "checkerboard", "--shifts", "two"], "Invalid value for '--shifts'"),
        (["scan", "checkerboard", "--leak", "1"], "--leakage: expected float < 1.0"),
        (["scan", "checkerboard", "--tone", "log"], "--tone: expected tone curve: linear, srgb"),
        (["scan", "checkerboard", "--references", "white,grey"], "'grey' is not one of ambient"),
        (["scan", "checkerboard", "--estimator", "best"], "'best' is not one of auto, lsq, maxmin"),
        (["camera", "--roi", "1,2"], "--roi: expected array of length 4"),
        (["camera", "--roi", "1,b,3,4"], "--roi: '1,b,3,4' is not a list of numbers"),
        (["snap", "-o", "frame.jpg"], "pictures are PNG files"),
        (["snap", "-o", "no/such/folder.png"], "no/such is not a folder"),
        (["preview"], "give -o FILE.png"),
        (["--rig", "bench-1", "status"], "tcp://HOST:PORT"),
    ],
)
def test_bad_options_are_one_line(
    arguments: list[str], said: str, rig: Rig, capsys: Captured
) -> None:
    assert run(arguments) == Exit.USAGE
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("umbra: ")
    assert said in err
    assert err.count("\n") == 1
    assert not rig.requests


def test_no_daemon_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: Captured) -> None:
    from protocol import client

    quick = client.Client
    monkeypatch.setattr(client, "Client", lambda *a, **k: quick(*a, **k, timeout_s=0.2))
    assert run(["--rig", "ipc:///nowhere/umbra", "status"]) == Exit.UNREACHABLE
    err = capsys.readouterr().err
    assert "is umbrad running?" in err
    assert err.count("\n") == 1


def test_another_version_names_both(capsys: Captured) -> None:
    with FakeRig(protocol=99) as old:
        assert run(["--rig", old.endpoint, "status"]) == Exit.UNREACHABLE
    assert "99" in capsys.readouterr().err


def test_a_rig_may_be_named_before_and_after_the_command(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.setenv("UMBRA_RIG", "ipc:///nowhere/umbra")
    assert run(["--rig", rig.endpoint, "status"]) == Exit.OK
    assert run(["status", "--rig", rig.endpoint]) == Exit.OK
    assert run(["--rig", "ipc:///nowhere", "queue", "--rig", rig.endpoint]) == Exit.OK


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (Code.UNSUITABLE, Exit.USAGE),
        (Code.BUSY, Exit.REFUSED),
        (Code.ESTOPPED, Exit.REFUSED),
        (Code.DEVICE_LOST, Exit.FAILED),
        (Code.STORAGE_FULL, Exit.FAILED),
    ],
)
def test_refusals_exit_as_documented(
    code: Code, expected: Exit, rig: Rig, capsys: Captured
) -> None:
    rig.refuse["submit"] = ErrorInfo(code=code, message="no, because")
    assert run(["scan", "checkerboard"]) == expected == exit_of(code)
    assert capsys.readouterr().err == "umbra: no, because\n"


def test_every_code_has_its_exit() -> None:
    assert {exit_of(code) for code in Code} == {
        Exit.FAILED, Exit.USAGE, Exit.UNREACHABLE, Exit.REFUSED,
    }  # fmt: skip


# ---------------------------------------------------------------- facts


@pytest.mark.parametrize(
    ("arguments", "kind"),
    [
        (["status"], replies.Status),
        (["devices"], replies.Devices),
        (["methods"], replies.Welcome),
        (["runs"], replies.Runs),
        (["run"], replies.Run),
        (["queue"], replies.Runs),
        (["queue", "move", "run-1", "0"], replies.Runs),
        (["pause"], replies.Run),
        (["resume"], replies.Run),
        (["abort"], replies.Run),
        (["log"], replies.Log),
        (["preview"], replies.Picture),
        (["camera"], replies.Camera),
        (["light", "left", "on"], replies.Done),
        (["show", "white"], replies.Done),
        (["show", "off"], replies.Done),
        (["stop"], replies.Done),
        (["reset"], replies.Done),
        (["scan", "two-image"], replies.Run),
    ],
)
def test_json_is_the_protocols_own_struct(
    arguments: list[str], kind: type[Any], rig: Rig, capsys: Captured
) -> None:
    rig.make("direct")
    assert run([*arguments, "--json"]) == Exit.OK
    out = capsys.readouterr().out
    assert isinstance(msgspec.json.decode(out, type=kind), kind)
    assert run(arguments if arguments != ["preview"] else ["status"]) == Exit.OK
    with pytest.raises(json.JSONDecodeError):
        json.loads(capsys.readouterr().out + "for people")


def test_status_in_plain_lines(rig: Rig, capsys: Captured) -> None:
    assert run(["status"]) == Exit.OK
    out = capsys.readouterr().out
    assert "camera  ready · V1\n" in out
    assert "\x1b" not in out


def test_tables_are_plain_in_a_pipe_and_coloured_on_a_terminal(
    rig: Rig, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.make("direct")
    run(["runs"])
    heading, row = capsys.readouterr().out.splitlines()
    assert heading.index("state") == row.index("done")
    monkeypatch.setattr("protocol.cli.output.on_terminal", lambda *_: True)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    run(["runs"])
    assert "\x1b[32mdone" in capsys.readouterr().out
    monkeypatch.setenv("NO_COLOR", "1")
    run(["runs"])
    assert "\x1b[32m" not in capsys.readouterr().out


# ---------------------------------------------------------------- scans


def test_scan_options_become_the_spec(rig: Rig, capsys: Captured) -> None:
    given = ["--checker", "6", "--shifts=4", "--tone", "gamma:2.2", "--leak", "0.02", "--first"]
    assert run(["scan", "checkerboard", *given, "--references", "black,white"]) == Exit.OK
    submitted = asked(rig, commands.Submit)
    assert submitted.first
    assert submitted.spec == Checkerboard(
        checker=6,
        shifts=4,
        radiometry=Radiometry(tone="gamma:2.2", leakage=0.02),
        references=(Reference.BLACK, Reference.WHITE),
    )
    assert capsys.readouterr().out == "run-1\n"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("scan.toml", 'method = "checkerboard"\nshifts = 4\n[radiometry]\ntone = "srgb"\n'),
        ("scan.json", '{"method": "checkerboard", "shifts": 4, "radiometry": {"tone": "srgb"}}'),
    ],
)
def test_a_scan_from_a_file(name: str, text: str, rig: Rig, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert run(["scan", "--file", str(tmp_path / name), "--first"]) == Exit.OK
    submitted = asked(rig, commands.Submit)
    assert submitted.first
    assert submitted.spec == Checkerboard(shifts=4, radiometry=Radiometry(tone="srgb"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("method = 'checkerboard'\nshifts = 1", "Expected int >= 2 - at $.shifts"),
        ("method = 'chequers'", "Invalid value 'chequers' - at $.method"),
        ("method = 'stick'\nchecker = 8", "there is an unknown field checker"),
        ("method: stick", "line 1"),
    ],
)
def test_a_scan_file_with_an_error_is_one_line(
    text: str, said: str, rig: Rig, tmp_path: Path, capsys: Captured
) -> None:
    file = tmp_path / "scan.toml"
    file.write_text(text)
    assert run(["scan", "--file", str(file)]) == Exit.USAGE
    err = capsys.readouterr().err
    assert err.startswith(f"umbra: {file}: ")
    assert said in err
    assert err.count("\n") == 1


def test_scan_options_before_the_method_are_not_lost(rig: Rig, capsys: Captured) -> None:
    assert run(["scan", "--wait", "two-image"]) == Exit.USAGE
    assert "--wait belongs after the method" in capsys.readouterr().err
    assert run(["scan", "--file", "x.toml", "two-image"]) == Exit.USAGE
    assert not rig.requests


def test_scan_without_options_is_the_default(rig: Rig) -> None:
    assert run(["scan", "two-image"]) == Exit.OK
    assert asked(rig, commands.Submit).spec == TwoImage()


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (RunState.DONE, Exit.OK),
        (RunState.FAILED, Exit.FAILED),
        (RunState.INTERRUPTED, Exit.FAILED),
        (RunState.ABORTED, Exit.ABORTED),
    ],
)
def test_waiting_exits_as_the_run_ended(
    state: RunState, expected: Exit, rig: Rig, capsys: Captured
) -> None:
    def go_on() -> None:
        assert rig.subscribed.acquire(timeout=10)
        end = End(state=state, reason="as the test said", by="me")
        rig.change("run-1", state=state, end=end, recorded=25)

    thread = threading.Thread(target=go_on)
    thread.start()
    assert run(["scan", "checkerboard", "--wait"]) == expected
    thread.join()
    out, err = capsys.readouterr()
    assert out == "run-1\n"
    told = err.splitlines()[-1]
    if state is RunState.DONE:
        assert told == "run run-1 done: 25/25 frames"
    else:
        assert told == f"umbra: run run-1 {state.value}: as the test said by me"


def news() -> Iterator[Progress]:
    for n in range(26):
        yield Progress(
            run="run-1", state=RunState.RUNNING, recorded=n, planned=25, missing=0, rejected=0,
            fraction=n / 25, rate_hz=10.0, remaining_s=(25 - n) / 10, phase="exposing",
        )  # fmt: skip


def test_progress_in_a_log_is_a_line_a_tenth(capsys: Captured) -> None:
    show_progress(news(), "scan")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 11
    assert lines[2] == "running: 5/25 · 10.0 Hz · 2.0 s left · exposing"


def test_progress_on_a_terminal_is_a_bar(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.cli.watch.on_terminal", lambda *_: True)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    show_progress(news(), "run-1 checkerboard")
    err = capsys.readouterr().err
    assert "━━━━" in err
    assert "25/25 · 10.0 Hz" in err


def test_ctrl_c_while_waiting_says_that_the_run_goes_on(
    rig: Rig, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("protocol.cli.scan.follow", interrupted)
    assert run(["scan", "checkerboard", "--wait"]) == Exit.INTERRUPTED
    assert "run run-1 goes on; umbra watch run-1" in capsys.readouterr().err
    assert not any(isinstance(r.command, commands.Abort) for r in rig.requests)


def test_watch_as_json_is_a_line_an_event(rig: Rig, capsys: Captured) -> None:
    rig.make("direct")
    assert run(["watch", "--json"]) == Exit.OK
    first, *_, last = capsys.readouterr().out.splitlines()
    assert msgspec.json.decode(first, type=Progress).state is RunState.DONE
    assert msgspec.json.decode(last, type=RunInfo).id == "run-1"


def test_watch_says_what_the_run_found(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    rig.make("direct")
    monkeypatch.setattr("protocol.run.Run.facts", lambda _: {"advice": ["cover the mirror"]})
    assert run(["watch"]) == Exit.OK
    assert "advice: cover the mirror" in capsys.readouterr().err


def test_snap_without_a_file_tells_of_the_frame(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["snap"]) == Exit.OK
    out, err = capsys.readouterr()
    assert out == ""
    assert "saturated" in err
    assert not list(tmp_path.iterdir())


def test_steering_without_a_run_names_the_one_it_means(rig: Rig) -> None:
    rig.make("direct")
    assert run(["abort"]) == Exit.OK
    assert asked(rig, commands.Abort).run == "run-1"


def test_a_run_that_fails_again_at_once_is_no_success(rig: Rig, capsys: Captured) -> None:
    rig.make("direct")
    end = End(state=RunState.FAILED, reason="the disk is too small", code=Code.STORAGE_FULL)
    rig.change("run-1", state=RunState.FAILED, end=end, tell=False)
    assert run(["resume"]) == Exit.FAILED
    assert "run run-1 failed: the disk is too small" in capsys.readouterr().err


# ---------------------------------------------------------------- products


def test_get_fetches_all_products(rig: Rig, tmp_path: Path, capsys: Captured) -> None:
    rig.make("direct", "global")
    out = tmp_path / "out"
    assert run(["get", "-o", str(out)]) == Exit.OK
    assert {p.name: p.read_bytes() for p in out.iterdir()} == {
        f"{name}.tiff": data for name, data in rig.files.items()
    }
    assert capsys.readouterr().out.splitlines() == [str(out / f"{n}.tiff") for n in rig.files]


def test_get_refuses_to_overwrite(rig: Rig, tmp_path: Path, capsys: Captured) -> None:
    rig.make("direct", "global")
    (tmp_path / "global.tiff").write_bytes(b"mine")
    assert run(["get", "-o", str(tmp_path)]) == Exit.USAGE
    assert "already has global.tiff" in capsys.readouterr().err
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"mine"]
    assert run(["get", "-o", str(tmp_path), "--only", "direct"]) == Exit.OK
    assert run(["get", "-o", str(tmp_path), "--force"]) == Exit.OK
    assert (tmp_path / "global.tiff").read_bytes() == rig.files["global"]


def test_get_is_all_or_nothing(rig: Rig, tmp_path: Path, capsys: Captured) -> None:
    rig.make("direct", "global")
    rig.broken = "global"
    assert run(["get", "-o", str(tmp_path)]) == Exit.FAILED
    assert not list(tmp_path.iterdir())


def test_get_what_is_not_there(rig: Rig, tmp_path: Path, capsys: Captured) -> None:
    rig.make("direct")
    assert run(["get", "-o", str(tmp_path), "--only", "depth"]) == Exit.REFUSED
    assert "no product 'depth'; it has: direct" in capsys.readouterr().err
    rig.make()
    assert run(["get", "-o", str(tmp_path)]) == Exit.REFUSED


def test_scan_with_out_checks_the_folder_before_it_asks(
    rig: Rig, tmp_path: Path, capsys: Captured
) -> None:
    tmp_path.chmod(0o555)
    try:
        assert run(["scan", "checkerboard", "-o", str(tmp_path)]) == Exit.USAGE
    finally:
        tmp_path.chmod(0o755)
    assert "read-only" in capsys.readouterr().err
    assert not rig.requests


def test_preview_to_a_file(rig: Rig, tmp_path: Path) -> None:
    import cv2

    out = tmp_path / "preview.png"
    assert run(["preview", "-o", str(out)]) == Exit.OK
    read = cv2.imread(str(out))
    assert read is not None
    assert np.array_equal(read, np.zeros((4, 4, 3), np.uint8))


def test_show_a_pattern(rig: Rig) -> None:
    assert run(["show", "checker", "--size", "4", "--inverted", "--for", "5"]) == Exit.OK
    shown = asked(rig, commands.Show)
    assert (shown.pattern.size, shown.pattern.inverted, shown.lease_s) == (4, True, 5.0)


def test_camera_settings(rig: Rig, capsys: Captured) -> None:
    assert run(["camera", "--exposure-us", "500", "--roi", "0,0,64,48"]) == Exit.OK
    assert asked(rig, commands.SetCamera).settings == CameraSettings(
        exposure_us=500.0, roi=(0, 0, 64, 48)
    )
    assert "exposure  500 µs" in capsys.readouterr().out


def test_keys_from_new_to_revoked(tmp_path: Path, capsys: Captured) -> None:
    mine, theirs = tmp_path / "mine", tmp_path / "rig"
    assert run(["keys", "new", "anna", "--into", str(mine)]) == Exit.OK
    public = capsys.readouterr().out.strip()
    place = ["--keys-dir", str(theirs)]
    assert run(["keys", "authorize", public, "--role", "operator", *place]) == Exit.OK
    capsys.readouterr()
    assert run(["keys", "list", "--json", *place]) == Exit.OK
    (entry,) = json.loads(capsys.readouterr().out)
    assert (entry["name"], entry["role"]) == ("anna", "operator")
    assert run(["keys", "revoke", "anna", *place]) == Exit.OK
    assert run(["keys", "revoke", "anna", *place]) == Exit.USAGE
    assert "no key named anna" in capsys.readouterr().err


def test_auto_exposure_is_asked_for_after_the_other_settings(rig: Rig, capsys: Captured) -> None:
    assert run(["camera", "--auto-exposure", "--exposure-us", "500", "--gain", "6"]) == Exit.OK
    sent = [r.command for r in rig.requests if isinstance(r.command, commands.SetCamera)]
    assert sent == [
        commands.SetCamera(settings=CameraSettings(gain=6.0)),
        commands.SetCamera(settings=CameraSettings(exposure_us=500.0), auto_exposure=True),
        commands.SetCamera(),
    ]
    told = capsys.readouterr()
    assert "55.0% of full scale" in told.out
    assert told.err.strip() == "umbra: too dark"


# ---------------------------------------------------------------- stage, doctor, devices, log


def test_stage_moves_are_asked_for_as_they_are_typed(rig: Rig, capsys: Captured) -> None:
    assert run(["stage", "circle", "10", "12.5", "3", "--turns", "2", "--feed", "4"]) == Exit.OK
    circle = asked(rig, commands.StageCircle)
    assert (circle.centre_mm, circle.radius_mm, circle.feed_mm_s) == ((10.0, 12.5), 3.0, 4.0)
    assert run(["stage", "move", "10", "12"]) == Exit.OK
    assert asked(rig, commands.StageMove).feed_mm_s == 10.0  # half of the fastest
    assert "1.000, 2.000 mm" in capsys.readouterr().out
    assert run(["stage", "move", "-10.5", "-12", "--feed", "4"]) == Exit.OK  # no option
    there = asked(rig, commands.StageMove)
    assert (there.x_mm, there.y_mm) == (-10.5, -12.0)
    assert run(["stage", "home", "--timeout", "7"]) == Exit.OK
    assert asked(rig, commands.StageHome).timeout_s == 7.0
    assert run(["stage", "circle", "1", "2", "3", "--wait"]) == Exit.USAGE  # it has no end


def test_the_doctor_exits_as_he_found(rig: Rig, capsys: Captured) -> None:
    fine = Check(name="keys", outcome=Outcome.OK, message="good", remedy="")
    poor = Check(name="disk", outcome=Outcome.WARNING, message="slow", remedy="buy another")
    rig.checks = (fine, poor)
    assert run(["doctor", "--passive"]) == Exit.OK
    assert asked(rig, commands.Examine).passive
    out = capsys.readouterr().out
    assert "warning  disk  slow\n               -> buy another\n" in out
    assert out.endswith("1 ok, 1 warning\n")
    rig.checks = (fine, msgspec.structs.replace(poor, outcome=Outcome.FAILED))
    assert run(["doctor"]) == Exit.FAILED


def test_a_log_that_goes_on() -> None:
    def record(event: str, run: str = "") -> dict[str, str]:
        return {"event": event, "run": run}

    def notice(event: str, run: str = "", *, gap: bool = False) -> Notice:
        body = Logged(record=record(event, run))
        told = Event(topic="log", sequence=1, epoch="e", utc="", body=body)
        return Notice(event=told, arrays={}, gap=gap)

    came = iter([notice("one"), notice("two"), notice("four", gap=True), None, notice("six")])
    kept = [record("one")]

    class Events:
        def next(self, timeout_s: float) -> Notice | None:
            found = next(came)
            if found is None:
                kept.append(record("five"))  # said while no event came through
            elif found.gap:
                kept.extend(map(record, ("two", "three", "four")))
            return found

    class Client:
        @contextmanager
        def subscribe(self, *topics: str, joined: bool = True) -> Iterator[Events]:
            assert topics == ("log",)
            yield Events()

        def log(self, run: str, limit: int) -> tuple[dict[str, str], ...]:
            return tuple(kept)

    followed = _followed(Client(), "", 50)  # type: ignore[arg-type]
    names = ["one", "two", "three", "four", "five", "six"]
    assert [next(followed)["event"] for _ in names] == names


def test_a_runs_log_that_goes_on_is_of_that_run() -> None:
    came = iter([{"event": "a", "run": "other"}, {"event": "b", "run": "mine"}])

    class Events:
        def next(self, timeout_s: float) -> Notice:
            told = Event(topic="log", sequence=1, epoch="e", utc="", body=Logged(record=next(came)))
            return Notice(event=told, arrays={}, gap=False)

    class Client:
        @contextmanager
        def subscribe(self, *topics: str, joined: bool = True) -> Iterator[Events]:
            yield Events()

        def log(self, run: str, limit: int) -> tuple[dict[str, str], ...]:
            return ()

    assert next(_followed(Client(), "mine", 50))["event"] == "b"  # type: ignore[arg-type]
