"""A recorder on a disk that fills: nothing is lost, nothing is decided twice."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import daemon.storage.frames
import daemon.storage.journal
from daemon.exposing.recorder import Exposed, Recorder
from daemon.exposing.ring import Ring
from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Method
from daemon.separation.estimator import NotYet
from daemon.storage.durable import StorageError
from daemon.storage.frames import FrameStore
from drivers.base.camera import CameraInfo, Frame
from drivers.base.pixelformat import PixelFormat
from drivers.base.projector import ProjectorInfo
from protocol.errors import Code, UmbraError
from protocol.scans.projected import TwoImage

SHAPE = (12, 16)
CAMERA = CameraInfo(SHAPE[1], SHAPE[0], PixelFormat.MONO8)


class Disk:
    """Writes that fail while it is full: of shards, or of the lines that acknowledge them. An fsync
    that fails has dropped what was written."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, full: dict[str, int]) -> None:
        self.full = full
        for name in full:
            place = daemon.storage.journal if name == "_write_at" else daemon.storage.frames
            monkeypatch.setattr(place, name, self._failing(name, getattr(place, name)))

    def _failing(self, name: str, real: Any) -> Any:
        def write(*args: Any, **options: Any) -> Any:
            if self.full.get(name, 0) > 0:
                self.full[name] -= 1
                if name == "fsync_file":
                    args[0].write_bytes(b"")
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*args, **options)

        return write


class Course:
    """What waits for room: here it is there at once."""

    def __init__(self, patience: int = 100) -> None:
        self.patience = patience
        self.held = 0

    def on_full(self, error: StorageError) -> None:
        self.held += 1
        if self.held > self.patience:
            raise error

    def on_taken(self, *_: object) -> None:
        pass


def two_images() -> Method[Any]:
    return method_for(TwoImage(), Bench(CAMERA, projector=ProjectorInfo(64, 48, 60.0)))


def record(
    frames: FrameStore, course: Course, method: Method[Any] | None = None, source: str = ""
) -> Recorder:
    """Record a two-image scan of four frames, each of one grey; not finished yet."""
    method = method or two_images()
    ring = Ring(4, SHAPE, np.dtype(np.uint8))
    recorder = Recorder(method, frames, ring, course.on_taken, course.on_full)
    recorder.start()
    for index in range(4):
        step = method.step(index, {})
        assert step is not None
        buffer = ring.take(1.0)
        assert buffer is not None
        buffer[...] = 40 + 50 * index
        frame = Frame(buffer, index, 0, 1000, 0, 1.0, source=source)
        recorder.put(Exposed(step=step, index=index, sub=0, frame=frame, buffer=buffer))
    return recorder


def store(folder: Path) -> FrameStore:
    folder.mkdir()
    return FrameStore.create(folder, SHAPE, np.uint8)


@pytest.mark.parametrize("what", ["_write", "fsync_file", "atomic_write", "_write_at"])
def test_what_the_disk_refused_is_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    frames = store(tmp_path / "straight")
    record(frames, Course()).finish()
    frames.close()

    course, frames = Course(), store(tmp_path / "full")
    Disk(monkeypatch, {what: 3})
    recorder = record(frames, course)
    recorder.finish()
    frames.close()
    assert course.held == 3
    assert recorder.tally.recorded == 4
    kept = FrameStore.open(tmp_path / "full", readonly=True)
    kept.verify()
    assert [int(kept.read(i)[0, 0]) for i in range(4)] == [40, 90, 140, 190]
    assert kept.records() == FrameStore.open(tmp_path / "straight", readonly=True).records()


def test_a_run_that_ends_meanwhile_ends_with_the_disks_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = store(tmp_path / "full")
    Disk(monkeypatch, {"_write": 100})
    recorder = record(frames, Course(patience=2))
    with pytest.raises(StorageError, match="the disk is full"):
        recorder.finish()
    assert recorder.tally.recorded == 0
    frames.close()


def test_after_a_failed_fsync_nothing_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path) -> None:
        raise OSError(errno.EIO, "Input/output error", str(path))

    course, frames = Course(), store(tmp_path / "broken")
    monkeypatch.setattr(daemon.storage.frames, "fsync_file", fail)
    recorder = record(frames, course)
    with pytest.raises(StorageError):
        recorder.finish()
    assert course.held == 0
    frames.close()


def test_while_the_past_is_taken_in_there_is_no_result(tmp_path: Path) -> None:
    # The estimator is in use by the thread that replays.
    frames = store(tmp_path / "run")
    ring = Ring(4, SHAPE, np.dtype(np.uint8))
    recorder = Recorder(two_images(), frames, ring, Course().on_taken, Course().on_full)
    with pytest.raises(NotYet, match="ask again"):
        recorder.result(1.0)
    frames.close()


@pytest.mark.parametrize(
    ("source", "said", "code"),
    [
        ("shot7.png", r"shot7\.png cannot be separated \(error: .*take it out", Code.BAD_INPUT),
        ("", r"camera: frame 0 cannot be separated .*`umbra snap`", Code.DEVICE_GARBLED),
    ],
)
@pytest.mark.parametrize("where", ["observe", "estimator"])
def test_a_frame_that_nobody_thought_of_is_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    source: str,
    said: str,
    code: Code,
) -> None:
    def fail(*_: object) -> Any:
        raise cv2.error("Sizes of input arguments do not match")

    method = two_images()
    if where == "observe":
        monkeypatch.setattr(method, "observe", fail)
    else:
        estimator = method.estimator()
        monkeypatch.setattr(estimator, "update", fail)
        monkeypatch.setattr(method, "estimator", lambda: estimator)
    frames = store(tmp_path / "run")
    with pytest.raises(UmbraError, match=said) as caught:
        record(frames, Course(), method, source).finish()
    assert caught.value.code is code
    frames.close()
