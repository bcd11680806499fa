"""How runs are put into words."""

from __future__ import annotations

import msgspec
from msgspec import Struct

from protocol.cli.output import when
from protocol.messages.runs import RunInfo, RunState


def method(run: RunInfo) -> str:
    """The name of the run's method."""
    return str(type(run.spec).__struct_config__.tag)


def frames(run: RunInfo) -> str:
    """How many frames: 12/27 frames, 1 missing."""
    told = f"{run.recorded}/{run.planned} frames" if run.planned else f"{run.recorded} frames"
    if run.missing:
        told += f", {run.missing} missing"
    if run.rejected:
        told += f", {run.rejected} rejected"
    return told


def settings(run: RunInfo) -> str:
    """What the run was told that is not a default: checker=6, radiometry.tone=srgb."""

    def changed(spec: msgspec.Struct, before: str) -> list[str]:
        found = []
        for field in msgspec.structs.fields(spec):
            value = getattr(spec, field.name)
            if value == field.default:
                continue
            if isinstance(value, msgspec.Struct):
                found += changed(value, f"{field.name}.")
            else:
                found.append(f"{before}{field.name}={_plain(value)}")
        return found

    return ", ".join(changed(run.spec, ""))


def _plain(value: object) -> str:
    if isinstance(value, msgspec.Struct):  # as an option takes it
        return ":".join(_plain(part) for part in msgspec.structs.astuple(value) if part != "")
    if isinstance(value, float):
        return f"{value:g}"
    return ",".join(map(_plain, value)) if isinstance(value, tuple) else str(value)


def ending(run: RunInfo) -> str:
    """Why it ended, if that needs words."""
    if run.end is None:
        return ""
    by = f" by {run.end.by}" if run.end.by and run.end.by not in run.end.reason else ""
    return f"{run.end.reason}{by}"


def rows(runs: tuple[RunInfo, ...]) -> list[list[str]]:
    """Runs as rows of a table; see HEADINGS."""
    return [
        [r.id, method(r), r.state.value, frames(r), when(r.submitted), _remark(r)] for r in runs
    ]


def _remark(run: RunInfo) -> str:
    made = f"from {run.parents[0]}" if run.parents else ""
    said = run.spec.note or ("" if made and run.state is RunState.DONE else ending(run))
    return " · ".join(part for part in (made, said) if part)


HEADINGS = ["run", "method", "state", "frames", "submitted", "note"]


class Fetched(Struct, frozen=True, kw_only=True):
    """What `--json` prints when files were written: the run, and the files."""

    run: RunInfo
    files: tuple[str, ...]
