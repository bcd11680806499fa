"""How a run ends, whatever made it: what its products are told last, and what is written of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import structlog

from daemon.separation.estimator import NotYet, Result
from daemon.storage.ledger import Ledger
from daemon.storage.runfolder import RunFolder
from protocol.errors import Code, UmbraError
from protocol.messages.runs import End, RunState

log = structlog.get_logger(__name__)


def utc_now() -> str:
    """This moment, as run.json has it."""
    return datetime.now(UTC).isoformat(timespec="microseconds")


def with_exposure(result: Result, rig: Mapping[str, Any]) -> Result:
    """The result's facts with the exposure that was chosen for it (run.json's `rig`), and its
    problem as advice."""
    chosen = rig.get("exposure")
    if not chosen:
        return result
    facts = {**result.facts, "exposure": chosen}
    if problem := chosen.get("problem"):
        facts["advice"] = [f"Auto-exposure: {problem}.", *facts.get("advice", ())]
    return replace(result, facts=facts)


def end_of(lost: Mapping[int, str], reason: str, *, short: bool = False) -> End:
    """The end of a run whose products are made; `lost` are patterns that it has no frame of, and
    why; `short`: it ended for its reason before it had what was asked for (`Method.short`)."""
    if lost:
        reason = f"{of_lost(lost)}; the products are made without them"
    elif short:
        reason += "; the products are made of the frames that came, and `umbra resume` adds to them"
    else:
        return End(state=RunState.DONE, reason=reason)
    return End(state=RunState.FAILED, code=Code.FRAMES_MISSING, reason=reason)


def of_lost(lost: Mapping[int, str]) -> str:
    """Which patterns have no frame, and why, for people."""
    some = ", ".join(str(n) for n in list(lost)[:8]) + (" ..." if len(lost) > 8 else "")
    why = list(lost.values())[-1]
    return f"no frame could be had of {len(lost)} of the patterns ({some}): {why}"


def without_result(error: NotYet, ledger: Ledger, reason: str) -> UmbraError:
    """Why a run that came to its end has nothing to show: what is lacking, why it ended then, and
    what became of its frames."""
    lost, tally = ledger.lost_patterns, ledger.tally
    if lost:
        return UmbraError(Code.FRAMES_MISSING, f"{of_lost(lost)}: scan again")
    frames = f"{tally.recorded} frames were recorded"
    if tally.missing:
        frames += f" and {tally.missing} are missing"
    if tally.rejected:
        frames += f"; {tally.rejected} were not used, the last for: {ledger.why_unused}"
    return UmbraError(
        Code.NO_RESULT, f"there is no result: {error}. It ended for: {reason}. {frames}"
    )


def requeue(folder: RunFolder) -> None:
    """Of a run that has not begun when the daemon stops: the next start tries again. Never raises,
    as `close`."""
    try:
        folder.update(state=RunState.QUEUED)
    except (OSError, UmbraError) as error:
        log.warning("the run's state could not be written yet", problem=str(error))
        folder.remember(state=RunState.QUEUED)
    log.info("run goes on waiting after the next start")


def close(folder: RunFolder, end: End, timings: Mapping[str, float]) -> None:
    """Write a run's end; never raises. A disk that is full learns of it later (`Runner.tend`)."""
    written = {"state": end.state, "end": end, "ended": utc_now(), "timings": dict(timings)}
    try:
        folder.update(**written)
    except (OSError, UmbraError) as error:
        log.warning("the run's end could not be written yet", problem=str(error))
        folder.remember(**written)
    say = log.info if end.state is RunState.DONE else log.warning
    say("run " + end.state, reason=end.reason, code=end.code, by=end.by)
