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
from daemon.logs import LogBook
from daemon.manual import Manual
from daemon.publisher import Publisher
from daemon.reprocessor import Reprocessor
from daemon.rig import SAFE_S, Rig
from daemon.runner import Runner
from daemon.scans import catalog
from daemon.separation.estimator import Components, Result
from daemon.server import Answer, Asked, Caller
from daemon.store import RunFolder, Store
from daemon.viewfinder import Glimpse, Viewfinder, cells
from protocol import messages as m
from protocol.errors import Code, UmbraError

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
        self._table: dict[type[m.Command], Callable[[Any, Asked], Awaitable[Answer]]] = {
            m.Hello: self._hello,
            m.GetStatus: self._status,
            m.GetDevices: self._devices,
            m.Discover: self._discover,
            m.Examine: self._examine,
            m.Submit: self._submit,
            m.Reprocess: self._reprocess,
            m.GetQueue: self._queue,
            m.MoveQueued: self._move,
            m.Pause: self._pause,
            m.Resume: self._resume,
            m.Abort: self._abort,
            m.EStop: self._estop,
            m.Reset: self._reset,
            m.ListRuns: self._runs,
            m.GetRun: self._run,
            m.GetResult: self._result,
            m.GetProduct: self._product,
            m.GetLog: self._log,
            m.GetPreview: self._preview,
            **self._by_hand.table,
        }

    async def handle(
        self, command: m.AnyCommand, caller: Caller, request_id: str, token: str
    ) -> Answer:
        """Do a command. Raises UmbraError or DeviceError."""
        if self.stopping and command.role is m.Role.OPERATOR:
            raise UmbraError(Code.STOPPING, "umbrad is shutting down; ask again when it is back")
        return await self._table[type(command)](command, Asked(caller, request_id, token))

    def stop(self, reason: str) -> None:
        """From now on nothing is begun any more."""
        self.stopping = True
        self.changed(reason)

    @property
    def state(self) -> m.RigState:
        """What the rig as a whole is doing."""
        if self.stopping:
            return m.RigState.STOPPING
        if self._estopped:
            return m.RigState.ESTOPPED
        if (current := self._runner.current) is not None:
            of = {
                m.RunState.WAITING: m.RigState.WAITING,
                m.RunState.PAUSED: m.RigState.PAUSED,
            }
            return of.get(current.file.state, m.RigState.SCANNING)
        return m.RigState.MANUAL if self._manual.active else m.RigState.IDLE

    # ------------------------------------------------------------ facts

    async def _hello(self, _: m.Hello, asked: Asked) -> Answer:
        return Answer(
            m.Welcome(
                protocol=m.PROTOCOL,
                server=__version__,
                rig=self._config.rig.name,
                epoch=self._epoch,
                role=asked.caller.role,
                events=self._config.network.events,
                methods=catalog.NAMES,
                devices=self._rig.names(),
            )
        )

    async def _status(self, _: m.GetStatus, __: Asked) -> Answer:
        current = self._runner.current
        return Answer(
            m.Status(
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

    def _counted(self, run: RunFolder) -> m.RunInfo:
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

    async def _devices(self, _: m.GetDevices, __: Asked) -> Answer:
        return Answer(m.Devices(devices=self._rig.devices()))

    async def _discover(self, command: m.Discover, asked: Asked) -> Answer:
        self._manual.admit(asked.token)
        self._by_hand.require_no_run()
        searches = await discovery.discover(
            command.drivers, command.timeout_s, self._config.devices, self._rig.devices()
        )
        return Answer(m.Discovered(searches=searches))

    async def _examine(self, command: m.Examine, asked: Asked) -> Answer:
        doctor = self._doctor
        if not command.passive:
            self._by_hand.require(asked)
        writes = self._runner.current is not None
        checks = await asyncio.to_thread(doctor.look, run_writes=writes)
        if not command.passive:
            checks += await self._by_hand.do(asked, doctor.expose)
        return Answer(m.Examined(checks=tuple(checks)))

    async def _log(self, command: m.GetLog, _: Asked) -> Answer:
        if command.run:
            await asyncio.to_thread(self._store.open, command.run)  # a name that is wrong is said
        records = await asyncio.to_thread(self._book.records, command.run, command.limit)
        return Answer(m.Log(records=records))

    # ------------------------------------------------------------ runs

    async def _submit(self, command: m.Submit, asked: Asked) -> Answer:
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

    async def _reprocess(self, command: m.Reprocess, asked: Asked) -> Answer:
        """Neither a lock nor an emergency stop keeps anybody from it: it touches no device."""
        by = command.by or asked.caller.name
        return _about(
            await asyncio.to_thread(self._reprocessor.submit, command, by, asked.request_id)
        )

    async def _queue(self, _: m.GetQueue, __: Asked) -> Answer:
        return Answer(m.Runs(runs=tuple(run.info() for run in self._runner.queue())))

    async def _move(self, command: m.MoveQueued, asked: Asked) -> Answer:
        self._manual.admit(asked.token)
        if self._reprocessor.mine(command.run) is not None:
            raise UmbraError(
                Code.WRONG_STATE,
                f"{command.run} is made from another run's frames: it waits beside the queue",
            )
        queue = await asyncio.to_thread(self._runner.move, command.run, command.to)
        return Answer(m.Runs(runs=tuple(run.info() for run in queue)))

    async def _pause(self, command: m.Pause, asked: Asked) -> Answer:
        self._manual.admit(asked.token)
        return _about(self._runner.pause(command.run))

    async def _resume(self, command: m.Resume, asked: Asked) -> Answer:
        if (mine := self._reprocessor.mine(command.run)) is not None:
            return _about(await asyncio.to_thread(self._reprocessor.resume, mine))
        self._manual.admit(asked.token)
        return _about(await asyncio.to_thread(self._runner.resume, command.run))

    async def _abort(self, command: m.Abort, asked: Asked) -> Answer:
        by = command.by or asked.caller.name
        # Here and not in a worker: what waits for the workers must not delay it.
        current = self._runner.abort_current(command.run, by)
        if current is None and (mine := self._reprocessor.mine(command.run)) is not None:
            return _about(await asyncio.to_thread(self._reprocessor.abort, mine, by))
        if current is None:
            current = await asyncio.to_thread(self._runner.abort, command.run, by)
        return _about(current)

    async def _estop(self, command: m.EStop, asked: Asked) -> Answer:
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
                m.Done(message="stopped, but not every device said that it is safe: look at it")
            )
        return Answer(m.Done(message="stopped: dark and held; `umbra reset` ends it"))

    async def _reset(self, _: m.Reset, __: Asked) -> Answer:
        await asyncio.to_thread(self._rig.require_ready)
        await asyncio.to_thread(self._store.unmark, ESTOP)
        self._rig.unlatch()
        self._estopped = False
        self._runner.release(ESTOP)
        self.changed("reset")
        return Answer(m.Done(message="the queue goes on"))

    async def _runs(self, command: m.ListRuns, _: Asked) -> Answer:
        def listed() -> tuple[m.RunInfo, ...]:
            runs = self._store.runs()
            chosen = (r for r in runs if command.state is None or r.file.state is command.state)
            return tuple(self._counted(run) for run in itertools.islice(chosen, command.limit))

        return Answer(m.Runs(runs=await asyncio.to_thread(listed)))

    async def _run(self, command: m.GetRun, _: Asked) -> Answer:
        run = await asyncio.to_thread(self._runner.find, command.run)
        return Answer(m.Run(run=self._counted(run)))

    async def _result(self, command: m.GetResult, _: Asked) -> Answer:
        def result() -> Answer:
            run = self._runner.find(command.run)
            found, facts = self._result_of(run)
            reply = m.Result(run=run.info(), final=run.file.state is m.RunState.DONE, facts=facts)
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

    async def _product(self, command: m.GetProduct, _: Asked) -> Answer:
        def part() -> Answer:
            run = self._store.open(command.run)
            path = run.product(command.name)
            size = path.stat().st_size
            with path.open("rb") as file:
                file.seek(command.offset)
                data = np.frombuffer(file.read(command.limit), np.uint8)
            product = next(p for p in run.file.products if p.name == command.name)
            return Answer(
                m.ProductPart(product=product, offset=command.offset, size=size), {"data": data}
            )

        return await asyncio.to_thread(part)

    async def _preview(self, command: m.GetPreview, _: Asked) -> Answer:
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
                m.Picture(facts={"run": run.id, "what": command.what}), {"preview": shown}
            )

        return await asyncio.to_thread(look)

    # ------------------------------------------------------------ events

    def changed(self, reason: str = "") -> None:
        """Tell subscribers that the rig's state or lock changed; from the loop."""
        self._publisher.publish(
            m.RigChanged(state=self.state, lock=self._manual.lock_info(), reason=reason)
        )


def _looked(glimpse: Glimpse, width: int) -> Answer:
    small = picture.narrowed(glimpse.picture, width)
    arrays = {"preview": small, "saturated": cells(glimpse.saturated, *small.shape[:2])}
    age_s = round(time.monotonic() - glimpse.at_s, 1)
    return Answer(m.Picture(facts={**glimpse.facts, "run": glimpse.run, "age_s": age_s}), arrays)


def _about(run: RunFolder) -> Answer:
    return Answer(m.Run(run=run.info()))
