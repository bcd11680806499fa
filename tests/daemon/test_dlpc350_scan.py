"""A whole scan that a LightCrafter times: its driver over an emulated USB cable, its trigger line
and its light on the virtual bench, the virtual camera at the other end."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.config import RigConfig, parse
from daemon.devices import rig as rig_module
from daemon.devices.rig import Rig
from daemon.patterns import render
from daemon.pictures.viewfinder import Viewfinder
from daemon.runs.course import Course
from daemon.storage.store import Store
from drivers import dmd
from drivers.base.device import Context
from drivers.clock import Clock
from drivers.virtual.bench import Bench, Emission, TriggerLine
from drivers.virtual.geometry import Pinhole
from drivers.virtual.scene import TARGET
from drivers.virtual.timeline import Timeline
from protocol.errors import Code
from protocol.messages.runs import End, RunState
from protocol.scans.projected import Checkerboard, Sinusoid
from tests.drivers.dlpc350_peer import Board, Usb

SCAN = Checkerboard(checker=80, shift=30, shifts=5)
TENTH = (182, 114)  # of the square grid: what the light is drawn with
Image = NDArray[np.uint8]


class Dmd:
    """The mirrors as a source on the bench: lit patterns, dark between and after them."""

    name, main, strength = "projector", True, 1.0
    pinhole = Pinhole((230.0, 420.0, -230.0), TARGET, *TENTH, math.radians(21.0))

    def __init__(self, bench: Bench, clock: Clock) -> None:
        self.bench, self.clock = bench, clock
        self.shown: Timeline[tuple[int, Image] | None] = Timeline(None, 1024)
        self.number = 0
        self.line = bench.line = TriggerLine()
        bench.add(self)

    def emitted(self, start_ns: int, end_ns: int) -> Sequence[Emission]:
        return [
            Emission((end - start) / (end_ns - start_ns), shown[0], partial(self.draw, shown[1]))
            for start, end, shown in self.shown.spans(start_ns, end_ns)
            if shown is not None
        ]

    def draw(self, mirrors: Image) -> NDArray[np.float32]:
        small = cv2.resize(mirrors, TENTH, interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.float32) / np.float32(255)

    def play(self, images: Sequence[Image], lit_ns: int, period_ns: int) -> None:
        with self.bench.lock:
            start = self.clock.now_ns() + 3_000_000
            pulses = [start + k * period_ns for k in range(len(images))]
            for pulse, image in zip(pulses, images, strict=True):
                self.number += 1
                self.shown.change(pulse, (self.number, image))
                self.shown.change(pulse + lit_ns, None)
            self.line.fire(pulses)

    def darken(self) -> None:
        with self.bench.lock:
            self.line.cut(self.clock.now_ns())
            self.shown.change(self.clock.now_ns(), None)


class Lit(Board):
    """A board whose mirrors are on the bench."""

    mirrors: Dmd

    def handle(self, flags: int, command: int, data: bytes) -> bytes | None:
        answer = super().handle(flags, command, data)
        if command == 0x1A07 and data == b"\0":
            self.mirrors.darken()
        return answer

    def play(self) -> None:
        before = len(self.played)
        super().play()
        exposure_us, period_us = struct.unpack("<II", self.registers[0x1A29])
        assert all(led for _, led in self.played[before:])
        images = [image for image, _ in self.played[before:]]
        self.mirrors.play(images, exposure_us * 1000, period_us * 1000)


@dataclass
class Lab:
    board: Lit
    flash: list[str]
    folder: Path
    rig: Rig | None = None

    def config(self, camera: str = "", more: str = "") -> RigConfig:
        return parse(
            f"""
            [rig]
            data = "{self.folder / "data"}"
            [storage]
            reserve_mb = 0
            [sequencer]
            trigger_wired = true
            frame_timeout_s = 0.4
            {more}
            [projector]
            driver = "dlpc350"
            flash = {self.flash}
            [camera]
            driver = "virtual"
            width = 160
            height = 120
            exposure_us = 8000
            gain = 6
            readout_ms = 2
            buffers = 64
            {camera}
            """,
            "lab",
        )

    def scan(self, spec: Any, config: RigConfig) -> tuple[End, Any]:
        """Do a scan, as the daemon does it; how it ended, and its run.json."""
        self.rig = Rig(config, lambda _: None)
        self.rig.connect()
        with Store(self.folder / "data", 0, self.rig.clock) as store:
            run = store.create(spec, self.rig.snapshot())
            course = Course(
                run,
                rig=self.rig,
                store=store,
                config=config,
                viewfinder=Viewfinder(lambda _: None),
                on_change=lambda: None,
                on_progress=lambda _: None,
            )
            return course.execute(), run.file


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The scan's 25 patterns as they are in the board's flash, 24 to an image."""
    folder = tmp_path_factory.mktemp("flash")
    shifts = [
        render(type_, 2 * dmd.COLUMNS, dmd.ROWS)
        for type_ in (step.pattern for step in _patterns())
        if type_ is not None
    ]
    mirrors = [dmd.to_mirrors(image) for image in shifts]
    names = []
    for k in range(0, len(mirrors), dmd.PLANES):
        names.append(str(folder / f"{k}.png"))
        cv2.imwrite(names[-1], dmd.pack(mirrors[k : k + dmd.PLANES])[..., ::-1])
    return names


def _patterns() -> list[Any]:
    from daemon.scans.catalog import method_for
    from daemon.scans.method import Bench as Facts
    from daemon.separation.estimator import Lighting
    from drivers.base.camera import CameraInfo
    from drivers.base.pixelformat import PixelFormat
    from drivers.base.projector import ProjectorInfo

    camera = CameraInfo(160, 120, PixelFormat.BAYER_RG12)
    projector = ProjectorInfo(2 * dmd.COLUMNS, dmd.ROWS, 60.0)
    method = method_for(SCAN, Facts(camera=camera, projector=projector))
    steps = [method.step(k, {}) for k in range(27)]
    return [step for step in steps if getattr(step, "lighting", None) is Lighting.PATTERN]


@pytest.fixture
def lab(files: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    pictures = [np.asarray(cv2.imread(name), np.uint8) for name in files]
    board = Lit([picture[..., ::-1] for picture in pictures])
    made: Callable[..., Context] = Context

    def context(*, clock: Clock) -> Context:
        shared = made(clock=clock, shared={"usb": Usb(board)})
        board.mirrors = Dmd(Bench.of(shared), clock)
        return shared

    monkeypatch.setattr(rig_module, "Context", context)
    lab = Lab(board, files, tmp_path)
    yield lab
    if lab.rig is not None:
        lab.rig.close()


def test_a_whole_scan_is_one_sequence(lab: Lab) -> None:
    end, file = lab.scan(SCAN, lab.config(camera='faults = ["drop-trigger@11"]'))
    assert end.state is RunState.DONE, end.reason
    assert (file.recorded, file.missing) == (27, 0)
    assert file.estimates["frames"] == 27
    assert file.estimates["bytes"] > 27 * 160 * 120
    assert file.sequencing["mode"] == "hardware"
    assert file.sequencing["counts"] == {"repeated": 1, "hardware": 27}
    assert lab.board.dark
    # The board was told the whole table once, and played it twice: 27 patterns, and two for proof.
    assert len(lab.board.played) == 2 * 29
    facts = file.products
    assert {"direct", "global"} <= {product.name for product in facts}


def test_what_is_not_in_flash_is_named(lab: Lab) -> None:
    # Refused as a sequence, as shorter ones, and by itself.
    end, file = lab.scan(Checkerboard(checker=72, shift=27, shifts=5), lab.config())
    assert end.state is RunState.FAILED
    assert end.code == Code.DEVICE_REFUSED
    assert "not in flash" in end.reason
    assert file.missing == 0


def test_grey_levels_are_refused_where_sequences_were_asked_for(lab: Lab) -> None:
    end, _ = lab.scan(Sinusoid(mode="hardware", references=()), lab.config())
    assert end.code == Code.UNSUITABLE
    assert "grey levels" in end.reason
    assert not lab.board.played
