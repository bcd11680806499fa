import os
import signal
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from daemon.separation.estimator import Lighting, Observation
from daemon.storage.durable import Damaged, StorageError
from daemon.storage.frames import FrameRecord, FrameStore, NoPixels
from protocol.patterns import Checker

SHAPE = (37, 11)


def record(index: int, **fields: Any) -> FrameRecord:
    return FrameRecord(index=index, step=index // 2, observation=Observation(), **fields)


def pixels(index: int, shape: tuple[int, ...] = SHAPE, dtype: str = "uint16") -> NDArray[Any]:
    return np.random.default_rng(index).integers(0, 256, shape).astype(dtype)


def filled(folder: Path, frames: int = 3) -> FrameStore:
    store = FrameStore.create(folder, SHAPE, "uint16")
    for i in range(frames):
        store.append(pixels(i), record(i))
    assert store.commit() == frames
    return store


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize(
    "shape",
    [(37, 11), (5, 7, 3), pytest.param((1031, 1024, 3), id="bands that do not fill the shard")],
)
def test_any_zarr_reader_opens_it(tmp_path: Path, shape: tuple[int, ...], dtype: str) -> None:
    store = FrameStore.create(tmp_path, shape, dtype)
    first, second = pixels(0, shape, dtype), pixels(1, shape, dtype)
    store.append(first, record(0))
    store.append_missing(record(1, missing="the trigger was lost"))
    store.append(second, record(2))
    store.commit()

    array = zarr.open_array(tmp_path / "frames.zarr", mode="r")
    assert array.shape == (3, *shape)
    assert array.dtype == np.dtype(dtype)
    assert array.metadata.dimension_names == ("frame", "y", "x", "c")[: 1 + len(shape)]  # type: ignore[union-attr]
    np.testing.assert_array_equal(array[0], first)
    np.testing.assert_array_equal(array[2, -3:], second[-3:])
    assert not np.any(array[1])
    files = [p for p in (tmp_path / "frames.zarr").iterdir() if p.name != "zarr.json"]
    assert len(files) == 2, "a frame is one file, a missing one none"


def test_records_and_pixels_come_back(tmp_path: Path) -> None:
    store = FrameStore.create(tmp_path, SHAPE, "uint16")
    full = FrameRecord(
        index=0,
        step=4,
        sub=1,
        sequence=77,
        start_ns=10,
        end_ns=20,
        utc="2026-11-22T01:30:00+00:00",
        exposure_us=0.01,
        gain=3.5,
        source="a.png",
        pattern=Checker(size=8, shift_x=3),
        stage_mm=(1.5, -2.0),
        observation=Observation(lighting=Lighting.WHITE, weight=0.5, warp=(1, 0, 0, 0, 1, 0)),
    )
    written = store.append(pixels(0), full)
    assert written.checksum == f"{zlib.crc32(pixels(0).tobytes()):08x}"
    store.append_missing(record(1, missing="lost packets"))
    assert store.records() == [], "not acknowledged, not recorded"
    store.commit()
    store.close()

    again = FrameStore.open(tmp_path)
    assert again.records() == [written, record(1, missing="lost packets")]
    assert len(again) == 2
    assert (again.shape, again.dtype) == (SHAPE, np.dtype("uint16"))
    out = np.zeros(SHAPE, "uint16")
    assert again.read(0, out) is out
    np.testing.assert_array_equal(out, pixels(0))
    with pytest.raises(NoPixels, match=r"frame 1 .* is missing"):
        again.read(1)
    with pytest.raises(IndexError):
        again.read(2)


def test_what_is_not_a_frame_of_the_run_is_refused(tmp_path: Path) -> None:
    store = filled(tmp_path, 1)
    with pytest.raises(ValueError, match=r"\(37, 12\)"):
        store.append(np.zeros((37, 12), "uint16"), record(1))
    with pytest.raises(ValueError, match="uint8"):
        store.append(np.zeros(SHAPE, "uint8"), record(1))
    with pytest.raises(ValueError, match="the next is 1"):
        store.append(pixels(3), record(3))
    with pytest.raises(ValueError, match="for no reason"):
        store.append_missing(record(1))
    with pytest.raises(ValueError, match="float32"):
        FrameStore.create(tmp_path / "other", SHAPE, "float32")


def test_views_are_recorded_as_they_look(tmp_path: Path) -> None:
    store = FrameStore.create(tmp_path, SHAPE, "uint16")
    wide = pixels(0, (37, 22))
    store.append(wide[:, ::2], record(0))
    store.commit()
    np.testing.assert_array_equal(store.read(0), wide[:, ::2])


def test_a_changed_shard_is_named(tmp_path: Path) -> None:
    filled(tmp_path).close()
    shard = tmp_path / "frames.zarr" / "c.1.0.0"
    data = bytearray(shard.read_bytes())
    data[100] ^= 1
    shard.write_bytes(data)
    store = FrameStore.open(tmp_path)
    store.read(0)
    with pytest.raises(Damaged, match="frame 1 is not what was recorded"):
        store.read(1)
    with pytest.raises(Damaged, match="frame 1 "):
        store.verify()


@pytest.mark.parametrize("length", [None, 0, 100])
def test_an_acknowledged_shard_that_is_gone_or_cut_is_named(
    tmp_path: Path, length: int | None
) -> None:
    filled(tmp_path).close()
    shard = tmp_path / "frames.zarr" / "c.2.0.0"
    if length is None:
        shard.unlink()
    else:
        os.truncate(shard, length)
    with pytest.raises(Damaged, match="frame 2 "):
        FrameStore.open(tmp_path)


def test_damaged_metadata_is_named(tmp_path: Path) -> None:
    filled(tmp_path).close()
    meta = tmp_path / "frames.zarr" / "zarr.json"
    whole = meta.read_bytes()
    meta.write_bytes(whole[:40])
    with pytest.raises(Damaged, match=r"zarr\.json is damaged"):
        FrameStore.open(tmp_path)
    meta.write_bytes(whole.replace(b'"end"', b'"start"'))
    with pytest.raises(Damaged, match="not as Umbra wrote it"):
        FrameStore.open(tmp_path)


def test_unacknowledged_frames_are_removed_unless_only_reading(tmp_path: Path) -> None:
    store = filled(tmp_path)
    store.append(pixels(3), record(3))
    store.close()
    left = tmp_path / "frames.zarr" / "c.3.0.0"
    assert left.exists()

    reader = FrameStore.open(tmp_path, readonly=True)
    assert len(reader) == 3
    assert left.exists()
    with pytest.raises(Damaged, match="reading only"):
        reader.append(pixels(3), record(3))

    again = FrameStore.open(tmp_path)
    assert not left.exists()
    again.append(pixels(9), record(3))
    assert again.commit() == 4
    np.testing.assert_array_equal(again.read(3), pixels(9))


def test_the_array_is_as_long_as_the_lines_after_a_crash_between_the_two(tmp_path: Path) -> None:
    filled(tmp_path).close()
    lines = tmp_path / "frames.jsonl"
    lines.write_bytes(b"".join(lines.read_bytes().splitlines(keepends=True)[:2]) + b'{"index":2')
    assert len(FrameStore.open(tmp_path)) == 2
    assert zarr.open_array(tmp_path / "frames.zarr", mode="r").shape[0] == 2


def test_everything_is_durable_before_it_is_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = FrameStore.create(tmp_path, SHAPE, "uint16")
    for i in range(2):
        store.append(pixels(i), record(i))
    synced: list[str] = []

    def fsync(descriptor: int) -> None:
        name = Path(f"/proc/self/fd/{descriptor}").readlink().name
        if name != "frames.jsonl":
            assert (tmp_path / "frames.jsonl").read_bytes() == b""
        synced.append("zarr.json" if name.endswith(".part") else name)

    monkeypatch.setattr(os, "fsync", fsync)
    store.commit()
    assert synced == ["c.0.0.0", "c.1.0.0", "zarr.json", "frames.zarr", "frames.jsonl"]


def test_after_a_failed_fsync_nothing_more_is_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = filled(tmp_path, 1)
    store.append(pixels(1), record(1))

    def broken(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", broken)
        with pytest.raises(StorageError, match="recording frame 1"):
            store.commit()
    with pytest.raises(Damaged):
        store.commit()
    assert len(FrameStore.open(tmp_path)) == 1


def test_records_without_pixels(tmp_path: Path) -> None:
    store = FrameStore.create(tmp_path, SHAPE, "uint16", pixels=False)
    written = store.append(pixels(0), record(0, source="a.png"))
    store.commit()
    assert written.checksum == f"{zlib.crc32(pixels(0).tobytes()):08x}"
    assert [p.name for p in tmp_path.iterdir()] == ["frames.jsonl"]
    store.close()
    again = FrameStore.open(tmp_path)
    assert again.records() == [written]
    with pytest.raises(NoPixels, match="original recording"):
        again.read(0)


WRITER = """
import sys
from pathlib import Path
import numpy as np
from daemon.storage.frames import FrameRecord, FrameStore
from daemon.separation.estimator import Observation

store = FrameStore.create(Path(sys.argv[1]), (512, 512), "uint16")
frame = np.empty((512, 512), "uint16")
for i in range(1_000_000):
    frame[:] = i % 60_000
    record = FrameRecord(index=i, step=i, observation=Observation(used=i % 7 > 0))
    if i % 7:
        store.append(frame, record)
    else:
        store.append_missing(FrameRecord(**{f: getattr(record, f) for f in ("index", "step",
            "observation")}, missing="every seventh"))
    if i % 3 == 2:
        print(store.commit(), flush=True)
"""


@pytest.mark.parametrize("lines_until_kill", [1, 4, 9])
def test_what_was_acknowledged_survives_sigkill(tmp_path: Path, lines_until_kill: int) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as writer:
        assert writer.stdout
        acknowledged = 0
        for _ in range(lines_until_kill):
            acknowledged = int(writer.stdout.readline())
        writer.send_signal(signal.SIGKILL)
        for answer in writer.stdout:
            acknowledged = int(answer)
        assert writer.wait() == -signal.SIGKILL

    store = FrameStore.open(tmp_path)
    assert len(store) >= acknowledged > 0
    for i, line in enumerate(store.records()):
        assert line.index == i
        if line.missing:
            assert i % 7 == 0
        else:
            assert (store.read(i) == i % 60_000).all()
    array = zarr.open_array(tmp_path / "frames.zarr", mode="r")
    assert array.shape == (len(store), 512, 512)
    store.append(np.zeros((512, 512), "uint16"), record(len(store)))
    assert store.commit() == array.shape[0] + 1
