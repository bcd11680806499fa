import json
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from daemon.separation.estimator import Observation
from daemon.storage.durable import Damaged
from daemon.storage.frames import FrameRecord, FrameStore
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import DataFolderInUse, Store, estimate_bytes
from drivers.clock import RealClock
from protocol.errors import Code, UmbraError
from protocol.messages.runs import End, Product, RunState
from protocol.scans.occluded import Stick
from protocol.scans.projected import Checkerboard, TwoImage


class Calendar(RealClock):
    def __init__(self) -> None:
        super().__init__()
        self.utc = int(datetime(2026, 11, 22, 1, 30, 45, tzinfo=UTC).timestamp()) * 10**9

    def utc_ns(self) -> int:
        self.utc += 1_000_000
        return self.utc


def end(run: RunFolder, seconds: int = 0) -> None:
    done = datetime(2026, 11, 22, 2, 0, seconds, tzinfo=UTC)
    run.update(
        state=RunState.DONE,
        ended=done.isoformat(),
        end=End(state=RunState.DONE, reason="all frames taken"),
    )


def test_a_run_is_on_disk_when_create_returns(tmp_path: Path) -> None:
    with Store(tmp_path, clock=Calendar()) as store:
        run = store.create(
            Checkerboard(note="wax & candle"), {"camera": {"model": "virtual"}}, "ada", "r" * 12
        )
        assert run.id.startswith("20261122-013045-checkerboard-")
        page = json.loads((run.path / "run.json").read_text())
        assert page["spec"]["method"] == "checkerboard"
        assert page["rig"] == {"camera": {"model": "virtual"}}
        assert page["versions"]["numpy"] == np.__version__
        info = run.info()
        assert (info.id, info.state, info.by) == (run.id, RunState.QUEUED, "ada")
        assert info.submitted == "2026-11-22T01:30:45.001000+00:00"
        assert run.path.parent == tmp_path / "runs"


def test_runs_and_queue_survive_a_restart(tmp_path: Path) -> None:
    clock = Calendar()
    with Store(tmp_path, clock=clock) as store:
        a = store.create(Checkerboard(), {}, request_id="request-a")
        b = store.create(TwoImage(), {}, request_id="request-b")
        c = store.create(Stick(), {}, first=True)
        assert [r.id for r in store.queued()] == [c.id, a.id, b.id]
        b.update(order=-5)
        end(a)
    with Store(tmp_path, clock=clock) as store:
        assert [r.id for r in store.runs()] == [c.id, b.id, a.id]
        assert [r.id for r in store.queued()] == [b.id, c.id]
        found = store.find_request("request-a")
        assert found is store.open(a.id)
        assert found.file == a.file
        assert store.find_request("") is None
        assert store.find_request("request-c") is None


def test_update_is_all_or_nothing(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        run = store.create(Checkerboard(), {})
        run.update(recorded=12, timings={"frames": 1.5})
        assert RunFolder.read(run.path).file == run.file
        assert run.file.recorded == 12
        before = (run.path / "run.json").read_bytes()
        with pytest.raises(TypeError, match="colour"):
            run.update(recorded=13, colour="red")
        assert (run.path / "run.json").read_bytes() == before
        assert run.file.recorded == 12


def test_products_by_name(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        run = store.create(Checkerboard(), {})
        with pytest.raises(UmbraError, match="none yet"):
            run.product("direct")
        (run.path / "direct.tiff").write_bytes(b"II*")
        direct = Product(name="direct", kind="image", file="direct.tiff", bytes=3)
        run.add_products([direct, Product(name="report", kind="report", file="report.html")])
        run.add_products([direct])
        assert [p.name for p in run.info().products] == ["direct", "report"]
        assert run.product("direct") == run.path / "direct.tiff"
        with pytest.raises(UmbraError, match="it has direct, report") as caught:
            run.product("globl")
        assert caught.value.code is Code.UNKNOWN_PRODUCT
        with pytest.raises(UmbraError, match=r"report\.html is no longer"):
            run.product("report")


@pytest.mark.parametrize("id", ["", "..", "../..", "20261122-013045-stick-aaaa", "a/b", "run.json"])
def test_only_runs_can_be_opened(tmp_path: Path, id: str) -> None:
    with Store(tmp_path) as store, pytest.raises(UmbraError) as caught:
        store.open(id)
    assert caught.value.code is Code.UNKNOWN_RUN


def test_a_damaged_run_is_reported_and_not_fatal(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        good, bad = store.create(Checkerboard(), {}), store.create(Checkerboard(), {})
    (bad.path / "run.json").write_text('{"id": "x')
    (tmp_path / "runs" / "my notes").mkdir()
    with Store(tmp_path) as store:
        assert [r.id for r in store.runs()] == [good.id]
        assert set(store.damaged) == {bad.id, "my notes"}
        with pytest.raises(Damaged, match=r"run\.json"):
            store.open(bad.id)


def test_half_made_and_half_deleted_folders_are_swept_up(tmp_path: Path) -> None:
    half = tmp_path / "runs" / ".20261122-013045-stick-aaaa"
    half.mkdir(parents=True)
    (half / "run.json").write_text("{")
    with Store(tmp_path) as store:
        assert store.runs() == []
        assert store.damaged == {}
    assert not half.exists()


def test_somebodys_file_among_the_runs_is_left_alone(tmp_path: Path) -> None:
    with Store(tmp_path):
        (tmp_path / "runs" / ".DS_Store").write_bytes(b"x")
        (tmp_path / "runs" / "notes.txt").write_bytes(b"x")
    with Store(tmp_path) as store:
        assert not store.damaged
    assert (tmp_path / "runs" / ".DS_Store").exists()


def test_two_daemons_never_share_a_folder(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib; from daemon.storage.store import Store\n"
        "store = Store(pathlib.Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout
        assert other.stdout.readline() == "held\n"
        with pytest.raises(DataFolderInUse, match=rf"process {other.pid}\)"):
            Store(tmp_path)
        other.kill()
    with Store(tmp_path):
        pass


def test_room_keeps_the_reserve(tmp_path: Path) -> None:
    with Store(tmp_path, reserve_bytes=0) as store:
        free = store.free_bytes()
        assert store.room_for(free // 2)
        assert not store.room_for(free * 2)
        store.reserve_bytes = free * 2
        assert not store.room_for(0)


def test_the_estimate_covers_what_frames_take(tmp_path: Path) -> None:
    shape = (100, 80, 3)
    store = FrameStore.create(tmp_path, shape, "uint8")
    for i in range(40):
        record = FrameRecord(index=i, step=i, observation=Observation(), source="a" * 200)
        store.append(np.zeros(shape, "uint8"), record)
    store.commit()
    taken = sum(p.stat().st_size for p in tmp_path.rglob("*"))
    assert taken < estimate_bytes(shape, "uint8", 40)
    grown = estimate_bytes(shape, "uint8", 80) - estimate_bytes(shape, "uint8", 40)
    assert taken < grown < 2 * taken


def test_old_runs_expire_but_never_one_in_use(tmp_path: Path) -> None:
    clock = Calendar()
    with Store(tmp_path, clock=clock) as store:
        parent, old, kept, new = (store.create(Checkerboard(), {}) for _ in range(4))
        waiting = store.create(Checkerboard(), {})
        for i, run in enumerate((parent, old, kept, new)):
            end(run, seconds=i)
        kept.update(parents=(parent.id,))
        clock.utc += 3600 * 10**9
        assert store.expire(max_age_s=1e6) == []
        assert store.expire(max_age_s=60, keep=[kept.id, new.id]) == [old.id]
        assert not old.path.exists()
        (new.path / "frames").write_bytes(bytes(10_000))
        assert store.expire(max_bytes=9_000, keep=[kept.id]) == [new.id]
        assert {r.id for r in store.runs()} == {parent.id, kept.id, waiting.id}
        with pytest.raises(UmbraError):
            store.open(old.id)
