"""What each command does. One method a command; the protocol says what it means.

Work by hand is in `byhand`, what only reads in `reading`; here is what drives the rig.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

from daemon import __version__
from daemon.config import RigConfig
from daemon.devices import discovery
from daemon.devices.rig import SAFE_S, Rig
from daemon.doctor.examination import Doctor
from daemon.logs import LogBook
from daemon.manual.manual import Manual
from daemon.pictures.viewfinder import Viewfinder
from daemon.runs.reprocessor import Reprocessor
from daemon.runs.runner import Runner
from daemon.scans import catalog
from daemon.serving.byhand import ByHand
from daemon.serving.publisher import Publisher
from daemon.serving.reading import Reading
from daemon.serving.server import Answer, Asked, Caller
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.errors import Code, UmbraError
from protocol.messages import commands, replies
from protocol.messages.access import Role
from protocol.messages.envelopes import PROTOCOL
from protocol.messages.events import RigChanged
from protocol.messages.rig import RigState
from protocol.messages.runs import RunState

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
        self._doctor = doctor
        self._publisher = publisher
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
        self._reading = Reading(
            runner=runner,
            reprocessor=reprocessor,
            manual=manual,
            store=store,
            viewfinder=viewfinder,
            book=book,
        )
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
            **self._by_hand.table,
            **self._reading.table,
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
                run=self._reading.counted(current) if current else None,
                progress=self._runner.progress,
                queue=tuple(run.info() for run in self._runner.queue()),
                lock=self._manual.lock_info(),
                free_bytes=self._store.free_bytes(),
                reserve_bytes=self._store.reserve_bytes,
                sequences=self._publisher.sequences(),
                reprocessing=self._reprocessor.progress,
            )
        )

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

    # ------------------------------------------------------------ events

    def changed(self, reason: str = "") -> None:
        """Tell subscribers that the rig's state or lock changed; from the loop."""
        self._publisher.publish(
            RigChanged(state=self.state, lock=self._manual.lock_info(), reason=reason)
        )


def _about(run: RunFolder) -> Answer:
    return Answer(replies.Run(run=run.info()))
