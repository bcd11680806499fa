"""A rig under the sun in simulated time: the virtual devices themselves, one thread, and a clock
that jumps. A scan takes as long as its frames take to be rendered, and gives the same bits always.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from daemon.scans.catalog import method_for
from daemon.scans.method import Bench, Circle, Method, Motion, Taken, Watch
from daemon.separation.estimator import Components, Observation
from drivers.base.camera import Acquisition
from drivers.base.device import Context
from drivers.clock import NS
from drivers.registry import build
from drivers.virtual.camera import VirtualCamera
from drivers.virtual.stage import VirtualStage
from protocol.scans.occluded import Mesh, Stick
from tests.jumping import Jumping

STAGE = {"before_scene_mm": 150.0, "hole_mm": 12.5, "pitch_mm": 20.0, "homing_feed_mm_s": 200.0}
SUN = {"kind": "sun", "position_mm": (-300.0, 620.0, -250.0)}
CAMERA = {"width": 160, "height": 120, "pixel_format": "Mono12", "frame_rate_hz": 25.0}


@dataclass
class Outdoors:
    """What a scan under the sun came to."""

    components: Components
    truth: dict[str, NDArray[np.float32]]
    observations: list[Observation]
    reason: str
    seconds: float
    method: Method[Any]
    summaries: list[dict[str, float]] = field(default_factory=list)
    shots: list[NDArray[Any]] = field(default_factory=list)


def _set_going(mover: VirtualStage, motion: Motion | None) -> int | None:
    """To the motion's first point, and on; gives the moment at which the motion ends."""
    assert motion is not None
    fastest = mover.info().max_feed_mm_s
    if isinstance(motion, Circle):
        x, y = motion.centre_mm
        mover.move(x + motion.radius_mm, y, fastest)
        mover.clock.wait_until(mover._latest.end_ns)
        mover.circle(motion.centre_mm, motion.radius_mm, motion.feed_mm_s, np.inf)
        return None
    mover.move(*motion.points_mm[0], fastest)
    mover.clock.wait_until(mover._latest.end_ns)
    for point in motion.points_mm[1:]:
        mover.move(*point, motion.feed_mm_s)
    return mover._latest.end_ns


def scan(
    spec: Mesh | Stick,
    *,
    camera: dict[str, Any] | None = None,
    sun: dict[str, Any] | None = None,
    stage: dict[str, Any] | None = None,
    frames: int = 100_000,
    keep: bool = False,
) -> Outdoors:
    """Do a scan as the sequencer does it: home, approach, stream while the stage moves.

    With `keep` the frames are kept.
    """
    here = Context(clock=Jumping())
    light = cast(Any, build("light", "virtual", "sun", SUN | (sun or {}), here))
    light.connect()
    mover = cast(VirtualStage, build("stage", "virtual", "stage", STAGE | (stage or {}), here))
    mover.connect()
    eye = cast(VirtualCamera, build("camera", "virtual", "camera", CAMERA | (camera or {}), here))
    eye.connect()
    mover.home(120.0)
    method = method_for(spec, Bench(eye.info(), stage=mover.info(), lights=("sun",)))
    step = method.step(0, {})
    assert isinstance(step, Watch)
    end_ns = _set_going(mover, step.motion)
    eye.start(Acquisition.FREE)
    estimator = method.estimator()
    info = eye.info()
    out = np.empty(info.shape, info.pixel_format.dtype)
    began = here.clock.now_ns()
    decided: list[Observation] = []
    summaries: list[dict[str, float]] = []
    shots: list[NDArray[Any]] = []
    reason, summary = "frames", dict[str, float]()
    while len(decided) < frames:
        seconds = (here.clock.now_ns() - began) / NS
        if end_ns is not None and here.clock.now_ns() >= end_ns:
            reason = "the stage's motion has come to its end"
            break
        if why := method.enough(summary, seconds):
            reason = why
            break
        frame = eye.grab(out, 5.0)
        taken = Taken(0, len(decided), incomplete=frame.incomplete, pixels=out)
        observation = method.observe(step, taken)
        estimator.update(out, observation)
        summary = estimator.summary()
        summaries.append(summary)
        decided.append(observation)
        if keep:
            shots.append(out.copy())
    seconds = (here.clock.now_ns() - began) / NS
    found = estimator.result()
    assert isinstance(found, Components)
    return Outdoors(
        method.conclude(found), eye.truth(), decided, reason, seconds, method, summaries, shots
    )
