"""What each command does. One method a command; the protocol says what it means."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import numpy as np

from daemon import __version__, discovery, measured, picture, products
from daemon.byhand import ByHand
from daemon.config import RigConfig
from daemon.doctor.examination import Doctor
from daemon.drawing import draw
from daemon.logs import LogBook
from daemon.manual import Manual
from daemon.publisher import Publisher
from daemon.reprocessor import Reprocessor
from daemon.rig import SAFE_S, Rig
from daemon.runfolder import RunFolder
from daemon.runner import Runner
from daemon.scans import catalog
from daemon.separation.estimator import Components, Result
from daemon.server import Answer, Asked, Caller
from daemon.store import Store
from daemon.viewfinder import Glimpse, Viewfinder, cells
from protocol.errors import Code, UmbraError
from protocol.messages import commands, replies
from protocol.messages.access import Role
from protocol.messages.envelopes import PROTOCOL
from protocol.messages.events import RigChanged
from protocol.messages.rig import RigState
from protocol.messages.runs import RunInfo, RunState

ESTOP = "estop"
"""An emergency stop: the reason to hold the queue, and its mark in the data folder."""


class Commands:
    """Answers commands; called from the loop, what blocks goes to a worker thread."""

    def __init__(
        self,
        *,
        rig: Rig,
        runner: Runner,
        reprocessor: Reprocessor,
        manual: Manual,
        store: Store,
        config: RigConfig,
        viewfinder: Viewfinder,
        doctor: Doctor,
        publisher: Publisher,
        book: LogBook,
        epoch: str,
    ) -> None:
        self._rig = rig
        self._runner = runner
        self._reprocessor = reprocessor
        self._manual = manual
        self._store = store
        self._config = config
        self._viewfinder = viewfinder
        self._doctor = doctor
        self._publisher = publisher
        self._book = book
        self._epoch = epoch
        self._began = time.monotonic()
        self._estopped = store.marked(ESTOP)
        if self._estopped:
            rig.latch()
            runner.hold(ESTOP)
        self._by_hand = ByHand(
            rig=rig,
            runner=runner,
            manual=manual,
            store=store,
            config=config,
            estopped=lambda: self._estopped,
        )
        self._results = asyncio.Semaphore(1)  # one at a time: each takes the estimator's thread
        self.stopping = False
        self._table: dict[type[commands.Command], Callable[[Any, Asked], Awaitable[Answer]]] = {
            commands.Hello: self._hello,
            commands.GetStatus: self._status,
            commands.GetDevices: self._devices,
            commands.Discover: self._discover,
            commands.Examine: self._examine,
            commands.Submit: self._submit,
            commands.Reprocess: self._reprocess,
            commands.GetQueue: self._queue,
            commands.MoveQueued: self._move,
            commands.Pause: self._pause,
            commands.Resume: self._resume,
            commands.Abort: self._abort,
            commands.EStop: self._estop,
            commands.Reset: self._reset,
            commands.ListRuns: self._runs,
            commands.GetRun: self._run,
            commands.GetResult: self._result,
            commands.GetProduct: self._product,
            commands.GetLog: self._log,
            commands.GetPreview: self._preview,
            commands.Draw: self._draw,
            **self._by_hand.table,
        }

    async def handle(
        self, command: commands.AnyCommand, caller: Caller, request_id: str, token: str
    ) -> Answer:
        """Do a command. Raises UmbraError or DeviceError."""
        if self.stopping and command.role is Role.OPERATOR:
            raise UmbraError(Code.STOPPING, "umbrad is shutting down; ask again when it is back")
        return await self._table[type(command)](command, Asked(caller, request_id, token))

    def stop(self, reason: str) -> None:
        """From now on nothing is begun any more."""
        self.stopping = True
        self.changed(reason)

    @property
    def state(self) -> RigState:
        """What the rig as a whole is doing."""
        if self.stopping:
            return RigState.STOPPING
        if self._estopped:
            return RigState.ESTOPPED
        if (current := self._runner.current) is not None:
            of = {
                RunState.WAITING: RigState.WAITING,
                RunState.PAUSED: RigState.PAUSED,
            }
            return of.get(current.file.state, RigState.SCANNING)
        return RigState.MANUAL if self._manual.active else RigState.IDLE

    # ------------------------------------------------------------ facts

    async def _hello(self, _: commands.Hello, asked: Asked) -> Answer:
        return Answer(
            replies.Welcome(
                protocol=PROTOCOL,
                server=__version__,
                rig=self._config.rig.name,
                epoch=self._epoch,
                role=asked.caller.role,
                events=self._config.network.events,
                methods=catalog.NAMES,
                devices=self._rig.names(),
            )
        )

    async def _status(self, _: commands.GetStatus, __: Asked) -> Answer:
        current = self._runner.current
        return Answer(
            replies.Status(
                rig=self._config.rig.name,
                state=self.state,
                epoch=self._epoch,
                uptime_s=time.monotonic() - self._began,
                devices=self._rig.devices(),
                run=self._counted(current) if current else None,
                progress=self._runner.progress,
                queue=tuple(run.info() for run in self._runner.queue()),
                lock=self._manual.lock_info(),
                free_bytes=self._store.free_bytes(),
                reserve_bytes=self._store.reserve_bytes,
                sequences=self._publisher.sequences(),
                reprocessing=self._reprocessor.progress,
            )
        )

    def _counted(self, run: RunFolder) -> RunInfo:
        """A run as it is now; its counts are written at its end only, so they are asked for."""
        info = run.info()
        for progress in (self._runner.progress, self._reprocessor.progress):
            if progress is not None and progress.run == run.id:
                info = msgspec.structs.replace(
                    info,
                    recorded=progress.recorded,
                    missing=progress.missing,
                    rejected=progress.rejected,
                )
        return info

    async def _devices(self, _: commands.GetDevices, __: Asked) -> Answer:
        return Answer(replies.Devices(devices=self._rig.devices()))

    async def _discover(self, command: commands.Discover, asked: Asked) -> Answer:
        self._manual.admit(asked.token)
        self._by_hand.require_no_run()
        searches = await discovery.discover(
            command.drivers, command.timeout_s, self._config.devices, self._rig.devices()
        )
        return Answer(replies.Discovered(searches=searches))

    async def _examine(self, command: commands.Examine, asked: Asked) -> Answer:
        doctor = self._doctor
        if not command.passive:
            self._by_hand.require(asked)
        writes = self._runner.current is not None
        checks = await asyncio.to_thread(doctor.look, run_writes=writes)
        if not command.passive:
            checks += await self._by_hand.do(asked, doctor.expose)
        return Answer(replies.Examined(checks=tuple(checks)))

    async def _log(self, command: commands.GetLog, _: Asked) -> Answer:
        if command.run:
            await asyncio.to_thread(self._store.open, command.run)  # a name that is wrong is said
        records = await asyncio.to_thread(self._book.records, command.run, command.limit)
        return Answer(replies.Log(records=records))

    # ------------------------------------------------------------ runs

    async def _submit(self, command: commands.Submit, asked: Asked) -> Answer:
        if (known := self._runner.submitted(asked.request_id)) is not None:
            return _about(known)
        self._manual.admit(asked.token)
        if self._estopped:
            raise UmbraError(Code.ESTOPPED, "an emergency stop is in force; `umbra reset` ends it")
        by = command.by or asked.caller.name
        # Writing run.json takes an fsync: not in the loop.
        run = await asyncio.to_thread(
            self._runner.submit,
            command.spec,
            by,
            asked.request_id,
            first=command.first,
            holder=self._manual.lock_info() is not None,
        )
        return _about(run)

    async def _reprocess(self, command: commands.Reprocess, asked: Asked) -> Answer:
        """Neither a lock nor an emergency stop keeps anybody from it: it touches no device."""
        by = command.by or asked.caller.name
        return _about(
            await asyncio.to_thread(self._reprocessor.submit, command, by, asked.request_id)
        )

    async def _queue(self, _: commands.GetQueue, __: Asked) -> Answer:
        return Answer(replies.Runs(runs=tuple(run.info() for run in self._runner.queue())))

    async def _move(self, command: commands.MoveQueued, asked: Asked) -> Answer:
        self._manual.admit(asked.token)
        if self._reprocessor.mine(command.run) is not None:
            raise UmbraError(
                Code.WRONG_STATE,
                f"{command.run} is made from another run's frames: it waits beside the queue",
            )
        queue = await asyncio.to_thread(self._runner.move, command.run, command.to)
        return Answer(replies.Runs(runs=tuple(run.info() for run in queue)))

    async def _pause(self, command: commands.Pause, asked: Asked) -> Answer:
        self._manual.admit(asked.token)
        return _about(self._runner.pause(command.run))

    async def _resume(self, command: commands.Resume, asked: Asked) -> Answer:
        if (mine := self._reprocessor.mine(command.run)) is not None:
            return _about(await asyncio.to_thread(self._reprocessor.resume, mine))
        self._manual.admit(asked.token)
        return _about(await asyncio.to_thread(self._runner.resume, command.run))

    async def _abort(self, command: commands.Abort, asked: Asked) -> Answer:
        by = command.by or asked.caller.name
        # Here and not in a worker: what waits for the workers must not delay it.
        current = self._runner.abort_current(command.run, by)
        if current is None and (mine := self._reprocessor.mine(command.run)) is not None:
            return _about(await asyncio.to_thread(self._reprocessor.abort, mine, by))
        if current is None:
            current = await asyncio.to_thread(self._runner.abort, command.run, by)
        return _about(current)

    async def _estop(self, command: commands.EStop, asked: Asked) -> Answer:
        by = command.by or asked.caller.name
        self._estopped = True
        self._runner.hold(ESTOP)
        self._rig.latch()
        self._runner.end_for_estop(by)
        futures = self._rig.make_safe()
        await asyncio.to_thread(self._store.mark, ESTOP)  # a restart must not light anything
        safe = await asyncio.to_thread(self._rig.safe_within, futures, SAFE_S)
        self.changed(f"emergency stop{f' by {by}' if by else ''}")
        if not safe:
            return Answer(
                replies.Done(
                    message="stopped, but not every device said that it is safe: look at it"
                )
            )
        return Answer(replies.Done(message="stopped: dark and held; `umbra reset` ends it"))

    async def _reset(self, _: commands.Reset, __: Asked) -> Answer:
        await asyncio.to_thread(self._rig.require_ready)
        await asyncio.to_thread(self._store.unmark, ESTOP)
        self._rig.unlatch()
        self._estopped = False
        self._runner.release(ESTOP)
        self.changed("reset")
        return Answer(replies.Done(message="the queue goes on"))

    async def _runs(self, command: commands.ListRuns, _: Asked) -> Answer:
        def listed() -> tuple[RunInfo, ...]:
            runs = self._store.runs()
            chosen = (r for r in runs if command.state is None or r.file.state is command.state)
            return tuple(self._counted(run) for run in itertools.islice(chosen, command.limit))

        return Answer(replies.Runs(runs=await asyncio.to_thread(listed)))

    async def _run(self, command: commands.GetRun, _: Asked) -> Answer:
        run = await asyncio.to_thread(self._runner.find, command.run)
        return Answer(replies.Run(run=self._counted(run)))

    async def _result(self, command: commands.GetResult, _: Asked) -> Answer:
        def result() -> Answer:
            run = self._runner.find(command.run)
            found, facts = self._result_of(run)
            reply = replies.Result(
                run=run.info(), final=run.file.state is RunState.DONE, facts=facts
            )
            if not isinstance(found, Components):
                return Answer(reply)
            return Answer(
                reply,
                {"direct": found.direct, "global": found.global_, "quality": found.quality},
            )

        async with self._results:
            return await asyncio.to_thread(result)

    def _result_of(self, run: RunFolder) -> tuple[Result, dict[str, Any]]:
        """Of a run under way: so far; of one that has ended: as its products have it."""
        for course in (self._runner.course, self._reprocessor.current):
            if course is not None and course.folder.id == run.id and not run.file.products:
                found = course.result()
                return found, found.facts
        measurement = measured.read(run)
        return (measurement, measurement.facts) if measurement else products.read(run)

    async def _product(self, command: commands.GetProduct, _: Asked) -> Answer:
        def part() -> Answer:
            run = self._store.open(command.run)
            path = run.product(command.name)
            size = path.stat().st_size
            with path.open("rb") as file:
                file.seek(command.offset)
                data = np.frombuffer(file.read(command.limit), np.uint8)
            product = next(p for p in run.file.products if p.name == command.name)
            return Answer(
                replies.ProductPart(product=product, offset=command.offset, size=size),
                {"data": data},
            )

        return await asyncio.to_thread(part)

    async def _preview(self, command: commands.GetPreview, _: Asked) -> Answer:
        def look() -> Answer:
            if command.what == "frame":
                glimpse = self._viewfinder.latest()
                if glimpse is None:
                    raise UmbraError(
                        Code.NO_RESULT, "no frame has been taken yet; `umbra snap` takes one"
                    )
                return _looked(glimpse, command.width)
            if self._manual.live.separating and (seen := self._viewfinder.latest(command.what)):
                return _looked(seen, command.width)
            run = self._runner.find("")
            components, _ = self._result_of(run)
            if not isinstance(components, Components):
                raise UmbraError(
                    Code.NO_RESULT, f"{run.id} measures: it has figures, no {command.what}"
                )
            plane = components.direct if command.what == "direct" else components.global_
            shown = picture.component(plane, command.width)
            return Answer(
                replies.Picture(facts={"run": run.id, "what": command.what}), {"preview": shown}
            )

        return await asyncio.to_thread(look)

    async def _draw(self, command: commands.Draw, _: Asked) -> Answer:
        drawn = await asyncio.to_thread(
            draw, command.spec, command.image, command.width, command.height, command.gamma
        )
        facts = {"images": drawn.images, "lighting": drawn.lighting.value}
        return Answer(replies.Picture(facts=facts), {"png": drawn.png})

    # ------------------------------------------------------------ events

    def changed(self, reason: str = "") -> None:
        """Tell subscribers that the rig's state or lock changed; from the loop."""
        self._publisher.publish(
            RigChanged(state=self.state, lock=self._manual.lock_info(), reason=reason)
        )


def _looked(glimpse: Glimpse, width: int) -> Answer:
    small = picture.narrowed(glimpse.picture, width)
    arrays = {"preview": small, "saturated": cells(glimpse.saturated, *small.shape[:2])}
    age_s = round(time.monotonic() - glimpse.at_s, 1)
    return Answer(
        replies.Picture(facts={**glimpse.facts, "run": glimpse.run, "age_s": age_s}), arrays
    )


def _about(run: RunFolder) -> Answer:
    return Answer(replies.Run(run=run.info()))
