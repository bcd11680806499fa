"""Every command as a typed method, written once for both clients.

A method here says what to send and what the answer becomes. `Client` has it as a blocking call,
`AsyncClient` as a coroutine: `command` binds it to either.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import msgspec

from protocol.bothways import command
from protocol.connection import (
    Ask,
    GivenKeys,
    checked,
    chosen_endpoint,
    chosen_keys,
    expect,
    own_name,
)
from protocol.errors import Code, UmbraError
from protocol.messages import commands, replies
from protocol.messages.findings import Check, Search
from protocol.messages.rig import CameraSettings, DeviceInfo
from protocol.messages.runs import RunInfo, RunState
from protocol.patterns import BLACK, WHITE, AnyPattern
from protocol.results import (
    Part,
    Picture,
    Separation,
    facts_of,
    message_of,
    part_of,
    picture_of,
    run_of,
    runs_of,
    separation_of,
    stage_of,
)
from protocol.scans.anyscan import AnyScan
from protocol.scans.projected import SingleImage
from protocol.scans.spec import Spec

SLOW_S = 30.0
"""The least time-out of a command whose own work takes time: an exposure, a large array."""

EXPOSE_S = 60.0
"""Ten exposures of the longest that auto-exposure takes by itself, and their readouts."""

EXAMINE_S = 180.0
"""An examination exposes, flips and writes: seconds, and a minute with devices that time out."""


class Commands:
    """The methods that both clients have. Each raises UmbraError with the daemon's reason.

    `run` is a run's id; "" means the current run (or, to read, else the newest).
    """

    def __init__(
        self,
        endpoint: str | None,
        keys: GivenKeys,
        timeout_s: float,
        name: str,
    ) -> None:
        """Which rig, and who asks: see `protocol.client.connect`."""
        self.endpoint = chosen_endpoint(endpoint)
        self.keys = chosen_keys(keys, self.endpoint)
        self.timeout_s = timeout_s
        self.name = name or own_name()  # for the rig's records
        self.token = ""  # of the lock, while this client holds it

    @command
    def hello(self) -> Ask[replies.Welcome]:
        """Who is there, with the version check; done on connecting."""
        return Ask(
            commands.Hello(client=self.name), lambda a: checked(expect(a.reply, replies.Welcome))
        )

    @command
    def status(self) -> Ask[replies.Status]:
        """Everything that changes, now: rig, devices, current run, queue, lock, free space."""
        return Ask(commands.GetStatus(), lambda a: expect(a.reply, replies.Status))

    @command
    def devices(self) -> Ask[tuple[DeviceInfo, ...]]:
        """The devices in detail."""
        return Ask(commands.GetDevices(), lambda a: expect(a.reply, replies.Devices).devices)

    @command
    def discover(self, *drivers: str, timeout_s: float = 15.0) -> Ask[tuple[Search, ...]]:
        """What is attached, asked of the drivers named, or of all. They broadcast on networks."""
        return Ask(
            commands.Discover(drivers=drivers, timeout_s=timeout_s),
            lambda a: expect(a.reply, replies.Discovered).searches,
            timeout_s + SLOW_S,
        )

    @command
    def examine(self, *, passive: bool = False) -> Ask[tuple[Check, ...]]:
        """Look for what is wrong with the rig (`umbra doctor`); `passive` exposes nothing."""
        return Ask(
            commands.Examine(passive=passive),
            lambda a: expect(a.reply, replies.Examined).checks,
            EXAMINE_S,
        )

    @command
    def submit(self, spec: AnyScan, *, first: bool = False) -> Ask[RunInfo]:
        """Queue a scan, ahead of the others if `first`; comes back at once. `scan` gives a Run."""
        if not isinstance(spec, Spec):
            raise UmbraError(
                Code.BAD_REQUEST,
                f"{spec!r} is no scan: say what to scan by a struct of umbra's, such as "
                "umbra.Checkerboard(checker=8)",
            )
        return Ask(commands.Submit(spec=spec, by=self.name, first=first), run_of)

    @command
    def submit_reprocess(
        self,
        run: str,
        *,
        calibration: Literal["recorded", "now"] = "recorded",
        changes: Mapping[str, Any] | None = None,
    ) -> Ask[RunInfo]:
        """Separate a run's frames anew; comes back at once. `reprocess` gives a Run."""
        plain = msgspec.to_builtins(dict(changes or {}))
        asked = commands.Reprocess(run=run, changes=plain, calibration=calibration, by=self.name)
        return Ask(asked, run_of, SLOW_S)

    @command
    def queue(self) -> Ask[tuple[RunInfo, ...]]:
        """The runs that wait, in order."""
        return Ask(commands.GetQueue(), runs_of)

    @command
    def move_queued(self, run: str, to: int) -> Ask[tuple[RunInfo, ...]]:
        """Put a waiting run at another place in the queue (0 is next)."""
        return Ask(commands.MoveQueued(run=run, to=to), runs_of)

    @command
    def pause(self, run: str = "") -> Ask[RunInfo]:
        """Pause a run after the step under way: projector dark, stage held."""
        return Ask(commands.Pause(run=run), run_of)

    @command
    def resume(self, run: str = "") -> Ask[RunInfo]:
        """Go on with a paused run, or queue an interrupted one where it stopped."""
        return Ask(commands.Resume(run=run), run_of)

    @command
    def abort(self, run: str = "") -> Ask[RunInfo]:
        """End a run and go to the safe state; what was recorded is kept."""
        return Ask(commands.Abort(run=run, by=self.name), run_of)

    @command
    def estop(self) -> Ask[str]:
        """Safe state now; everything is refused until `reset`."""
        return Ask(commands.EStop(by=self.name), message_of)

    @command
    def reset(self) -> Ask[str]:
        """End an emergency stop."""
        return Ask(commands.Reset(), message_of)

    @command
    def runs(self, limit: int = 50, state: RunState | None = None) -> Ask[tuple[RunInfo, ...]]:
        """Runs, the newest first."""
        return Ask(commands.ListRuns(limit=limit, state=state), runs_of)

    @command
    def run_info(self, run: str = "") -> Ask[RunInfo]:
        """What is known of one run; `run` gives a handle on it."""
        return Ask(commands.GetRun(run=run), run_of)

    @command
    def result(self, run: str = "") -> Ask[Separation]:
        """Direct and global, final or so far."""
        return Ask(commands.GetResult(run=run), separation_of, SLOW_S)

    @command
    def facts(self, run: str = "") -> Ask[dict[str, Any]]:
        """The figures of a run, final or so far: of a separation quality.json's, else its own."""
        return Ask(commands.GetResult(run=run), facts_of, SLOW_S)

    @command
    def product_part(self, run: str, name: str, offset: int = 0, limit: int = 8 << 20) -> Ask[Part]:
        """A part of a product's file; `download` fetches a whole one."""
        return Ask(
            commands.GetProduct(run=run, name=name, offset=offset, limit=limit), part_of, SLOW_S
        )

    @command
    def log(self, run: str = "", limit: int = 200) -> Ask[tuple[dict[str, Any], ...]]:
        """The last log records of a run, or ("") of the daemon; the oldest first."""
        return Ask(
            commands.GetLog(run=run, limit=limit), lambda a: expect(a.reply, replies.Log).records
        )

    @command
    def preview(
        self, width: int = 640, what: Literal["frame", "direct", "global"] = "frame"
    ) -> Ask[Picture]:
        """The latest frame, small (uint8, RGB)."""
        return Ask(commands.GetPreview(width=width, what=what), picture_of("preview"))

    @command
    def live(
        self, rate_hz: float = 4.0, lease_s: float = 10.0, separate: SingleImage | None = None
    ) -> Ask[str]:
        """Look through the camera live for `lease_s` more: subscribe to the topic preview."""
        return Ask(
            commands.StartLive(rate_hz=rate_hz, lease_s=lease_s, separate=separate),
            message_of,
            SLOW_S,
        )

    @command
    def stop_live(self) -> Ask[str]:
        """End the live view."""
        return Ask(commands.StopLive(), message_of, SLOW_S)

    @command
    def show(
        self, pattern: AnyPattern | Literal["white", "black"], lease_s: float = 600.0
    ) -> Ask[str]:
        """Show a pattern by hand; the projector goes dark after `lease_s`."""
        if isinstance(pattern, str):
            named = {"white": WHITE, "black": BLACK}.get(pattern)
            if named is None:
                raise UmbraError(
                    Code.BAD_REQUEST,
                    f"no pattern is called {pattern!r}: it is white, black, or a pattern such as "
                    "umbra.Checker(size=8)",
                )
            pattern = named
        return Ask(commands.Show(pattern=pattern, lease_s=lease_s), message_of)

    @command
    def draw(
        self, spec: AnyScan, image: int, width: int, height: int, *, gamma: float = 1.0
    ) -> Ask[Picture]:
        """An image of a scan's patterns as the bytes of a PNG file: 0 is black, 1 white, then each
        pattern; `facts["images"]` says how many there are."""
        drawn = commands.Draw(spec=spec, image=image, width=width, height=height, gamma=gamma)
        return Ask(drawn, picture_of("png"), SLOW_S)

    @command
    def snap(self, *, png: bool = False, demosaic: bool = True) -> Ask[Picture]:
        """Take one frame as things are: native depth, a mosaic as it is; or the bytes of a PNG
        file, in colours unless `demosaic` is false."""
        return Ask(commands.Snap(png=png, demosaic=demosaic), picture_of("frame", "png"), SLOW_S)

    @command
    def camera(
        self,
        *,
        exposure_us: float | None = None,
        gain: float | None = None,
        pixel_format: str | None = None,
        frame_rate_hz: float | None = None,
        roi: tuple[int, int, int, int] | None = None,
    ) -> Ask[CameraSettings]:
        """Change the camera's settings, or with none only read them: those in force."""
        settings = CameraSettings(
            exposure_us=exposure_us,
            gain=gain,
            pixel_format=pixel_format,
            frame_rate_hz=frame_rate_hz,
            roi=roi,
        )
        return Ask(
            commands.SetCamera(settings=settings),
            lambda a: expect(a.reply, replies.Camera).settings,
        )

    @command
    def auto_exposure(self, longest_us: float | None = None) -> Ask[dict[str, Any]]:
        """Let the camera's exposure be chosen for the scene as it is lit now, and no longer than
        this; `exposure_us`, and how bright it is with it. `problem`: why it is not as wanted."""
        settings = CameraSettings(exposure_us=longest_us)
        return Ask(
            commands.SetCamera(settings=settings, auto_exposure=True),
            lambda a: expect(a.reply, replies.Camera).facts,
            timeout_s=EXPOSE_S,
        )

    @command
    def light(self, name: str, on: bool) -> Ask[str]:
        """Switch a light."""
        return Ask(commands.SetLight(name=name, on=on), message_of)

    @command
    def stage(self) -> Ask[replies.StageStatus]:
        """Where the stage is and what it is doing."""
        return Ask(commands.GetStage(), stage_of)

    @command
    def stage_home(self, timeout_s: float = 60.0) -> Ask[replies.StageStatus]:
        """Begin to find the stage's origin; `stage` and the topic stage show the end."""
        return Ask(commands.StageHome(timeout_s=timeout_s), stage_of)

    @command
    def stage_move(self, x_mm: float, y_mm: float, feed_mm_s: float) -> Ask[replies.StageStatus]:
        """Begin to go straight to a point."""
        return Ask(commands.StageMove(x_mm=x_mm, y_mm=y_mm, feed_mm_s=feed_mm_s), stage_of, SLOW_S)

    @command
    def stage_circle(
        self,
        centre_mm: tuple[float, float],
        radius_mm: float,
        feed_mm_s: float,
        turns: float | None = None,
    ) -> Ask[replies.StageStatus]:
        """Begin to go round a circle; without `turns` until `stage_stop`."""
        asked = commands.StageCircle(
            centre_mm=centre_mm, radius_mm=radius_mm, feed_mm_s=feed_mm_s, turns=turns
        )
        return Ask(asked, stage_of, SLOW_S)

    @command
    def stage_stop(self) -> Ask[replies.StageStatus]:
        """End every motion of the stage, whoever asked for it."""
        return Ask(commands.StageStop(), stage_of, SLOW_S)

    @command
    def stage_unlock(self) -> Ask[replies.StageStatus]:
        """Leave the stage's alarm without homing."""
        return Ask(commands.StageUnlock(), stage_of, SLOW_S)

    @command
    def dark(self) -> Ask[str]:
        """End manual work: projector dark, lights off, stage held."""
        return Ask(commands.Dark(), message_of)

    @command
    def lock(self, owner: str, note: str = "", lease_s: float = 10.0) -> Ask[replies.Locked]:
        """Take the lock, without its heartbeat: `hold` is the way to have both."""
        return Ask(
            commands.Lock(owner=owner, note=note, lease_s=lease_s),
            lambda a: expect(a.reply, replies.Locked),
        )

    @command
    def renew_lock(self) -> Ask[replies.Locked]:
        """The heartbeat of this client's lock."""
        return Ask(commands.RenewLock(), lambda a: expect(a.reply, replies.Locked))

    @command
    def unlock(self, *, force: bool = False) -> Ask[str]:
        """Give the rig back; `force` breaks another's lock."""
        return Ask(commands.Unlock(force=force), message_of)
