"""Pauses, ends and failures that come while a run waits, at the moments that processes rarely hit.

The devices and their threads are real (virtual) ones; what records is played by the test.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from daemon.config import SequencerSection
from daemon.devices.devicethread import Revoked, Session
from daemon.devices.lightmeter import LightMeter, require_meterable
from daemon.devices.rig import Rig
from daemon.exposing.apparatus import Apparatus
from daemon.exposing.control import Control
from daemon.exposing.modes import Choice, Mode
from daemon.exposing.recorder import Exposed, Recorder
from daemon.exposing.ring import Ring
from daemon.exposing.sequencer import Sequencer, exposer_for
from daemon.exposing.video import Video
from daemon.scans.catalog import method_for
from daemon.scans.method import Circle, Expose, Method, Unsuitable, Watch
from daemon.scans.parameters import response_of
from drivers.base.camera import CameraSettings
from drivers.clock import NS, Clock
from protocol.messages.runs import RunState
from protocol.scans.projected import TwoImage
from protocol.scans.spec import Radiometry
from tests.daemon.small_rig import small_rig

STAGE_AND_LAMP = """
[stage]
driver = "virtual"
homing_feed_mm_s = 200
[[light]]
name = "left"
driver = "virtual"
"""

SOON_S = 20.0
"""For a loaded machine; what is waited for here comes at once, or after half a minute."""


class Tape:
    """In the recorder's place: keeps what is put, and gives no buffer back unless told to."""

    def __init__(self, ring: Ring, *, gives: bool) -> None:
        self.ring, self.gives = ring, gives
        self.taken: list[Exposed] = []
        self.failure: BaseException | None = None
        self.summary: Mapping[str, float] = {}
        self.on_put: Callable[[int], None] = lambda _: None

    def check(self) -> None:
        if self.failure is not None:
            raise self.failure

    def put(self, exposed: Exposed) -> None:
        self.taken.append(exposed)
        if self.gives and exposed.buffer is not None:
            self.ring.give(exposed.buffer)
        self.on_put(len(self.taken))

    def digested(self, _: float) -> bool:
        return False


class Skipping(Clock):
    """The rig's clock, and what was skipped of it."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.skipped_ns = clock, 0

    def now_ns(self) -> int:
        return self.clock.now_ns() + self.skipped_ns

    def utc_ns(self) -> int:
        return self.clock.utc_ns() + self.skipped_ns

    def wait_until(self, deadline_ns: int, wake: threading.Event | None = None) -> bool:
        return self.clock.wait_until(deadline_ns - self.skipped_ns, wake)


@dataclass
class Stand:
    """A rig in use by a run that has no more than an apparatus."""

    rig: Rig
    control: Control
    session: Session
    tape: Tape
    method: Method[Any]
    apparatus: Apparatus
    paused: threading.Event = field(default_factory=threading.Event)
    on_pause: Callable[[], None] = lambda: None

    def pauses(self) -> None:
        self.paused.set()
        self.on_pause()

    def dark(self) -> bool:
        """Whether the projector gives no light now."""
        projector = cast(Any, self.rig.projector).device
        now = self.rig.clock.now_ns()
        return not projector.emitted(now, now + 1)


@pytest.fixture
def stand(request: pytest.FixtureRequest) -> Iterator[Stand]:
    given: dict[str, Any] = getattr(request, "param", {})
    camera = "noise = false\n" + given.get("camera", "")
    with small_rig(time_scale=20, camera=camera, more=STAGE_AND_LAMP) as rig:
        session, control = rig.take("test"), Control()
        info = rig.camera.device.info()
        ring = Ring(given.get("ring", 4), info.shape, info.pixel_format.dtype)
        tape = Tape(ring, gives=given.get("gives", True))
        method = method_for(TwoImage(average=3), rig.bench())
        made: list[Stand] = []
        apparatus = Apparatus(
            rig=rig,
            session=session,
            control=control,
            method=method,
            recorder=cast(Recorder, tape),
            ring=ring,
            patience=SequencerSection(),
            may_go_on=lambda: None,
            on_pause=lambda _: made[0].pauses(),
            taken=0,
        )
        made.append(Stand(rig, control, session, tape, method, apparatus))
        yield made[0]
        rig.leave(session)


@pytest.fixture
def aside() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as pool:
        yield pool


STARVED = pytest.mark.parametrize("stand", [{"ring": 8, "gives": False}], indirect=True)
ALL_MODES = pytest.mark.parametrize("mode", [Mode.HARDWARE, Mode.SOFTWARE, Mode.FREE])


def run(stand: Stand, mode: Mode) -> None:
    exposer = exposer_for(Choice(mode, "the test says so"), stand.apparatus)
    Sequencer(stand.apparatus, exposer).run(0, 0)


@ALL_MODES
@STARVED
def test_who_waits_for_the_recorder_hears_of_a_pause_and_of_the_end(
    stand: Stand, aside: ThreadPoolExecutor, mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    starved = threading.Event()
    take = stand.apparatus.ring.take

    def taken(seconds: float) -> Any:
        buffer = take(seconds)
        if buffer is None:
            starved.set()
        return buffer

    monkeypatch.setattr(stand.apparatus.ring, "take", taken)
    running = aside.submit(run, stand, mode)
    assert starved.wait(SOON_S)
    stand.control.pause("the disk is full")
    assert stand.paused.wait(SOON_S)
    assert stand.dark()
    stand.control.end(RunState.ABORTED, "aborted")
    with pytest.raises(Revoked):
        running.result(SOON_S)


@ALL_MODES
@STARVED
def test_who_waits_for_the_recorder_hears_of_its_failure(
    stand: Stand, aside: ThreadPoolExecutor, mode: Mode
) -> None:
    running = aside.submit(run, stand, mode)
    stand.tape.failure = OSError("the disk is gone")
    with pytest.raises(OSError, match="the disk is gone"):
        running.result(SOON_S)


def test_a_recorder_that_fails_in_a_pause_ends_it(stand: Stand, aside: ThreadPoolExecutor) -> None:
    stand.control.pause("asked for")
    running = aside.submit(run, stand, Mode.SOFTWARE)
    assert stand.paused.wait(SOON_S)
    stand.tape.failure = OSError("the disk is gone")
    with pytest.raises(OSError, match="the disk is gone"):
        running.result(SOON_S)


@ALL_MODES
def test_after_the_last_frame_it_is_dark(stand: Stand, mode: Mode) -> None:
    # The recorder may wait for room for days.
    run(stand, mode)
    assert [(e.index, e.sub) for e in stand.tape.taken] == [
        (i, s) for i in range(4) for s in range(3)
    ]
    assert all(e.frame is not None for e in stand.tape.taken)
    assert stand.dark()
    assert not stand.session.ended.is_set()


@pytest.mark.parametrize(
    "stand",
    [{"camera": 'faults = ["drop-trigger@5", "drop-trigger@20"]', "ring": 32}],
    indirect=True,
)
def test_a_sequence_that_loses_frames_is_run_again_more_slowly(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    projector = cast(Any, stand.rig.projector).device
    load, periods = projector.load, list[float]()

    def loaded(images: Any, exposure_us: float, period_us: float) -> Any:
        periods.append(period_us)
        return load(images, exposure_us, period_us)

    monkeypatch.setattr(projector, "load", loaded)
    run(stand, Mode.HARDWARE)
    assert [p / periods[0] for p in periods] == pytest.approx([1, 2, 4])
    assert all(e.frame is not None for e in stand.tape.taken)


class Doubter:
    """In the place of the proof by looks: doubts the frames of these calls."""

    def __init__(self, calls: set[int]) -> None:
        self.calls, self.asked = calls, list[int]()

    def problem(self, _: Any, step: Expose, __: Any) -> str:
        self.asked.append(step.index)
        return "it looks odd" if len(self.asked) in self.calls else ""


@pytest.mark.parametrize(
    ("doubted", "lost"), [({1, 5, 6, 12}, set()), ({2, 3, 4}, {1}), ({12, 13, 14}, {11})]
)
def test_a_frame_that_looks_wrong_is_exposed_again_and_so_is_the_next(
    stand: Stand, doubted: set[int], lost: set[int]
) -> None:
    doubter = Doubter(doubted)
    stand.apparatus.looks = cast(Any, doubter)
    run(stand, Mode.SOFTWARE)
    taken = stand.tape.taken
    assert [(e.index, e.sub) for e in taken] == [(i, s) for i in range(4) for s in range(3)]
    assert {i for i, e in enumerate(taken) if e.frame is None} == lost
    assert sum(e.exposing.get("repeated", 0) for e in taken) == len(doubted) - len(lost)
    assert doubter.asked == sorted(doubter.asked)  # no frame of a later pattern passed for one
    assert len({e.frame.start_ns for e in taken if e.frame is not None}) == 12 - len(lost)
    ring = stand.apparatus.ring
    assert all(ring.take(0) is not None for _ in range(ring.count))  # no buffer is lost


@pytest.mark.parametrize("stand", [{"camera": 'faults = ["incomplete-frame@1"]'}], indirect=True)
def test_each_look_at_the_light_is_a_sign_of_life(stand: Stand) -> None:
    # Ten long ones, each tried again, are more than the watchdog waits for.
    said: list[float] = []
    meter = LightMeter(
        rig=stand.rig,
        session=stand.session,
        spec=TwoImage(auto_exposure=True),
        settings=CameraSettings(exposure_us=1000.0),
        response=response_of(Radiometry(), stand.rig.bench()),
        latency_s=0.0,
        attempts=2,
        on_look=said.append,
        on_picture=lambda *_: None,
    )
    chosen = meter.choose()
    assert len(said) == chosen.looks
    assert said[-1] == pytest.approx(chosen.exposure_us * 1e-6)
    assert stand.dark()


@pytest.mark.parametrize(
    "stand",
    [{"camera": 'triggers = ["hardware"]'}, {"camera": 'triggers = ["none"]'}],
    indirect=True,
)
def test_a_camera_that_only_sequences_trigger_takes_no_looks(stand: Stand) -> None:
    bench = stand.rig.bench()
    require_meterable(TwoImage(), bench)
    if bench.camera.triggers == ("none",):
        require_meterable(TwoImage(auto_exposure=True), bench)
        return
    with pytest.raises(Unsuitable, match="set the exposure by hand") as caught:
        require_meterable(TwoImage(auto_exposure=True), bench)
    assert caught.value.where == "$.auto_exposure"


class Watched:
    """A method that watches until it has seen so many frames, and keeps what it was asked."""

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self.seconds: list[float] = []

    def enough(self, _: Mapping[str, float], seconds: float) -> str:
        self.seconds.append(seconds)
        return "enough" if len(self.seconds) > self.frames else ""


MOTION = Circle((250.0, 150.0), 20.0, 200.0)


def watch(stand: Stand, frames: int) -> Watched:
    watched = Watched(frames)
    stand.apparatus.method = cast(Any, watched)
    Video(stand.apparatus).watch(0, Watch(None, MOTION, ("left",)), 0)
    return watched


def test_a_pause_that_is_over_at_once_leaves_the_stage_moving(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    from daemon.exposing.motion import Mover

    ended = Mover.end

    def end(mover: Mover) -> None:  # takes as long as a real stage decelerates
        ended(mover)
        stand.control.resume()

    monkeypatch.setattr(Mover, "end", end)
    stand.tape.on_put = lambda n: stand.control.pause("a slip of the hand") if n == 10 else None
    watch(stand, 60)
    places = [e.stage_mm for e in stand.tape.taken if e.frame is not None][-10:]
    assert len({place for place in places if place is not None}) > 5
    lit = cast(Any, stand.rig.lights["left"].device).is_on()
    assert lit


def test_time_in_a_pause_is_not_time_of_the_video(stand: Stand) -> None:
    clock = stand.apparatus.clock = Skipping(stand.apparatus.clock)
    hour_s = 3600.0

    def pause(frames: int) -> None:
        if frames == 10:
            stand.control.pause("lunch")

    def resume() -> None:
        clock.skipped_ns = round(hour_s * NS)
        stand.control.resume()

    stand.tape.on_put = pause
    stand.on_pause = resume
    watched = watch(stand, 30)
    assert clock.skipped_ns > 0
    assert watched.seconds[-1] < hour_s / 2


def test_a_pause_after_the_end_holds_nobody(aside: ThreadPoolExecutor) -> None:
    control = Control()
    control.end(RunState.ABORTED, "aborted")
    control.pause("the disk is full")
    assert not control.paused
    assert aside.submit(control.await_resume).result(SOON_S) is False
