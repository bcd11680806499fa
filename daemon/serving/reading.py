"""What the commands do that only read: runs, their results and products, the log, pictures."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import numpy as np

from daemon.logs import LogBook
from daemon.manual.manual import Manual
from daemon.pictures import picture
from daemon.pictures.viewfinder import Glimpse, Viewfinder, cells
from daemon.products import measured, separated
from daemon.runs.reprocessor import Reprocessor
from daemon.runs.runner import Runner
from daemon.scans.drawing import draw
from daemon.separation.estimator import Components, Result
from daemon.serving.server import Answer, Asked
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.errors import Code, UmbraError
from protocol.messages import commands, replies
from protocol.messages.runs import RunInfo, RunState


class Reading:
    """Answers questions; nothing here moves, lights or exposes anything. What blocks goes to a
    worker thread."""

    def __init__(
        self,
        *,
        runner: Runner,
        reprocessor: Reprocessor,
        manual: Manual,
        store: Store,
        viewfinder: Viewfinder,
        book: LogBook,
    ) -> None:
        self._runner = runner
        self._reprocessor = reprocessor
        self._manual = manual
        self._store = store
        self._viewfinder = viewfinder
        self._book = book
        self._results = asyncio.Semaphore(1)  # one at a time: each takes the estimator's thread
        self.table: dict[type[commands.Command], Callable[[Any, Asked], Awaitable[Answer]]] = {
            commands.ListRuns: self._runs,
            commands.GetRun: self._run,
            commands.GetResult: self._result,
            commands.GetProduct: self._product,
            commands.GetLog: self._log,
            commands.GetPreview: self._preview,
            commands.Draw: self._draw,
        }

    def counted(self, run: RunFolder) -> RunInfo:
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

    # ------------------------------------------------------------ commands

    async def _runs(self, command: commands.ListRuns, _: Asked) -> Answer:
        def listed() -> tuple[RunInfo, ...]:
            runs = self._store.runs()
            chosen = (r for r in runs if command.state is None or r.file.state is command.state)
            return tuple(self.counted(run) for run in itertools.islice(chosen, command.limit))

        return Answer(replies.Runs(runs=await asyncio.to_thread(listed)))

    async def _run(self, command: commands.GetRun, _: Asked) -> Answer:
        run = await asyncio.to_thread(self._runner.find, command.run)
        return Answer(replies.Run(run=self.counted(run)))

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
        for execution in (self._runner.under_way, self._reprocessor.under_way):
            if execution is None or execution.folder.id != run.id:
                continue
            if not run.file.products:
                found = execution.result()
                return found, found.facts
        measurement = measured.read(run)
        return (measurement, measurement.facts) if measurement else separated.read(run)

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

    async def _log(self, command: commands.GetLog, _: Asked) -> Answer:
        if command.run:
            await asyncio.to_thread(self._store.open, command.run)  # a name that is wrong is said
        records = await asyncio.to_thread(self._book.records, command.run, command.limit)
        return Answer(replies.Log(records=records))

    async def _draw(self, command: commands.Draw, _: Asked) -> Answer:
        drawn = await asyncio.to_thread(
            draw, command.spec, command.image, command.width, command.height, command.gamma
        )
        facts = {"images": drawn.images, "lighting": drawn.lighting.value}
        return Answer(replies.Picture(facts=facts), {"png": drawn.png})


def _looked(glimpse: Glimpse, width: int) -> Answer:
    small = picture.narrowed(glimpse.picture, width)
    arrays = {"preview": small, "saturated": cells(glimpse.saturated, *small.shape[:2])}
    age_s = round(time.monotonic() - glimpse.at_s, 1)
    return Answer(
        replies.Picture(facts={**glimpse.facts, "run": glimpse.run, "age_s": age_s}), arrays
    )
