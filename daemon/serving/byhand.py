"""Commands of work by hand: show, snap, live view, camera, lights, stage, and the lock.

They are refused while a run has the devices, while somebody else holds the rig, and during an
emergency stop; to stop something is never refused.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from typing import Any, TypeVar

from daemon.config import RigConfig
from daemon.devices.rig import Rig
from daemon.manual.manual import Manual
from daemon.pictures import picture
from daemon.pictures.viewfinder import facts_of
from daemon.runs.calibration import Calibrations
from daemon.runs.runner import LOCK, Runner
from daemon.scans.parameters import response_of
from daemon.serving.server import Answer, Asked
from daemon.storage.store import Store
from drivers.base.camera import CameraSettings as DriverSettings
from drivers.base.pixelformat import PixelFormat
from protocol.errors import Code, UmbraError
from protocol.messages import commands, replies
from protocol.messages.rig import CameraSettings
from protocol.messages.runs import RunState
from protocol.scans.spec import Radiometry

T = TypeVar("T")


class ByHand:
    """Answers them; `table` says which. Called from the loop, device calls go to a worker."""

    def __init__(
        self,
        *,
        rig: Rig,
        runner: Runner,
        manual: Manual,
        store: Store,
        config: RigConfig,
        estopped: Callable[[], bool],
    ) -> None:
        self._rig = rig
        self._runner = runner
        self._manual = manual
        self._store = store
        self._config = config
        self._estopped = estopped
        self.table: dict[type[commands.Command], Callable[[Any, Asked], Awaitable[Answer]]] = {
            commands.StartLive: self._start_live,
            commands.StopLive: self._stop_live,
            commands.Show: self._show,
            commands.Snap: self._snap,
            commands.SetCamera: self._camera,
            commands.SetLight: self._light,
            commands.GetStage: self._stage,
            commands.StageHome: self._stage_home,
            commands.StageMove: self._stage_move,
            commands.StageCircle: self._stage_circle,
            commands.StageStop: self._stage_stop,
            commands.StageUnlock: self._stage_unlock,
            commands.Dark: self._dark,
            commands.Lock: self._lock,
            commands.RenewLock: self._renew,
            commands.Unlock: self._unlock,
        }

    async def do(self, asked: Asked, act: Callable[[], T]) -> T:
        """Let a worker do something with the devices. Raises UmbraError as `require`."""
        self.require(asked)
        return await asyncio.to_thread(act)

    def require(self, asked: Asked) -> None:
        """Raise UmbraError unless this client may use the devices by hand now."""
        self._manual.admit(asked.token)
        if self._estopped():
            raise UmbraError(Code.ESTOPPED, "an emergency stop is in force; `umbra reset` ends it")
        self.require_no_run()

    def require_no_run(self) -> None:
        """Raise UmbraError(busy) while a run has the devices."""
        current = self._runner.current
        if current is not None:
            raise UmbraError(
                Code.BUSY,
                f"{current.id} is using the devices; wait for it, or `umbra abort`",
            )

    async def _start_live(self, command: commands.StartLive, asked: Asked) -> Answer:
        def look() -> None:
            bench = None
            if command.separate is not None:
                bench = self._rig.bench(self._calibration())
            self._manual.look(command.rate_hz, command.lease_s, command.separate, bench)

        await self.do(asked, look)
        return Answer(replies.Done(message=f"live for {command.lease_s:g} s, unless asked again"))

    def _calibration(self) -> dict[str, Any]:
        """The values that apply to the rig as it is now."""
        camera = self._rig.camera.device
        in_force = camera.settings()
        settings = {
            "exposure_us": in_force.exposure_us,
            "gain": in_force.gain,
            "pixel_format": camera.info().pixel_format.value,
        }
        found = Calibrations(self._store, self._config.calibration.max_age_days)
        values: dict[str, Any] = found.of(self._rig.snapshot(), settings)["values"]
        return values

    def _expose(self, wanted: DriverSettings) -> dict[str, Any]:
        """Choose the exposure; of `wanted` it is the longest."""
        bench = self._rig.bench(self._calibration())
        if bench.camera.recorded:
            raise UmbraError(Code.UNSUITABLE, "a recording's exposure is as it was taken")
        return self._manual.expose(wanted, response_of(Radiometry(), bench)).facts()

    async def _stop_live(self, _: commands.StopLive, __: Asked) -> Answer:
        await asyncio.to_thread(self._manual.live.stop)
        return Answer(replies.Done(message="the live view has ended"))

    async def _show(self, command: commands.Show, asked: Asked) -> Answer:
        await self.do(asked, lambda: self._manual.show(command.pattern, command.lease_s))
        return Answer(
            replies.Done(message=f"shown; dark in {command.lease_s:g} s, or with `umbra show off`")
        )

    async def _snap(self, command: commands.Snap, asked: Asked) -> Answer:
        def snap() -> Answer:
            frame, info = self._manual.snap()
            facts = facts_of(frame, info)
            if not command.png:
                return Answer(replies.Picture(facts=facts), {"frame": frame.pixels})
            shown = picture.png(frame.pixels, info.pixel_format, demosaiced=command.demosaic)
            return Answer(replies.Picture(facts=facts), {"png": shown})

        return await self.do(asked, snap)

    async def _camera(self, command: commands.SetCamera, asked: Asked) -> Answer:
        wanted = _settings(command.settings)
        if command.auto_exposure:
            facts = await self.do(asked, lambda: self._expose(wanted))
            in_force = self._rig.camera.device.settings()
            return Answer(replies.Camera(settings=CameraSettings(**asdict(in_force)), facts=facts))
        if wanted == DriverSettings():
            in_force = self._rig.camera.device.settings()
        else:
            in_force = await self.do(asked, lambda: self._manual.configure(wanted))
        return Answer(replies.Camera(settings=CameraSettings(**asdict(in_force))))

    async def _light(self, command: commands.SetLight, asked: Asked) -> Answer:
        await self.do(asked, lambda: self._manual.light(command.name, command.on))
        return Answer(replies.Done(message=f"{command.name} is {'on' if command.on else 'off'}"))

    async def _stage(self, _: commands.GetStage, __: Asked) -> Answer:
        return Answer(await asyncio.to_thread(self._manual.stage.status))

    async def _stage_home(self, command: commands.StageHome, asked: Asked) -> Answer:
        home = self._manual.stage.home
        return Answer(await self.do(asked, lambda: home(command.timeout_s)))

    async def _stage_move(self, command: commands.StageMove, asked: Asked) -> Answer:
        def move() -> replies.StageStatus:
            return self._manual.stage.move(command.x_mm, command.y_mm, command.feed_mm_s)

        return Answer(await self.do(asked, move))

    async def _stage_circle(self, command: commands.StageCircle, asked: Asked) -> Answer:
        def circle() -> replies.StageStatus:
            return self._manual.stage.circle(
                command.centre_mm, command.radius_mm, command.feed_mm_s, command.turns
            )

        return Answer(await self.do(asked, circle))

    async def _stage_stop(self, _: commands.StageStop, __: Asked) -> Answer:
        """Whoever holds the rig: to stop is never refused, but a run is aborted, not stopped."""
        self.require_no_run()
        return Answer(await asyncio.to_thread(self._manual.stage.stop))

    async def _stage_unlock(self, _: commands.StageUnlock, asked: Asked) -> Answer:
        """Also for a run that waits for just this: it has the devices, and homes the stage."""
        current = self._runner.current
        if current is None or current.file.state not in {RunState.QUEUED, RunState.WAITING}:
            return Answer(await self.do(asked, self._manual.stage.unlock))
        self._manual.admit(asked.token)
        status = await asyncio.to_thread(self._manual.stage.unlock_for_run)
        self._runner.wake()
        return Answer(status)

    async def _dark(self, _: commands.Dark, asked: Asked) -> Answer:
        await self.do(asked, self._manual.end)
        return Answer(replies.Done(message="dark"))

    async def _lock(self, command: commands.Lock, asked: Asked) -> Answer:
        token = await self.do(
            asked, lambda: self._manual.lock(command.owner, command.note, command.lease_s)
        )
        self._runner.hold(LOCK)
        return Answer(replies.Locked(token=token, lease_s=command.lease_s))

    async def _renew(self, _: commands.RenewLock, asked: Asked) -> Answer:
        return Answer(replies.Locked(token=asked.token, lease_s=self._manual.renew(asked.token)))

    async def _unlock(self, command: commands.Unlock, asked: Asked) -> Answer:
        await asyncio.to_thread(self._manual.unlock, asked.token, force=command.force)
        self._runner.release(LOCK)
        return Answer(replies.Done(message="the rig is free"))


def _settings(wanted: CameraSettings) -> DriverSettings:
    pixel_format = None
    if wanted.pixel_format is not None:
        try:
            pixel_format = PixelFormat(wanted.pixel_format)
        except ValueError:
            known = ", ".join(PixelFormat)
            raise UmbraError(
                Code.BAD_REQUEST,
                f"pixel format {wanted.pixel_format!r} is none of {known}",
                "$.command.settings.pixel_format",
            ) from None
    return DriverSettings(
        exposure_us=wanted.exposure_us,
        gain=wanted.gain,
        pixel_format=pixel_format,
        frame_rate_hz=wanted.frame_rate_hz,
        roi=wanted.roi,
    )
