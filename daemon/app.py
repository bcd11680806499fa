"""umbrad: start-up, shutdown, and what the service manager is told.

Start:  config -> store (held) -> sockets bound -> devices connected -> queue served -> READY=1
Stop:   STOPPING=1 -> the run is interrupted -> devices safe and closed -> sockets closed -> 0
        a second signal: devices safe -> 0, and nothing else is waited for

Exit codes: 0 stopped as asked, 1 could not start or broke, 2 the configuration cannot be used.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import secrets
import signal
import sys
import threading
from collections.abc import Coroutine
from functools import partial
from pathlib import Path
from typing import Any

import structlog
import zmq
import zmq.asyncio
from numpy.typing import NDArray

from daemon import __version__, config, logs
from daemon.devices.rig import SAFE_S, Rig
from daemon.doctor.examination import Doctor
from daemon.manual.manual import Manual
from daemon.notify import Notifier
from daemon.pictures.viewfinder import Glimpse, Viewfinder
from daemon.runs.reprocessor import Reprocessor
from daemon.runs.runner import LOCK, Runner
from daemon.serving.access import Access, check_exposure, check_keys
from daemon.serving.commands import Commands
from daemon.serving.publisher import HIGH_WATER, Publisher
from daemon.serving.server import Server
from daemon.storage.store import Store
from protocol.errors import UmbraError
from protocol.messages.events import AnyEvent, DeviceChanged, Logged, PreviewTaken
from protocol.messages.rig import DeviceInfo, RigState
from protocol.wire import MOST_BYTES

ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""What ends the daemon in an orderly way: the service manager, Ctrl-C, a terminal that closes."""

_TEND_S = 1.0  # how often leases, reconnections and unwritten states are looked after
_SWITCH_S = 0.0005
"""Python's switch interval: commands must not wait 5 ms for a thread that computes."""

log = structlog.get_logger(__name__)


def main(arguments: list[str] | None = None) -> int:
    """The console script `umbrad`."""
    parser = argparse.ArgumentParser(
        prog="umbrad",
        description="Drives a projector, a camera and an occluder, and separates light. "
        "Without --config it is a virtual rig on loopback.",
    )
    parser.add_argument("--config", type=Path, metavar="rig.toml", help="the rig's description")
    parser.add_argument("--check", action="store_true", help="check the configuration, and exit")
    parser.add_argument("--log-level", default="info", choices=["debug", "info", "warning"])
    parser.add_argument(
        "--until-eof", action="store_true", help="stop when standard input is closed"
    )
    parser.add_argument("--version", action="version", version=f"umbrad {__version__}")
    options = parser.parse_args(arguments)
    try:
        rig_config = config.load(options.config)
        network = rig_config.network
        check_exposure((network.command, network.events), network.keys)
        if options.check:
            check_keys(network.keys)
            print(f"{options.config or 'built-in'}: the configuration is good")
            return 0
        book = logs.configure(options.log_level)
        sys.setswitchinterval(_SWITCH_S)
        asyncio.run(_Daemon(rig_config, options.config, book).run(until_eof=options.until_eof))
    except config.ConfigError as error:
        print(f"umbrad: {error}", file=sys.stderr)
        return 2
    except (UmbraError, StartError) as error:
        print(f"umbrad: {error}", file=sys.stderr)
        return 1
    return 0


class StartError(Exception):
    """umbrad cannot start or go on; the message is one line."""


class _Daemon:
    """The process: what is started here is stopped here, in the opposite order."""

    def __init__(self, rig_config: config.RigConfig, path: Path | None, book: logs.LogBook) -> None:
        self._config = rig_config
        self._path = path
        self._book = book
        self._notifier = Notifier()
        self._stop = asyncio.Event()
        self._hurry = asyncio.Event()
        self._reason = ""
        self._broken = False
        self._tasks: list[asyncio.Task[None]] = []

    async def run(self, *, until_eof: bool) -> None:
        """Start, serve until asked to stop, stop. Raises UmbraError, ConfigError."""
        loop, epoch = asyncio.get_running_loop(), secrets.token_hex(6)
        self._heed_signals(loop)
        with contextlib.ExitStack() as stack:
            store = stack.enter_context(
                Store(Path(self._config.rig.data), self._config.storage.reserve_mb << 20)
            )
            context = zmq.asyncio.Context()
            stack.callback(context.destroy, linger=0)
            access = Access(context, self._config.network.keys)
            access.start()
            stack.callback(access.stop)
            commands_socket = self._bind(context, zmq.ROUTER, access, self._config.network.command)
            events_socket = self._bind(context, zmq.XPUB, access, self._config.network.events)
            publisher = Publisher(zmq.Socket.shadow(events_socket), epoch)
            stack.enter_context(publisher.admitting(loop))
            self._publish_log(loop, stack, store, publisher)

            def publish(body: AnyEvent, **arrays: NDArray[Any]) -> None:
                loop.call_soon_threadsafe(partial(publisher.publish, body, **arrays))

            def glimpsed(glimpse: Glimpse) -> None:
                body = PreviewTaken(run=glimpse.run, what=glimpse.what, facts=glimpse.facts)
                publish(body, preview=glimpse.picture, saturated=glimpse.saturated)

            def changed() -> None:
                loop.call_soon_threadsafe(commands.changed)

            def health(info: DeviceInfo) -> None:
                publish(DeviceChanged(device=info))
                runner.wake()  # runs wait for devices that are away

            rig = Rig(self._config, health)
            viewfinder = Viewfinder(glimpsed)
            manual = Manual(rig, viewfinder, changed, publish)
            runner = Runner(
                rig=rig,
                store=store,
                config=self._config,
                viewfinder=viewfinder,
                publish=publish,
                on_activity=changed,
                make_way=manual.make_way,
            )
            reprocessor = Reprocessor(
                store=store,
                config=self._config,
                publish=publish,
                busy=lambda: commands.state is RigState.SCANNING,
            )
            commands = Commands(
                rig=rig,
                runner=runner,
                reprocessor=reprocessor,
                manual=manual,
                store=store,
                config=self._config,
                viewfinder=viewfinder,
                doctor=Doctor(
                    rig=rig,
                    manual=manual,
                    store=store,
                    config=self._config,
                    path=self._path,
                    watchdog_s=self._notifier.watchdog_interval(),
                ),
                publisher=publisher,
                book=self._book,
                epoch=epoch,
            )
            running: list[asyncio.Task[None]] = []
            runner.recover()
            try:
                await asyncio.to_thread(rig.connect)
                self._serve(Server(commands_socket, commands.handle, access.caller).serve())
                running += [self._serve(runner.serve()), self._serve(reprocessor.serve())]
                self._serve(self._tend(rig, manual, runner))
                self._serve(self._watch(rig, runner))
                if until_eof:
                    self._until_eof(loop)
                self._tell_ready(runner)
                await self._stop.wait()
            finally:  # whatever ends the daemon, the devices end in their safe state
                commands.stop(self._reason)
                await self._shut_down(rig, runner, reprocessor, running)
        log.info("stopped")
        if self._broken:
            raise StartError(f"{self._reason}; the log has the details")

    def _heed_signals(self, loop: asyncio.AbstractEventLoop) -> None:
        for number in ENDING:
            if number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # nohup: it outlives its terminal
            loop.add_signal_handler(number, self._signalled, number.name)

    def _publish_log(
        self,
        loop: asyncio.AbstractEventLoop,
        stack: contextlib.ExitStack,
        store: Store,
        publisher: Publisher,
    ) -> None:
        """What is logged goes to the runs' folders and to subscribers, until the sockets close."""
        closed = threading.Event()
        stack.callback(closed.set)

        def tell(record: dict[str, Any]) -> None:
            if not closed.is_set():
                publisher.publish(Logged(record=record))

        def logged(record: dict[str, Any]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(tell, record)

        self._book.open(store.runs_folder, logged)

    def _tell_ready(self, runner: Runner) -> None:
        self._notifier.ready(self._status_line(runner))
        network = self._config.network
        log.info(
            "ready",
            rig=self._config.rig.name,
            version=__version__,
            command=network.command,
            events=network.events,
            data=self._config.rig.data,
        )

    async def _shut_down(
        self,
        rig: Rig,
        runner: Runner,
        reprocessor: Reprocessor,
        running: list[asyncio.Task[None]],
    ) -> None:
        log.info("stopping", reason=self._reason)
        self._notifier.stopping()
        reprocessor.stop()
        runner.stop()
        orderly = asyncio.create_task(self._let_go(rig, running))
        hurried = asyncio.create_task(self._hurry.wait())
        await asyncio.wait([orderly, hurried], return_when=asyncio.FIRST_COMPLETED)
        if not orderly.done():
            await self._leave_at_once(rig)
        hurried.cancel()
        await orderly
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for number in ENDING:  # one more is no reason to die of it
            asyncio.get_running_loop().remove_signal_handler(number)
            signal.signal(number, signal.SIG_IGN)

    async def _let_go(self, rig: Rig, running: list[asyncio.Task[None]]) -> None:
        """Wait for what is under way to be written to its end, and close the devices."""
        if running:
            await asyncio.wait(running)
        await asyncio.to_thread(rig.close)

    async def _leave_at_once(self, rig: Rig) -> None:
        """Asked twice: make the rig safe, and be gone without waiting for any thread.

        What was acknowledged is durable; the next start finds the run interrupted, as after a
        crash. The process ends here, for a thread that hangs would keep an orderly exit from
        coming.
        """
        log.warning("stopping in a hurry: the run's end and the devices are not waited for")
        safe = await asyncio.to_thread(lambda: rig.safe_within(rig.make_safe(), SAFE_S))
        log.warning("stopped in a hurry", safe=safe)
        sys.stdout.flush()
        os._exit(1 if self._broken else 0)

    # ------------------------------------------------------------ pieces

    def _bind(
        self, context: zmq.asyncio.Context, kind: int, access: Access, endpoint: str
    ) -> zmq.asyncio.Socket:
        socket = context.socket(kind)
        socket.linger = 0
        if kind == zmq.XPUB:
            socket.sndhwm = HIGH_WATER
        else:
            socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
            socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)  # more than that is no request
        access.lock(socket)
        try:
            socket.bind(endpoint)
        except zmq.ZMQError as error:
            raise StartError(
                f"{endpoint}: {error.strerror or error}; is another umbrad running?"
            ) from error
        return socket

    def _serve(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """A task that must not end by itself: if it breaks, the daemon stops."""
        task = asyncio.create_task(work)

        def ended(done: asyncio.Task[None]) -> None:
            if not done.cancelled() and done.exception() is not None:
                log.error("a part of umbrad broke", exc_info=done.exception())
                self._broken = True
                self._ask_to_stop("a part of umbrad broke")

        task.add_done_callback(ended)
        self._tasks.append(task)
        return task

    async def _tend(self, rig: Rig, manual: Manual, runner: Runner) -> None:
        told = ""
        while True:
            rig.tend()
            manual.tend()
            await asyncio.to_thread(runner.tend)
            if manual.lock_info() is None:
                runner.release(LOCK)
            status = self._status_line(runner)
            if status != told:
                told = status
                self._notifier.status(status)
            await asyncio.sleep(_TEND_S)

    async def _watch(self, rig: Rig, runner: Runner) -> None:
        """WATCHDOG=1 only while the loop (it is here) and every thread have beaten lately."""
        interval = self._notifier.watchdog_interval()
        while interval is not None:
            if not rig.alive:
                log.error("no watchdog beat: a device thread is stuck")
            elif not runner.alive:
                log.error("no watchdog beat: the run does not move")
            else:
                self._notifier.watchdog()
            await asyncio.sleep(interval / 3)

    def _status_line(self, runner: Runner) -> str:
        progress = runner.progress
        if progress is None:
            waits_for = runner.waits_for
            return f"idle, {len(runner.queue())} queued" + (
                f", waiting for: {waits_for}" if waits_for else ""
            )
        share = "" if progress.fraction is None else f" {progress.fraction:.0%}"
        return f"{progress.run}: {progress.phase}{share}"

    def _ask_to_stop(self, reason: str) -> None:
        self._reason = self._reason or reason
        self._stop.set()

    def _signalled(self, name: str) -> None:
        """The first signal stops, the next one hurries."""
        log.info("signal", signal=name)  # who sent it, asyncio does not tell
        if self._stop.is_set():
            self._hurry.set()
        self._ask_to_stop(name)

    def _until_eof(self, loop: asyncio.AbstractEventLoop) -> None:
        def read() -> None:
            with contextlib.suppress(OSError):
                while os.read(sys.stdin.fileno(), 4096):
                    pass
            loop.call_soon_threadsafe(self._ask_to_stop, "standard input was closed")

        # A thread, for standard input may be a file or a device that cannot be waited for.
        threading.Thread(target=read, name="umbra-stdin", daemon=True).start()


if __name__ == "__main__":
    sys.exit(main())
