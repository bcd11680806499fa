"""What follows a run's end: old runs and memory make room, and whoever wants to know is told.

Neither may harm a run: what goes wrong here is logged, and tried again after the next run.
"""

from __future__ import annotations

import ctypes
import gc
import subprocess

import msgspec
import structlog

from daemon.config import HooksSection, RigConfig
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.errors import UmbraError
from protocol.messages.runs import RunState

_DAY_S = 86_400.0

log = structlog.get_logger(__name__)


def after(run: RunFolder, store: Store, config: RigConfig) -> None:
    """Tell of a run that has ended, then delete what is past keeping. Blocks: not for the loop."""
    tell(run, config.hooks)
    expire(store, config, run)


def give_back() -> None:
    """Let the system have an ended run's memory. Its parts refer to each other, and would stay
    until a collection that many runs may precede; and glibc keeps what is freed, in pieces that fit
    the next run ever less. Other C libraries lack the call, and need none."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def tell(run: RunFolder, hooks: HooksSection) -> None:
    """Run the hook of this end, the run's JSON on its standard input, its output in the log.

    Not repeated: the command may have done half of its work.
    """
    done = run.file.state is RunState.DONE
    command = hooks.done if done else hooks.failed
    if not command or run.file.state is RunState.ABORTED:
        return
    try:
        told = subprocess.run(
            command,
            input=msgspec.json.encode(run.info()),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=hooks.timeout_s,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        log.error("hook failed", run=run.id, command=command, problem=str(error))  # noqa: TRY400
        return
    say = log.error if told.returncode else log.info
    output = told.stdout.decode(errors="replace").strip()[-500:]
    say("hook ended", run=run.id, code=told.returncode, output=output)


def expire(store: Store, config: RigConfig, just_ended: RunFolder) -> None:
    """Delete runs by [storage] keep_days and keep_gb; never one that waits, runs or just ended."""
    storage = config.storage
    if storage.keep_days is None and storage.keep_gb is None:
        return
    days = float("inf") if storage.keep_days is None else storage.keep_days
    gigabytes = float("inf") if storage.keep_gb is None else storage.keep_gb
    try:
        gone = store.expire(days * _DAY_S, gigabytes * 1e9, keep=(just_ended.id,))
    except (UmbraError, OSError):
        log.exception("old runs could not be deleted")
        return
    if gone:
        log.info("old runs deleted", runs=gone)
