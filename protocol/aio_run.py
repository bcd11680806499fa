"""A run as its operator has it in hand, in asyncio."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protocol.arrivals import place_in
from protocol.following import SILENCE_S, Following
from protocol.messages.runs import Progress, RunInfo, RunState
from protocol.results import Separation
from protocol.run import Known, failure

if TYPE_CHECKING:
    from protocol.aio import AsyncClient


class AsyncRun(Known):
    """A run on a rig: follow it, steer it, fetch what it made."""

    def __init__(self, rig: AsyncClient, info: RunInfo) -> None:
        super().__init__(info)
        self._rig = rig

    async def refresh(self) -> RunInfo:
        """Ask the rig how the run is."""
        self.info = await self._rig.run_info(self.id)
        return self.info

    async def progress(self) -> AsyncGenerator[Progress, None]:
        """How the run goes on, until it has ended: see `protocol.run.Run.progress`."""
        following = Following(self.id)
        async with self._rig.subscribe("run", "progress", joined=False) as events:
            news = await self._snapshot(following)
            while True:
                if news is not None:
                    yield news
                if following.ended:
                    break
                notice = await events.next(SILENCE_S)
                if notice is None or following.outdated_by(notice.event):
                    news = await self._snapshot(following)
                else:
                    news = following.event(notice.event)
        await self.refresh()

    async def _snapshot(self, following: Following) -> Progress | None:
        status = await self._rig.status()
        return following.snapshot(status, await self.refresh())

    async def wait(self, timeout_s: float | None = None, *, check: bool = True) -> RunInfo:
        """Wait until the run has ended: see `protocol.run.Run.wait`."""
        try:
            async with asyncio.timeout(timeout_s), contextlib.aclosing(self.progress()) as going:
                async for _ in going:
                    pass
        except TimeoutError:
            raise TimeoutError(f"run {self.id} is {self.state} after {timeout_s:g} s") from None
        if check and self.state is not RunState.DONE:
            raise failure(self.info)
        return self.info

    async def result(self, *, check: bool = True) -> Separation:
        """Direct and global as they are now: see `protocol.run.Run.result`."""
        if check and (await self.refresh()).state is RunState.FAILED:
            raise failure(self.info)
        return await self._rig.result(self.id)

    async def facts(self) -> dict[str, Any]:
        """The figures of the run as they are now: see `protocol.run.Run.facts`."""
        return await self._rig.facts(self.id)

    async def save(self, folder: Path | str) -> list[Path]:
        """Fetch all products into a folder, which is made; the files written."""
        return [
            await self._rig.download(self.id, product.name, place_in(folder, product))
            for product in (await self.refresh()).products
        ]

    async def pause(self) -> None:
        """Pause after the step under way."""
        await self._rig.pause(self.id)

    async def resume(self) -> None:
        """Go on."""
        await self._rig.resume(self.id)

    async def abort(self) -> None:
        """End the run; what was recorded is kept."""
        await self._rig.abort(self.id)
